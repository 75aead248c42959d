"""Blobs in an object store: S3, Google Cloud Storage, or Azure.

Rules that this module owns:
- Each upload makes an object of a new name: the blob's digest, the incarnation of the coordinator that wrote it, and a
  random number. A deletion that arrives late never meets a blob that was uploaded again.
- The table `objects` names the object of each blob. A blob is stored once its row is committed, in a transaction that
  checks the incarnation in the object's name.
- Collection compares no clocks for its safety. It marks rows, then reads which blobs are named, then condemns the rows
  that still have its mark, then deletes their objects. A transaction of `Store` that names a blob removes the mark, and
  fails for a condemned blob, which is uploaded again then.
- An object without a row, written by an earlier incarnation, can be deleted: its row can no longer be committed.
- Bytes from the object store are compared with their digest. The folder holds unfinished uploads and checked copies.
- Keys come from environment variables and the files that they name, never from the address.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from evopolicy_common.errors import ConfigError, LeadLostError, StorageError
from evopolicy_common.installation import add_extra
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.records.blobs import BlobStore, FileState, digest_of
from evopolicy_coordinator.storage.engines import BLOBS, Database, Place, connect, place_of
from evopolicy_coordinator.storage.store import CONDEMNED, NAMED

COPIES = "blob-copies"
COPIES_BYTES = 1 << 30
"""Most bytes of copies in that folder of a state folder."""
ADDRESS_LIFE = timedelta(seconds=60)
_OWNER = "evopolicy-owner"
_NAME = re.compile(r"[0-9a-f]{2}/[0-9a-f]{64}-(\d+)-[0-9a-f]{8}")
_PIECE = 8 << 20
_BATCH = 500
_BUSY_TIMEOUT_S = 10.0
_CLIENT = {"timeout": "20s", "connect_timeout": "5s"}
_RETRIES: Any = {"max_retries": 2, "retry_timeout": timedelta(seconds=20)}


class ObjectBlobs(BlobStore):
    """Blobs in an object store. Thread-safe."""

    remote = True
    direct = False
    """Whether workers and gateways get addresses of objects."""

    def __init__(
        self, folder: Path, address: str, place: Place, incarnation: Callable[[], int] | None = None
    ) -> None:
        """`folder`: for uploads and copies. `place`: the database with the table `objects`. `incarnation`: of the
        coordinator that stores blobs; None: the one in the database. Raises ConfigError for a wrong address."""
        super().__init__(folder)
        self._address = address
        self._client, self._objects = _opened(address)
        self._place = place
        self._local = threading.local()
        self._incarnation = incarnation or self._current
        self._copying = threading.Lock()
        self._copied_bytes = 0

    def claim(self, owner: str) -> None:
        """Reserves the address for the state folder with this secret. Raises ConfigError if it is another's."""
        mine = digest_of(owner.encode()).encode()
        with self._asking("claim it"), contextlib.suppress(self._client.exceptions.AlreadyExistsError):
            self._client.put(self._objects, _OWNER, mine, mode="create")
        with self._asking("read its owner"):
            found = bytes(self._client.get(self._objects, _OWNER).bytes())
        if found != mine:
            raise ConfigError(f"{self._address} has the blobs of another state folder: name another prefix")

    def has(self, digest: str) -> bool:
        return self._row(digest) is not None

    _touched = has

    def size(self, digest: str) -> int:
        return self._known(digest)[1]

    def put(self, data: bytes, *, durable: bool = True) -> str:
        digest = digest_of(data)
        self.append_chunk("", digest, len(data), 0, data)
        return digest

    def read_blob(self, digest: str) -> bytes:
        if self.path(digest).exists():
            with contextlib.suppress(StorageError):  # removed meanwhile, or damaged
                return super().read_blob(digest)
        return b"".join(self._pieces(digest))

    def read_chunk(self, digest: str, offset: int, n: int) -> bytes:
        """As a folder's. The first one reads and checks the whole blob."""
        if not self.path(digest).exists():
            part = self._parts / f"copy-{digest}-{threading.get_ident()}"
            try:
                with part.open("wb") as file:
                    file.writelines(self._pieces(digest))
                self._copy(part, digest)
            finally:
                part.unlink(missing_ok=True)
        return super().read_chunk(digest, offset, n)

    def address(self, digest: str) -> str:
        if not self.direct:
            return ""
        name, _ = self._known(digest)
        with self._asking("sign an address"):
            return str(self._client.sign(self._objects, "GET", name, ADDRESS_LIFE))

    def drop_unfinished(self, sender: str | None = None) -> None:
        super().drop_unfinished(sender)
        if sender is None:
            self._drop_copies()

    def unheld(self, age_s: float, now: float, *, dry_run: bool = False) -> dict[str, FileState]:
        """As a folder's, by the database's clock."""
        db, mark = self._db, secrets.randbits(62) + 1
        query = f"SELECT digest, name FROM objects WHERE since < {db.clock} - ? AND mark > {CONDEMNED}"
        with db.errors():
            found = dict(db.execute(query, (int(age_s),)).fetchall())
        digests = [] if dry_run else list(found)
        for some in (digests[first : first + _BATCH] for first in range(0, len(digests), _BATCH)):
            among = f"mark > {CONDEMNED} AND digest IN ({', '.join('?' * len(some))})"
            with self._changing(db.exclusive):
                db.execute(f"UPDATE objects SET mark = ? WHERE {among}", (mark, *some))
        return {digest: (name, mark) for digest, name in found.items()}

    def delete(self, digest: str, unless_changed: FileState | None = None) -> int:
        where = "" if unless_changed is None else " AND name = ? AND mark = ?"
        condemn = f"UPDATE objects SET mark = {CONDEMNED} WHERE digest = ?{where} RETURNING name, size"
        with self._changing():
            found = self._db.execute(condemn, (digest, *(unless_changed or ()))).fetchall()
        for name, _ in found:
            self.path(digest).unlink(missing_ok=True)
            with self._asking(f"delete {name}"), contextlib.suppress(FileNotFoundError):
                self._client.delete(self._objects, name)
        return sum(size for _, size in found)

    def sweep(self) -> None:
        """Deletes the objects that an earlier incarnation wrote and no row names."""
        current = self._current()  # before the rows are read: no further row of an earlier one is committed
        with self._asking("list it"):
            listed = [each["path"] for page in self._client.list(self._objects) for each in page]
        with self._db.errors():
            known = set(self._db.execute(f"SELECT name FROM objects WHERE mark > {CONDEMNED}"))
        old = (path for path in listed if (match := _NAME.fullmatch(path)) and int(match[1]) < current)
        with self._asking("delete what no row names"), contextlib.suppress(FileNotFoundError):
            self._client.delete(self._objects, [path for path in old if (path,) not in known])

    def sizes(self) -> dict[str, int]:
        with self._db.errors():
            return dict(
                self._db.execute(f"SELECT digest, size FROM objects WHERE mark > {CONDEMNED}").fetchall()
            )

    def digests(self) -> Iterator[str]:
        return iter(self.sizes())

    def forget_all(self) -> None:
        """Deletes all rows, before a move to this object store; the objects stay."""
        with self._changing():
            self._db.execute("DELETE FROM objects")

    def _keep(self, part: Path, digest: str) -> FileState:
        incarnation, size = self._incarnation(), part.stat().st_size
        name = f"{digest[:2]}/{digest}-{incarnation}-{secrets.token_hex(4)}"
        with self._asking(f"write {name}"), part.open("rb") as file:
            self._client.put(self._objects, name, file)
        with self._changing() as current:
            if current != incarnation:
                raise LeadLostError(f"blob {digest} was stored for incarnation {incarnation}, not {current}")
            # A blob that is named stays so when it is uploaded again.
            self._db.execute(
                f"INSERT INTO objects VALUES (?, ?, ?, {self._db.clock}, 0) ON CONFLICT (digest) DO UPDATE SET"
                " name = excluded.name, size = excluded.size, since = excluded.since,"
                f" mark = CASE WHEN objects.mark = {CONDEMNED} THEN 0 ELSE {NAMED} END",
                (digest, name, size),
            )
        self._copy(part, digest)
        return name, 0

    def _copy(self, part: Path, digest: str) -> None:
        """Keeps the checked bytes in `part`; all earlier copies go when they would take too much space."""
        path, size = self.path(digest), part.stat().st_size
        with self._copying:
            if self._copied_bytes + size > COPIES_BYTES:
                self._drop_copies()
            self._copied_bytes += size
            path.parent.mkdir(exist_ok=True)
            os.replace(part, path)

    def _drop_copies(self) -> None:
        self._copied_bytes = 0
        for folder in self._root.glob("[0-9a-f][0-9a-f]"):
            shutil.rmtree(folder)

    def _pieces(self, digest: str) -> Iterator[bytes]:
        """The bytes in the object store. Raises StorageError, after the last piece for other bytes."""
        (name, size), hashed = self._known(digest), hashlib.sha256()
        for start in range(0, size, _PIECE):
            with self._asking(f"read {name}"):
                end = min(start + _PIECE, size)
                piece = bytes(self._client.get_range(self._objects, name, start=start, end=end))
            hashed.update(piece)
            yield piece
        if hashed.hexdigest() != digest:
            self.trouble = (
                f"{self._address}: object {name} has other bytes than were written; restore its version"
            )
            raise StorageError(self.trouble)

    def _row(self, digest: str) -> Any:
        """The object's name and size; None when the blob is not stored."""
        query = f"SELECT name, size FROM objects WHERE digest = ? AND mark > {CONDEMNED}"
        with self._db.errors():
            return self._db.execute(query, (digest,)).fetchone()

    def _known(self, digest: str) -> tuple[str, int]:
        if (row := self._row(digest)) is None:
            raise StorageError(f"blob {digest} is not in {self._address}")
        name, size = row
        return name, size

    @property
    def _db(self) -> Database:
        if not hasattr(self._local, "db"):
            self._local.db = connect(self._place, "rw", _BUSY_TIMEOUT_S)
        db: Database = self._local.db
        return db

    def _current(self) -> int:
        with self._changing() as current:
            return current

    @contextlib.contextmanager
    def _changing(self, lock: str | None = None) -> Iterator[int]:
        """A transaction during which the incarnation, which it yields, stays."""
        lock = self._db.shared if lock is None else lock
        with self._db.errors(), self._db.transaction():
            found = self._db.execute(f"SELECT value FROM meta WHERE name = 'incarnation'{lock}").fetchone()
            yield int(found[0])

    @contextlib.contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        """Around requests to the object store: its errors become StorageError."""
        try:
            yield
        except (self._client.exceptions.BaseError, OSError) as error:
            self.trouble = f"{self._address}: cannot {what}: {_reason(error)}"
            raise StorageError(self.trouble) from error
        self.trouble = ""


def _opened(address: str) -> tuple[Any, Any]:
    """The client's module, and its store for this address. Raises ConfigError without repeating keys."""
    try:
        import obstore.exceptions
        import obstore.store
    except ImportError as error:
        raise ConfigError(
            f"the blobs are in an object store, and its client is not installed ({error}): {add_extra('cluster')}"
        ) from error
    parts = urlsplit(address)
    if parts.scheme not in ("s3", "gs", "az") or not parts.netloc:
        raise ConfigError(
            f"blobs in {parts.scheme[:32]!r} are unknown: name a folder, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX, or"
            " az://CONTAINER/PREFIX"
        )
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise ConfigError(
            "the address of the blobs contains a key or an option, which other users of this machine can read: put keys"
            " into environment variables such as AWS_SECRET_ACCESS_KEY"
        )
    options: Any = {**_CLIENT, "allow_http": os.environ.get("AWS_ALLOW_HTTP", "").lower() == "true"}
    try:
        return obstore, obstore.store.from_url(address, client_options=options, retry_config=_RETRIES)
    except (obstore.exceptions.BaseError, ValueError) as error:
        raise ConfigError(f"{address}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    """The first line of the error without the queries of addresses, which may be signed, and the server's code."""
    text = str(error)
    first = re.sub(r"\?\S*", "", text.partition("\n")[0].partition("<?xml")[0])[:600].rstrip(": ")
    code = re.search(r"<Code>(\w{1,64})</Code>", text)
    return first + (f" ({code[1]})" if code else "")


def checked_blobs(named: str) -> Place:
    """The address or folder. Raises ConfigError when it cannot be used."""
    if "://" in named:
        _opened(named)
        return named
    check_writable(Path(named), "--blobs", may_be_full=True)
    return Path(os.path.abspath(named))


def blobs_of(
    root: Path,
    place: Place,
    where: Place | None = None,
    incarnation: Callable[[], int] | None = None,
    *,
    direct: bool = False,
) -> BlobStore:
    """The blobs of a state folder whose rows are at `place`. `where`: None for where they are recorded to be. `direct`:
    others read from the object store. Raises ConfigError."""
    where = where or place_of(root, BLOBS)
    if isinstance(where, Path):
        if direct:
            raise ConfigError("--direct-blobs: the blobs are in a folder; name an object store with --blobs")
        return BlobStore(where)
    blobs = ObjectBlobs(root / COPIES, where, place, incarnation)
    blobs.direct = direct
    return blobs
