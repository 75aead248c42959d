"""Bytes on disk under the SHA-256 of their content.

Rules: a stored blob is complete (written under another name, fsynced, then renamed). Bytes are checked against their
digest when read. Storing an existing blob changes nothing. The chunks of a blob are written in order; an upload may be
abandoned and restarted at any time.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from evopolicy_common.errors import ConfigError, StorageError, raised_as

MAX_UNFINISHED = 16
"""Most unfinished uploads of one sender; beyond it the sender's oldest is dropped."""

FileState = tuple[int | str, int]
"""Inode and time of the last change of a blob's file, or an object's name and mark: an upload of the same bytes changes
them."""

_DIGEST = re.compile(r"[0-9a-f]{64}")


def digest_of(data: bytes) -> str:
    """SHA-256 of `data`, lowercase hex."""
    return hashlib.sha256(data).hexdigest()


def is_digest(text: str) -> bool:
    """Whether `text` has the form of a digest; any other text must never become part of a path."""
    return _DIGEST.fullmatch(text) is not None


def fsync_directory(path: Path, sync: Callable[[int], object] = os.fsync) -> None:
    """Makes the directory's entries (a rename, a new file) durable."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        sync(fd)
    finally:
        os.close(fd)


def sync_filesystem(path: Path) -> None:
    """Makes all earlier writes to the directory's file system durable, with one flush. Raises OSError."""

    def sync(fd: int) -> None:
        syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
        if syncfs is None:
            os.sync()  # not Linux
        elif syncfs(fd) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))

    fsync_directory(path, sync)


def write_atomically(path: Path, data: bytes, *, mode: int = 0o644, durable: bool = True) -> None:
    """Replaces `path` by a file with `data`: readers see the old bytes or the new, never a part. Raises
    StorageError, and ConfigError when `path` is a pipe, a device or a folder."""
    with raised_as(StorageError, f"cannot write {path}", OSError):
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path} is not a regular file; name another")
        fd, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(fd, "wb") as file:
            file.write(data)
            os.fchmod(file.fileno(), mode)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(name, path)
        if durable:
            fsync_directory(path.parent)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error


@contextlib.contextmanager
def announcing(path: Path | None) -> Iterator[Callable[[bytes], None]]:
    """Yields a function that writes a private file at `path` (None: nowhere), removed at the end."""
    with contextlib.ExitStack() as written:

        def write(data: bytes) -> None:
            if path is not None:
                write_atomically(path, data, mode=0o600)
                written.callback(path.unlink, missing_ok=True)

        yield write


class BlobStore:
    """A folder of blobs. Safe for several threads and processes, as every write ends with a rename."""

    remote = False
    """Whether operations wait for other machines."""
    trouble = ""
    """Why the last operation on another machine failed; empty: it did not."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._parts = root / "parts"
        self._parts.mkdir(parents=True, exist_ok=True)

    def path(self, digest: str) -> Path:
        """The blob's path, stored or not. Raises ValueError for an invalid digest."""
        if not is_digest(digest):
            raise ValueError(f"not a SHA-256 digest: {digest[:80]!r}")
        return self._root / digest[:2] / digest

    def has(self, digest: str) -> bool:
        """Whether the complete blob is stored."""
        return self.path(digest).is_file()

    def hold(self, digest: str) -> int | None:
        """Size of the blob, which then counts as stored now; None when it is not stored."""
        return self.size(digest) if self._touched(digest) else None

    def size(self, digest: str) -> int:
        """Size in bytes. Raises StorageError when the blob is not stored."""
        try:
            return self.path(digest).stat().st_size
        except OSError as error:
            raise StorageError(f"blob {digest} is not in {self._root}") from error

    def put(self, data: bytes, *, durable: bool = True) -> str:
        """Stores `data` and returns its digest. A blob that is stored counts as stored now."""
        digest = digest_of(data)
        if not self._touched(digest):
            path = self.path(digest)
            self._make_parent(path)
            write_atomically(path, data, durable=durable)
        return digest

    def read_blob(self, digest: str) -> bytes:
        """The blob's bytes, checked. Raises StorageError when it is missing or damaged (a damaged file is renamed)."""
        path = self.path(digest)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise StorageError(f"blob {digest} is not in {self._root}") from error
        if digest_of(data) != digest:
            path.rename(path.with_suffix(".damaged"))
            raise StorageError(f"blob {digest} in {self._root} is damaged; set aside as {digest}.damaged")
        return data

    def read_chunk(self, digest: str, offset: int, n: int) -> bytes:
        """At most `n` bytes from `offset` on, unchecked: the receiver checks the whole blob."""
        try:
            with self.path(digest).open("rb") as file:
                file.seek(offset)
                return file.read(n)
        except OSError as error:
            raise StorageError(f"blob {digest} is not in {self._root}") from error

    def address(self, digest: str) -> str:
        """Where others may read the blob, for a short while; empty: nowhere."""
        return ""

    def append_chunk(
        self,
        sender: str,
        digest: str,
        size: int,
        offset: int,
        data: bytes,
        on_whole: Callable[[FileState | None], None] | None = None,
    ) -> int:
        """Appends one chunk of a blob that `sender` uploads and returns the number of bytes received so far.

        A chunk that does not continue them changes nothing; the returned offset is where to continue. The last chunk
        checks the digest and stores the blob; StorageError when the digest does not match.
        `on_whole` is called once the sender has sent the whole blob, with the state of its file, or None if the blob
        was stored before; with it, a copy stored before is ignored.
        """
        if on_whole is None and self._touched(digest):
            return size
        part = self._parts / f"{_folded(sender)}-{digest}"
        with raised_as(StorageError, f"cannot write blob {digest}", OSError):
            have = part.stat().st_size if part.exists() else 0
            if offset == 0 and have:
                part.unlink()
                have = 0
            if offset == 0 and len(data) < size:
                # A sender that has too many unfinished uploads loses its oldest.
                parts = self._parts.glob(f"{part.name.partition('-')[0]}-*")
                begun = [each for each in parts if each != part]
                begun.sort(key=lambda each: each.stat().st_mtime, reverse=True)
                for old in begun[MAX_UNFINISHED - 1 :]:
                    old.unlink(missing_ok=True)
            if offset == have and offset + len(data) <= size:
                with part.open("ab") as file:
                    file.write(data)
                    have += len(data)
                    if have == size:
                        file.flush()
                        os.fsync(file.fileno())
            elif offset + len(data) != have:
                return have
        if have == size:
            # Also when the last chunk is sent again: the blob may not have been stored the first time.
            is_new = not self.has(digest)
            state = self._finish(part, digest)
            if on_whole is not None:
                on_whole(state if is_new else None)
        return have

    def drop_unfinished(self, sender: str | None = None) -> None:
        """Deletes unfinished uploads, of all senders or of one; their senders start again."""
        for part in self._parts.glob("*" if sender is None else f"{_folded(sender)}-*"):
            part.unlink(missing_ok=True)

    def delete(self, digest: str, unless_changed: FileState | None = None) -> int:
        """Deletes the blob and returns its bytes; 0 when it is not stored, or in another state."""
        path = self.path(digest)
        try:
            status = path.stat()
            if unless_changed not in (None, _state(status)):
                return 0
            path.unlink()
        except FileNotFoundError:
            return 0
        return status.st_size

    def unheld(self, age_s: float, now: float, *, dry_run: bool = False) -> dict[str, FileState]:
        """The blobs that were last stored or held more than `age_s` seconds before `now`, in the state that `delete`
        takes. It is to be read afterwards which of them are named. `dry_run`: none will be deleted."""
        found: dict[str, FileState] = {}
        for digest in self.digests():
            with contextlib.suppress(FileNotFoundError):
                status = self.path(digest).stat()
                if status.st_mtime < now - age_s:
                    found[digest] = _state(status)
        return found

    def sizes(self) -> dict[str, int]:
        """Bytes of all blobs."""
        found: dict[str, int] = {}
        for digest in self.digests():
            with contextlib.suppress(StorageError):  # deleted meanwhile
                found[digest] = self.size(digest)
        return found

    def digests(self) -> Iterator[str]:
        """The digests of all blobs, in no particular order."""
        for folder in self._root.iterdir():
            if len(folder.name) == 2:
                yield from (path.name for path in folder.iterdir() if is_digest(path.name))

    def _touched(self, digest: str) -> bool:
        """Whether the blob is stored; then it is as if stored now, since young blobs are not collected."""
        if not self.has(digest):
            return False
        with contextlib.suppress(OSError):
            os.utime(self.path(digest))
        return True

    def _finish(self, part: Path, digest: str) -> FileState:
        """Stores the blob whose bytes are in `part`. Raises StorageError when they are others."""
        with part.open("rb") as file:
            actual = hashlib.file_digest(file, "sha256").hexdigest()
        if actual != digest:
            part.unlink()
            raise StorageError(f"uploaded bytes are not blob {digest}; upload it again")
        return self._keep(part, digest)

    def _keep(self, part: Path, digest: str) -> FileState:
        path = self.path(digest)
        self._make_parent(path)
        os.replace(part, path)
        fsync_directory(path.parent)
        return _state(path.stat())

    def _make_parent(self, path: Path) -> None:
        if not path.parent.is_dir():
            with raised_as(StorageError, f"cannot write {path.parent}", OSError):
                path.parent.mkdir(exist_ok=True)
                fsync_directory(self._root)


def _folded(sender: str) -> str:
    return digest_of(sender.encode())[:16]


def _state(status: os.stat_result) -> FileState:
    return status.st_ino, status.st_mtime_ns
