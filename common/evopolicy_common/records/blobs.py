"""Bytes on disk under the SHA-256 of their content.

Rules: a blob that is there is whole (written beside, fsynced, then renamed); bytes are checked against their digest when
read back; writing what is already there changes nothing. Chunked writes of one blob go in order and may be given up and
begun again at any time.
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

from evopolicy_common.errors import StorageError

MAX_UNFINISHED = 16
"""Uploads that one sender may have begun and not finished; beyond that its oldest is given up."""

_DIGEST = re.compile(r"[0-9a-f]{64}")


def digest_of(data: bytes) -> str:
    """SHA-256 of `data`, lowercase hex."""
    return hashlib.sha256(data).hexdigest()


def is_digest(text: str) -> bool:
    """Whether `text` can be a digest; anything else must never reach a path."""
    return _DIGEST.fullmatch(text) is not None


def fsync_directory(path: Path) -> None:
    """Makes the directory's entries (a rename, a new file) durable."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_filesystem(path: Path) -> None:
    """Makes all that was written so far on the file system that holds the directory durable: one flush for many files.

    OSError when something could not be written.
    """
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
        if syncfs is None:
            # Not Linux.
            os.sync()
        elif syncfs(fd) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))
    finally:
        os.close(fd)


def write_atomically(path: Path, data: bytes, *, mode: int = 0o644, durable: bool = True) -> None:
    """Replaces `path` by a file with `data`: readers see the old bytes or the new, never a part.

    Raises StorageError naming the path when the disk refuses.
    """
    try:
        fd, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error
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


class BlobStore:
    """A folder of blobs. Safe for several threads and processes, as every write ends in a rename."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._parts = root / "parts"
        self._parts.mkdir(parents=True, exist_ok=True)

    def path(self, digest: str) -> Path:
        """Where the blob is or would be; ValueError for what is no digest."""
        if not is_digest(digest):
            raise ValueError(f"not a SHA-256 digest: {digest[:80]!r}")
        return self._root / digest[:2] / digest

    def has(self, digest: str) -> bool:
        """Whether the blob is stored, whole."""
        return self.path(digest).is_file()

    def size(self, digest: str) -> int:
        """Size in bytes; StorageError when the blob is not there."""
        try:
            return self.path(digest).stat().st_size
        except OSError as error:
            raise StorageError(f"blob {digest} is not in {self._root}") from error

    def put(self, data: bytes, *, durable: bool = True) -> str:
        """Stores `data` and returns its digest."""
        digest = digest_of(data)
        path = self.path(digest)
        if not path.is_file():
            self._make_parent(path)
            write_atomically(path, data, durable=durable)
        return digest

    def read(self, digest: str) -> bytes:
        """The blob's bytes, checked; StorageError when it is missing or damaged (and then set aside)."""
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
        """At most `n` bytes from `offset` on, unchecked: the receiver checks the whole."""
        try:
            with self.path(digest).open("rb") as file:
                file.seek(offset)
                return file.read(n)
        except OSError as error:
            raise StorageError(f"blob {digest} is not in {self._root}") from error

    def append_chunk(
        self,
        sender: str,
        digest: str,
        size: int,
        offset: int,
        data: bytes,
        on_whole: Callable[[], None] | None = None,
    ) -> int:
        """Adds one chunk of a blob that `sender` is uploading and returns how many bytes are there now.

        A chunk that does not continue what is there changes nothing: the answer tells where to go on. The last one
        checks the digest and puts the blob in place; StorageError when the bytes are another blob's.
        `on_whole` is called once the sender has sent all bytes of the blob; with it, what is here already counts for nothing.
        """
        if on_whole is None and self.has(digest):
            # Young again: who collects what nobody names leaves the young alone.
            with contextlib.suppress(OSError):
                os.utime(self.path(digest))
            return size
        part = self._parts / f"{digest_of(sender.encode())[:16]}-{digest}"
        try:
            have = part.stat().st_size if part.exists() else 0
            if offset == 0 and have:
                part.unlink()
                have = 0
            if offset == 0 and len(data) < size:
                self._make_room(part)
            if offset != have or offset + len(data) > size:
                return have
            with part.open("ab") as file:
                file.write(data)
                have += len(data)
                if have == size:
                    file.flush()
                    os.fsync(file.fileno())
        except OSError as error:
            raise StorageError(f"cannot write blob {digest}: {error.strerror or error}") from error
        if have == size:
            self._finish(part, digest)
            if on_whole is not None:
                on_whole()
        return have

    def drop_unfinished(self) -> None:
        """Forgets uploads that were begun and not finished; their senders begin again."""
        for part in self._parts.iterdir():
            part.unlink(missing_ok=True)

    def delete(self, digest: str) -> int:
        """Removes the blob and returns the bytes freed; 0 when it was not there."""
        path = self.path(digest)
        try:
            size = path.stat().st_size
            path.unlink()
        except FileNotFoundError:
            return 0
        return size

    def digests(self) -> Iterator[str]:
        """All blobs, in no particular order."""
        for folder in self._root.iterdir():
            if len(folder.name) == 2:
                yield from (path.name for path in folder.iterdir() if is_digest(path.name))

    def _make_room(self, part: Path) -> None:
        """Gives up the oldest unfinished uploads of a sender that has begun too many."""
        begun = [each for each in self._parts.glob(f"{part.name.partition('-')[0]}-*") if each != part]
        for old in sorted(begun, key=lambda each: each.stat().st_mtime)[
            : max(0, len(begun) + 1 - MAX_UNFINISHED)
        ]:
            old.unlink(missing_ok=True)

    def _finish(self, part: Path, digest: str) -> None:
        if digest_of(part.read_bytes()) != digest:
            part.unlink()
            raise StorageError(f"uploaded bytes are not blob {digest}; upload it again")
        path = self.path(digest)
        self._make_parent(path)
        os.replace(part, path)
        fsync_directory(path.parent)

    def _make_parent(self, path: Path) -> None:
        if not path.parent.is_dir():
            try:
                path.parent.mkdir(exist_ok=True)
                fsync_directory(self._root)
            except OSError as error:
                raise StorageError(f"cannot write {path.parent}: {error.strerror or error}") from error
