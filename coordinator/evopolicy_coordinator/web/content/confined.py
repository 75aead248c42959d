"""Files below one folder, read without being led out of it.

Agents write the names and the files in a run directory. No link is followed, in no component of a path; pipes and
devices are not opened; every read has a limit.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import stat
from pathlib import Path
from typing import NamedTuple

from evopolicy_common.regular_files import open_regular

_MAX_DEPTH = 64
_MAX_NAMES = 5000
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class NotThereError(Exception):
    """There is no such file or folder, or it is none that may be read."""


class Name(NamedTuple):
    """One entry of a folder."""

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
        *folders, name = _parts(path)
        folder = self._folder(folders)
        try:
            with open_regular(name, dir_fd=folder) as file:
                return os.dup(file.fileno())
        except (OSError, ValueError) as error:
            raise NotThereError(path) from error
        finally:
            os.close(folder)

    def read(self, path: str, limit: int) -> bytes:
        """At most `limit` bytes of a regular file; empty for a refused path."""
        try:
            with os.fdopen(self.open(path), "rb") as file:
                return file.read(limit)
        except NotThereError:
            return b""

    def names(self, path: str) -> list[Name]:
        """Regular files and folders of a folder, by name, the first few thousand; links and all else are left
        out. Empty for a refused path."""
        names: list[Name] = []
        with contextlib.suppress(NotThereError, OSError):
            folder = self._folder(_parts(path))
            try:
                with os.scandir(folder) as entries:
                    for entry in itertools.islice(entries, _MAX_NAMES):
                        with contextlib.suppress(OSError):
                            info = entry.stat(follow_symlinks=False)
                            is_folder = stat.S_ISDIR(info.st_mode)
                            if is_folder or stat.S_ISREG(info.st_mode):
                                names.append(Name(entry.name, is_folder, 0 if is_folder else info.st_size))
            finally:
                os.close(folder)
        return sorted(names)

    def _folder(self, parts: list[str]) -> int:
        try:
            fd = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise NotThereError(str(self.root)) from error
        for part in parts:
            try:
                below = os.open(part, _FOLDER, dir_fd=fd)
            except (OSError, ValueError) as error:
                raise NotThereError("/".join(parts)) from error
            finally:
                os.close(fd)
            fd = below
        return fd


def _parts(path: str) -> list[str]:
    parts = path.split("/")
    if len(parts) > _MAX_DEPTH or any(part in ("", ".", "..") or "\0" in part for part in parts):
        raise NotThereError(path)
    return parts
