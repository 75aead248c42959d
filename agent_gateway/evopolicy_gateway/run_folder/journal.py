"""The gateway's journal: every request before it is sent, and its result. JSON lines, fsynced.

It lies outside the workspace. After a restart the gateway repeats, by key, every request without a result here, and
completes the feedback tree from the answers. An incomplete last line (from a machine crash) is cut off.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, StorageError, raised_as
from evopolicy_common.records.blobs import fsync_directory
from evopolicy_common.records.open_run import AnyLine, line_decoder


class AtWork:
    """Records which episodes' files are being made, so that the next process knows what this one died over.

    One small record per episode, written in place without fsync: it only has to survive the process, and costs
    microseconds.
    """

    _RECORD = 64

    def __init__(self, path: Path) -> None:
        """Reads the last process's records into `died_over`; journal them before the first call of `on`."""
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self.died_over: dict[str, list[int]] = {}
        """Request indices of episodes, by the key of their submit."""
        data = os.pread(self._fd, 1 << 16, 0)
        for at in range(0, len(data), self._RECORD):
            record = data[at : at + self._RECORD].rstrip(b"\0").decode("ascii", "replace")
            key, _, index = record.partition(" ")
            if key and index.isdecimal():
                self.died_over.setdefault(key, []).append(int(index))
        self._lock = threading.Lock()
        self._free: list[int] = []
        self._n_records = 0

    def clear(self) -> None:
        """Removes the records, once they are in the journal."""
        os.ftruncate(self._fd, 0)

    @contextlib.contextmanager
    def on(self, key: str, index: int) -> Iterator[None]:
        """Marks the episode inside the `with`. Thread-safe."""
        with self._lock:
            if not self._free:
                self._free.append(self._n_records * self._RECORD)
                self._n_records += 1
            at = self._free.pop()
        record = f"{key} {index}".encode()[: self._RECORD]
        os.pwrite(self._fd, record.ljust(self._RECORD, b"\0"), at)
        try:
            yield
        finally:
            os.pwrite(self._fd, bytes(self._RECORD), at)
            self._free.append(at)

    def close(self) -> None:
        os.close(self._fd)


class Journal:
    """The journal's file, opened for appending. `append` blocks on the disk."""

    def __init__(self, path: Path) -> None:
        """Opens or creates the file. Raises StorageError when a line other than the last is damaged."""
        self._path = path
        self.at_work = AtWork(path.with_name("at-work"))
        """The episodes whose files are being made."""
        self.entries: dict[int, AnyLine] = {}
        """Its entries when it was opened, oldest first, by their file offsets for `read_line`."""
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._file = os.fdopen(fd, "r+b", buffering=0)
        try:
            self._load()
            fsync_directory(path.parent)
        except BaseException:
            self.close()
            raise

    def append(self, entry: AnyLine) -> int:
        """Appends an entry durably; returns its file offset, for `read_line`. Raises StorageError, with nothing added.

        The entry is not kept in memory: a run has thousands of episodes, and each answer lists its own.
        """
        start = self._file.seek(0, os.SEEK_END)
        try:
            write_all(self._file.fileno(), msgspec.json.encode(entry) + b"\n")
            os.fsync(self._file.fileno())
        except OSError as error:
            os.ftruncate(self._file.fileno(), start)
            raise StorageError(f"cannot write {self._path}: {error.strerror or error}") from error
        return start

    def read_line(self, place: int) -> AnyLine:
        with self._path.open("rb") as file:
            file.seek(place)
            entry: AnyLine = line_decoder.decode(file.readline())
            return entry

    def close(self) -> None:
        self._file.close()
        self.at_work.close()

    def _load(self) -> None:
        data = self._file.read() or b""
        whole = data.rfind(b"\n") + 1
        place = 0
        for number, line in enumerate(data[:whole].splitlines(keepends=True), start=1):
            with raised_as(StorageError, f"{self._path}, line {number}, is damaged", *DECODE_ERRORS):
                self.entries[place] = line_decoder.decode(line)
                place += len(line)
        if whole != len(data):
            os.ftruncate(self._file.fileno(), whole)


def write_all(fd: int, data: bytes) -> None:
    """Writes all bytes, in as many calls as it takes."""
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]
