"""Policy bundles: packs a snapshot of `system/` into one blob, and unpacks that blob into a folder.

A bundle is the msgpack list of `[path, executable, bytes]`, sorted by path, so equal folders give equal bytes and an
equal digest. It is not compressed, as the digest must not depend on a compressor's version. Both directions treat their
input as hostile: a snapshot opens every path component without following links and takes regular files only; unpacking
accepts plain relative paths only.
"""

from __future__ import annotations

import itertools
import os
import stat
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, BundleError, raised_as
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.regular_files import open_regular

MAX_FILES = 2000
MAX_ENTRIES = 5000
"""Most files and folders in a snapshot's folder, ignored ones included: endless empty folders would stall it."""
MAX_BYTES = 64 << 20
"""Sum of the files' sizes, bytes."""
MAX_DEPTH = 16
MAX_PATH_BYTES = 240
FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
"""Opens a folder, and nothing else in its place."""
IGNORED_FOLDERS = frozenset(
    {"__pycache__", ".git", ".mypy_cache", ".ruff_cache", ".pytest_cache", ".ipynb_checkpoints"}
)
"""Folders that tools create; never part of a bundle."""
COMPILED = ".pyc"
"""Suffix of compiled code, which may differ from its source; never part of a bundle either."""


class BundleFile(msgspec.Struct, frozen=True, array_like=True):
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
    with raised_as(BundleError, f"{folder.name}/ is not a folder that can be read", OSError):
        root = os.open(folder, FOLDER)
    files: list[BundleFile] = []
    free = MAX_BYTES
    try:
        for path, file in walk(root, leave_out, MAX_ENTRIES):
            if isinstance(file, str):
                raise BundleError(f"{path or 'system/'} {file}")
            with file:
                info = os.fstat(file.fileno())
                data = file.read(free + 1) if info.st_size <= free else b""
            if len(files) == MAX_FILES:
                raise BundleError(f"system/ holds more than {MAX_FILES} files; pack data into fewer")
            size = max(info.st_size, len(data))
            if size > free:
                raise BundleError(
                    f"{path} has {size:,} bytes; all files of system/ together may have {MAX_BYTES:,}"
                    f" and {free:,} are left: make it smaller or remove it"
                )
            free -= size
            files.append(BundleFile(path, bool(info.st_mode & stat.S_IXUSR), data))
    finally:
        os.close(root)
    return pack(files)


_KINDS = {
    stat.S_IFDIR: f"folder that nests deeper than {MAX_DEPTH}",
    stat.S_IFLNK: "symbolic link",
    stat.S_IFIFO: "named pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "character device",
    stat.S_IFBLK: "block device",
}


def walk(root: int, leave_out: Collection[str], most: int) -> Iterator[tuple[str, BinaryIO | str]]:
    """The regular files below an open folder, open, by path; the reason in place of one that is left out.

    Neither follows a link nor opens anything but regular files and folders. `leave_out`: entries of the folder
    itself to pass over, as files and folders that tools make are. `most`: files and folders to look at.
    """
    remaining = most

    def below(fd: int, base: str, depth: int) -> Iterator[tuple[str, BinaryIO | str]]:
        nonlocal remaining
        with os.scandir(fd) as entries:
            names = sorted(entry.name for entry in itertools.islice(entries, remaining + 1))
        if len(names) > remaining:
            yield base, f"holds more than {most} files and folders; remove some"
            return
        remaining -= len(names)
        for name in names:
            path = f"{base}/{name}" if base else name
            if not base and name in leave_out:
                continue
            try:
                check_path(path)
                mode = os.stat(name, dir_fd=fd, follow_symlinks=False).st_mode
                is_folder = stat.S_ISDIR(mode)
                is_file = stat.S_ISREG(mode)
                if (is_folder and name in IGNORED_FOLDERS) or (is_file and name.endswith(COMPILED)):
                    continue
                if is_file:
                    # Not followed: a hostile agent may replace the entry with a link after the stat.
                    file = open_regular(name, fd)
                    if linked := os.fstat(file.fileno()).st_nlink > 1:
                        file.close()
                    yield path, "is a hard link to another file; copy the file instead" if linked else file
                    continue
                if not is_folder or depth == MAX_DEPTH:
                    kind = _KINDS.get(stat.S_IFMT(mode), "special file")
                    yield path, f"is a {kind}, and only regular files and folders may be here: remove it"
                    continue
                inner = os.open(name, FOLDER, dir_fd=fd)
            except OSError as error:
                yield path, f"cannot be read: {error.strerror}; was it changed during the snapshot?"
                continue
            except BundleError as error:
                yield ascii(path)[1:-1][:MAX_PATH_BYTES], f"has a name that cannot be taken: {error}"[:400]
                continue
            try:
                yield from below(inner, path, depth + 1)
            finally:
                os.close(inner)

    return below(root, "", 0)


def pack(files: list[BundleFile]) -> Bundle:
    """The bundle of these files; their order does not matter."""
    ordered = tuple(sorted(files, key=lambda file: file.path))
    packed = msgspec.msgpack.encode(ordered)
    return Bundle(digest_of(packed), packed, ordered)


def load(packed: bytes, digest: str) -> Bundle:
    """The bundle in `packed`. Raises BundleError when it is damaged, too large, or does not match `digest`."""
    if digest_of(packed) != digest:
        raise BundleError(f"bundle is not {digest}")
    with raised_as(BundleError, "not a bundle", *DECODE_ERRORS):
        files = _files_decoder.decode(packed)
    _check(files)
    return Bundle(digest, packed, files)


def unpack(bundle: Bundle, folder: Path) -> None:
    """Writes the bundle's files below `folder`, which must not exist yet."""
    _check(bundle.files)
    folder.mkdir(parents=True)
    for file in bundle.files:
        write_new(folder / file.path, file.data, 0o755 if file.executable else 0o644)


def write_new(path: Path, data: bytes, mode: int) -> None:
    """Writes a file that must not exist, and makes its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, mode)
    with os.fdopen(fd, "wb") as out:
        out.write(data)


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
    if len({file.path for file in files}) != len(files):
        raise BundleError("bundle names a path twice")


def check_path(path: str) -> None:
    """Raises BundleError for anything but a plain relative path in UTF-8 of a bearable length."""
    parts = path.split("/")
    if any(part in ("", ".", "..") for part in parts) or "\0" in path or "\\" in path:
        raise BundleError(f"{path!a} is not a plain relative path; rename it")
    try:
        size = len(path.encode())
    except UnicodeEncodeError as error:
        raise BundleError(f"{path!a} is not UTF-8; rename it") from error
    if size > MAX_PATH_BYTES or len(parts) > MAX_DEPTH + 1:
        raise BundleError(
            f"{path[:80]!a}… is longer than {MAX_PATH_BYTES} bytes or nests too deep; rename it"
        )
