"""Policy bundles: packs a snapshot of `system/` into one blob, and unpacks that blob into a folder.

A bundle is the msgpack list of `[path, executable, bytes]`, sorted by path, so equal folders give equal bytes and an
equal digest. It is not compressed, as the digest must not depend on a compressor's version. Both directions treat their
input as hostile: a snapshot opens every path component without following links and takes regular files only; unpacking
accepts plain relative paths only.
"""

from __future__ import annotations

import functools
import itertools
import os
import stat
from collections.abc import Callable, Collection
from pathlib import Path, PurePosixPath
from typing import TypeVar

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, BundleError
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.regular_files import open_regular

T = TypeVar("T")

MAX_FILES = 2000
MAX_ENTRIES = 5000
"""Most files and folders in a snapshot's folder, ignored ones included: endless empty folders would stall it."""
MAX_BYTES = 64 << 20
"""Sum of the files' sizes, bytes."""
MAX_DEPTH = 16
MAX_PATH_BYTES = 240
IGNORED_FOLDERS = frozenset(
    {"__pycache__", ".git", ".mypy_cache", ".ruff_cache", ".pytest_cache", ".ipynb_checkpoints"}
)
"""Folders that tools create; never part of a bundle."""
COMPILED = ".pyc"
"""How compiled code ends, which Python may load in place of the source that readers see; never part of a bundle
either."""


class BundleFile(msgspec.Struct, frozen=True, array_like=True):
    """One file of a bundle."""

    path: str
    """Relative to `system/`, with forward slashes."""
    executable: bool
    data: bytes


class Bundle(msgspec.Struct, frozen=True):
    """A snapshot: its digest (SHA-256 of `packed`), its bytes and its files."""

    digest: str
    packed: bytes
    files: tuple[BundleFile, ...]


_files_decoder = msgspec.msgpack.Decoder(tuple[BundleFile, ...])


def snapshot(folder: Path, leave_out: Collection[str] = ()) -> Bundle:
    """The bundle of `folder` now, without its top-level entries named in `leave_out`.

    Raises BundleError with the path, the value and the limit for links, devices, sockets, file names that are not
    portable, and exceeded limits. Nothing outside `folder` is read, even if `folder` changes meanwhile.
    """
    reader = _Reader(leave_out)
    try:
        root = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError as error:
        raise BundleError(f"{folder.name}/ is not a folder that can be read: {error.strerror}") from error
    try:
        reader.collect(root, PurePosixPath())
    finally:
        os.close(root)
    return pack(reader.files)


def pack(files: list[BundleFile]) -> Bundle:
    """The bundle of these files; their order does not matter."""
    ordered = tuple(sorted(files, key=lambda file: file.path))
    packed = msgspec.msgpack.encode(ordered)
    return Bundle(digest_of(packed), packed, ordered)


def load(packed: bytes, digest: str) -> Bundle:
    """The bundle in `packed`. Raises BundleError when it is damaged, too large, or does not match `digest`."""
    if digest_of(packed) != digest:
        raise BundleError(f"bundle is not {digest}")
    try:
        files = _files_decoder.decode(packed)
    except DECODE_ERRORS as error:
        raise BundleError(f"not a bundle: {error}") from error
    _check(files)
    return Bundle(digest, packed, files)


def unpack(bundle: Bundle, folder: Path) -> None:
    """Writes the bundle's files below `folder`, which must not exist yet."""
    _check(bundle.files)
    folder.mkdir(parents=True)
    for file in bundle.files:
        path = folder / file.path
        path.parent.mkdir(parents=True, exist_ok=True)
        fd = os.open(
            path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o755 if file.executable else 0o644
        )
        with os.fdopen(fd, "wb") as out:
            out.write(file.data)


class _Reader:
    """Reads a folder tree under the limits."""

    def __init__(self, leave_out: Collection[str]) -> None:
        self.files: list[BundleFile] = []
        self._leave_out = leave_out
        self._left = MAX_BYTES
        self._entries_left = MAX_ENTRIES

    def collect(self, fd: int, base: PurePosixPath) -> None:
        if len(base.parts) > MAX_DEPTH:
            raise BundleError(f"{base}: folders nest deeper than {MAX_DEPTH}; flatten them")
        with os.scandir(fd) as entries:
            names = sorted(entry.name for entry in itertools.islice(entries, self._entries_left + 1))
        self._entries_left -= len(names)
        if self._entries_left < 0:
            raise BundleError(f"system/ holds more than {MAX_ENTRIES} files and folders; remove some")
        for name in names:
            path = base / name
            if name in self._leave_out and not base.parts:
                continue
            check_path(_text(path))
            mode = os.stat(name, dir_fd=fd, follow_symlinks=False).st_mode
            if stat.S_ISDIR(mode):
                if name not in IGNORED_FOLDERS:
                    # O_NOFOLLOW: a hostile agent may replace the entry with a link between the stat and the open.
                    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
                    child = _opened(path, functools.partial(os.open, name, flags, dir_fd=fd))
                    try:
                        self.collect(child, path)
                    finally:
                        os.close(child)
            elif not stat.S_ISREG(mode):
                raise BundleError(
                    f"{path} is a {_kind(mode)}; system/ may hold regular files and folders only: remove it"
                )
            elif not name.endswith(COMPILED):
                self.files.append(self._read(name, fd, path))

    def _read(self, name: str, folder_fd: int, path: PurePosixPath) -> BundleFile:
        if len(self.files) >= MAX_FILES:
            raise BundleError(f"system/ holds more than {MAX_FILES} files; pack data into fewer")
        with _opened(path, functools.partial(open_regular, name, folder_fd)) as file:
            info = os.fstat(file.fileno())
            if info.st_nlink > 1:
                raise BundleError(f"{path} is a hard link to another file; copy the file instead")
            data = file.read(self._left + 1) if info.st_size <= self._left else b""
            size = max(info.st_size, len(data))
        if size > self._left:
            raise BundleError(
                f"{path} has {size:,} bytes; all files of system/ together may have {MAX_BYTES:,}"
                f" and {self._left:,} are left: make it smaller or remove it"
            )
        self._left -= len(data)
        return BundleFile(_text(path), bool(info.st_mode & stat.S_IXUSR), data)


def _opened(path: PurePosixPath, opened: Callable[[], T]) -> T:
    try:
        return opened()
    except OSError as error:
        raise BundleError(
            f"{path} cannot be read: {error.strerror}; was it changed during the submit?"
        ) from error


def _text(path: PurePosixPath) -> str:
    try:
        text = str(path)
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise BundleError(f"file name {str(path)!a} is not UTF-8; rename it") from error
    return text


def _check(files: tuple[BundleFile, ...]) -> None:
    if len(files) > MAX_FILES:
        raise BundleError(f"bundle holds {len(files)} files, limit {MAX_FILES}")
    total = sum(len(file.data) for file in files)
    if total > MAX_BYTES:
        raise BundleError(f"bundle holds {total:,} bytes, limit {MAX_BYTES:,}")
    for file in files:
        check_path(file.path)
        if file.path.endswith(COMPILED):
            raise BundleError(f"{file.path!a} is compiled code, which may differ from its source; remove it")
    names = [file.path for file in files]
    if len(set(names)) != len(names):
        raise BundleError("bundle names a path twice")


def check_path(path: str) -> None:
    """Raises BundleError for anything but a plain relative path of a bearable length."""
    parts = path.split("/")
    if path.startswith("/") or any(part in ("", ".", "..") for part in parts) or "\0" in path or "\\" in path:
        raise BundleError(f"{path!a} is not a plain relative path; rename it")
    if len(path.encode("utf-8", "surrogateescape")) > MAX_PATH_BYTES or len(parts) > MAX_DEPTH + 1:
        raise BundleError(
            f"{path[:80]!a}… is longer than {MAX_PATH_BYTES} bytes or nests too deep; rename it"
        )


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFLNK: "symbolic link",
        stat.S_IFIFO: "named pipe",
        stat.S_IFSOCK: "socket",
        stat.S_IFCHR: "character device",
        stat.S_IFBLK: "block device",
    }
    return kinds.get(stat.S_IFMT(mode), "special file")
