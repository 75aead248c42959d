"""The cluster's secrets, shared by the coordinators on one PostgreSQL database as one sealed document among its rows.

Rules that this module owns:
- The document is sealed with a key that the operator gives to each coordinator and that is not in the database (Fernet:
  AES-128-CBC with HMAC-SHA256). A document that was changed, or sealed with another key, is refused.
- A leader alone writes it, in a transaction that checks its term: before it serves, and when a file has changed.
- Each folder notes the version of the document that it last had, and the digests of the files in it. A change that was
  made while no coordinator ran on the folder is thereby told from one that another leader made. A file that both have
  changed is refused, and so is a document older than the noted one, which somebody restored.
- `secret` and `secret-unjailed` are deleted on purpose (`splits.secret_of`). Any other missing file is restored.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec
from cryptography.fernet import Fernet, InvalidToken, MultiFernet

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, StorageError, raised_as
from evopolicy_common.records.blobs import digest_of, write_atomically
from evopolicy_coordinator.pki.identity import SIGNING_KEY
from evopolicy_coordinator.splits import SECRET, UNJAILED_SECRET
from evopolicy_coordinator.storage.engines import Place
from evopolicy_coordinator.storage.store import Reader, Store
from evopolicy_coordinator.worlds import JOURNAL

APPROVED = "approved-environments.json"
_CERTS = tuple(f"certs/{name}" for name in ("ca.pem", "ca-key.pem", "machines.json"))
SHARED_FILES = (SECRET, UNJAILED_SECRET, "identity.json", SIGNING_KEY, JOURNAL, APPROVED, *_CERTS)
"""Files of a state folder that all coordinators of a cluster have alike."""
NOTED = "sealed"
"""File of a state folder with the version and digests of the last document."""
_DELETED = (SECRET, UNJAILED_SECRET)


class _Document(msgspec.Struct, frozen=True, kw_only=True):
    version: int
    files: dict[str, bytes]


class _Noted(msgspec.Struct, frozen=True, kw_only=True):
    version: int = 0
    digests: dict[str, str] = {}


class SharedFiles:
    """The shared files of one state folder."""

    def __init__(self, root: Path, key: Path | None) -> None:
        """`key`: a file with Fernet keys, one a line, of which the first seals; None: nothing is shared. Raises
        ConfigError for an unusable key."""
        self._root, self._keys = root, None if key is None else _keys(key)
        self._written: dict[str, bytes] | None = None
        self._version = 0

    def join(self, place: Place) -> None:
        """Takes the files of a database that another coordinator may lead. Raises as `take_sealed`; StorageError."""
        with contextlib.closing(Reader(place)) as reader:
            self.take_sealed(reader.sealed())

    def take_sealed(self, sealed: bytes | None) -> None:
        """Writes the files that another leader has changed. Raises ConfigError when the document cannot be opened, is
        older than the last one, or a file has changed on both sides."""
        noted, own = self._noted(), self._read()
        self._written, self._version = None, noted.version
        if sealed is None:
            return
        document = self._opened(sealed)
        if document.version < noted.version:
            raise ConfigError(
                f"the database has version {document.version} of the cluster's secrets, and {self._root} has had"
                f" {noted.version}: somebody restored an older one. To go on with the database's, delete"
                f" {self._root / NOTED}"
            )
        changed: dict[str, bytes | None] = {}
        contradicting = []
        for name in SHARED_FILES:
            theirs, ours = document.files.get(name), own.get(name)
            if theirs == ours:
                continue
            known = noted.digests.get(name)
            if _digest(ours) == known or (ours is None and name not in _DELETED):
                changed[name] = theirs
            elif _digest(theirs) != known:
                contradicting.append(name)
        if contradicting:
            raise ConfigError(
                f"{', '.join(contradicting)} differ between {self._root} and the cluster's secrets in the database:"
                " another coordinator has changed them too. Move these files away to take the database's, and repeat"
                " your change"
            )
        for name, data in changed.items():
            path = self._root / name
            if data is None:
                path.unlink(missing_ok=True)
            else:
                path.parent.mkdir(mode=0o700, exist_ok=True)
                write_atomically(path, data, mode=0o600)
        self._note(document)

    def push(self, store: Store) -> None:
        """As the leader: seals the files if they have changed since the last call. Raises StorageError."""
        if self._keys is None or (own := self._read()) == self._written:
            return
        document = _Document(version=self._version + 1, files=own)
        store.write_sealed(self._keys.encrypt(msgspec.msgpack.encode(document)))
        self._written = own
        with contextlib.suppress(
            StorageError
        ):  # without the note these files are found equal to the document's
            self._note(document)

    def _opened(self, sealed: bytes) -> _Document:
        if self._keys is None:
            raise ConfigError(
                "the cluster's secrets are sealed in the database: name the file with their key by --seal-key"
            )
        try:
            return msgspec.msgpack.decode(self._keys.decrypt(sealed), type=_Document)
        except (InvalidToken, *DECODE_ERRORS) as error:
            raise ConfigError(
                "the cluster's secrets in the database are not sealed with the key of --seal-key, or were changed: name"
                " the key of the other coordinators, or restore the database from a backup"
            ) from error

    def _read(self) -> dict[str, bytes]:
        found = {}
        for name in SHARED_FILES:
            try:
                found[name] = (self._root / name).read_bytes()
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StorageError(f"{self._root / name}: {error.strerror}") from error
        return found

    def _noted(self) -> _Noted:
        path = self._root / NOTED
        try:
            return msgspec.json.decode(path.read_bytes(), type=_Noted)
        except FileNotFoundError:
            return _Noted()
        except DECODE_ERRORS as error:
            raise ConfigError(f"{path} is damaged: {error}; delete it") from error

    def _note(self, document: _Document) -> None:
        digests = {name: digest_of(data) for name, data in document.files.items()}
        noted = _Noted(version=document.version, digests=digests)
        self._version = noted.version
        write_atomically(self._root / NOTED, msgspec.json.encode(noted), mode=0o600)


def _digest(data: bytes | None) -> str | None:
    return None if data is None else digest_of(data)


def _keys(path: Path) -> MultiFernet:
    with raised_as(ConfigError, f"--seal-key {path}", OSError):
        mode, lines = path.stat().st_mode & 0o777, path.read_bytes().split()
    if mode & 0o077:
        raise ConfigError(f"--seal-key {path} may be read by others (mode {mode:04o}); run: chmod 600 {path}")
    try:
        return MultiFernet([Fernet(line) for line in lines])
    except ValueError as error:
        raise ConfigError(
            f"--seal-key {path}: a key is 32 bytes in base64, one a line: openssl rand -base64 32"
        ) from error
