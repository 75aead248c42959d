"""Reads files that others wrote or named.

Rules that this module owns: such a file is a regular one of a bearable size, as to open a pipe would wait for its
writer forever, and a device may have no end. Below a folder whose names agents write (`Confined`), no link is followed,
in no component of a path.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from evopolicy_common.errors import ConfigError, raised_as

MAX_BYTES = 64 << 20
"""Limit of records, sources and logs, bytes."""


def open_regular(path: Path | str, dir_fd: int | None = None, *, links: bool = False) -> BinaryIO:
    """Opens a file. Raises OSError for anything but a regular file, and without `links` for a link, which may lead
    anywhere. Links among the folders on the way are the caller's."""
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW)
    try:
        fd = os.open(path, flags, dir_fd=dir_fd)
    except OSError as error:
        if error.errno == errno.ELOOP and not links:
            raise OSError(errno.ELOOP, "a link; put the file itself in its place", str(path)) from error
        raise
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return os.fdopen(fd, "rb")


def read_regular(
    path: Path | str, most: int = MAX_BYTES, *, dir_fd: int | None = None, links: bool = False
) -> bytes:
    """The bytes of a file. Raises OSError as `open_regular`, and for one of more than `most` bytes."""
    with open_regular(path, dir_fd, links=links) as file:
        # The file may have holes, and may grow while it is read.
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1) if size <= most else b""
        if len(data) > size:
            data += file.read(most + 1 - len(data))
    if max(size, len(data)) > most:
        raise OSError(errno.EFBIG, f"larger than {most:,} bytes, the limit", str(path))
    return data


def read_given(path: Path, name: str, most: int = MAX_BYTES) -> bytes:
    """The bytes of a file that the user names, also by a link. Raises ConfigError, which calls the file `name`."""
    remedy = "name a regular file that this user may read"
    with raised_as(ConfigError, f"{name} cannot be read", OSError, ValueError, remedy=remedy):
        return read_regular(path, most, links=True)


_MAX_DEPTH = 64
MAX_NAMES = 5000
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class NotThereError(Exception):
    """There is no such file or folder, or it is none that may be read."""


class Name(NamedTuple):
    name: str
    is_folder: bool
    size: int
    """Bytes; 0 for a folder."""


class Confined:
    """Files below `root`, which is trusted itself. Paths are relative, with `/`."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def open(self, path: str) -> int:
        """A descriptor of a regular file, for the caller to close. NotThereError for a refused path."""
        try:
            with self._within(path) as (folder, name), open_regular(name, dir_fd=folder) as file:
                return os.dup(file.fileno())
        except (OSError, ValueError) as error:
            raise NotThereError(path) from error

    def read_file(self, path: str, limit: int) -> bytes:
        """At most `limit` bytes of a regular file; empty for a refused path."""
        try:
            with os.fdopen(self.open(path), "rb") as file:
                return file.read(limit)
        except NotThereError:
            return b""

    def whole(self, path: str, most: int) -> bytes:
        """A regular file's bytes. Raises OSError for a refused path, and for a file of more than `most` bytes."""
        with self._within(path) as (folder, name):
            return read_regular(name, most, dir_fd=folder)

    def names(self, path: str, most: int = MAX_NAMES) -> list[Name]:
        """At most `most` regular files and folders of a folder, by name; links and all else are left out. Empty for
        a refused path."""
        names: list[Name] = []
        with (
            contextlib.suppress(OSError, ValueError),
            self._within(f"{path}/x") as (folder, _),
            os.scandir(folder) as entries,
        ):
            for entry in itertools.islice(entries, most):
                with contextlib.suppress(OSError):
                    info = entry.stat(follow_symlinks=False)
                    is_folder = stat.S_ISDIR(info.st_mode)
                    if is_folder or stat.S_ISREG(info.st_mode):
                        names.append(Name(entry.name, is_folder, 0 if is_folder else info.st_size))
        return sorted(names)

    @contextlib.contextmanager
    def _within(self, path: str) -> Iterator[tuple[int, str]]:
        """A descriptor of the folder of a path, and the name in it. Raises OSError."""
        *folders, name = path.split("/")
        if len(folders) > _MAX_DEPTH or any(
            each in ("", ".", "..") or "\0" in each for each in (*folders, name)
        ):
            raise OSError(errno.EINVAL, "not a path below the folder", path)
        with contextlib.ExitStack() as opened:
            fd = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            opened.callback(os.close, fd)
            for each in folders:
                fd = os.open(each, _FOLDER, dir_fd=fd)
                opened.callback(os.close, fd)
            yield fd, name
