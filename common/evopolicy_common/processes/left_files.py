"""Safely handles the files that an untrusted program left in a folder: lists them, and keeps them from other users.

Links are not followed, and pipes and devices are not opened, as opening a pipe can block forever. `left_files` does not
enter folders nested deeper than `MAX_DEPTH`, or beyond the system's longest path; `os.walk` would recurse into them.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

MAX_DEPTH = 64
_FOR_OTHERS = stat.S_ISUID | stat.S_ISGID | stat.S_IWOTH
_ATTRIBUTES = ("system.posix_acl_access", "system.posix_acl_default", "security.capability")
_ENTER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def left_files(root: Path, enter: Callable[[str], bool] = lambda name: True) -> Iterator[tuple[Path, int]]:
    """Yields regular files below `root` with their sizes (bytes), a folder's own first, by name. `enter`
    decides by its name whether a folder is entered. Skips unreadable entries."""
    waiting = [(str(root), 0)]
    while waiting:
        folder, depth = waiting.pop()
        folders = []
        names: list[str] = []
        with contextlib.suppress(OSError):
            names = sorted(os.listdir(folder))
        for name in names:
            path = os.path.join(folder, name)
            try:
                info = os.lstat(path)
            except OSError:
                continue
            if stat.S_ISREG(info.st_mode):
                yield Path(path), info.st_size
            elif stat.S_ISDIR(info.st_mode) and depth < MAX_DEPTH and enter(name):
                folders.append((path, depth + 1))
        waiting += reversed(folders)


def keep_to_owner(root: Path) -> int:
    """Takes from everything in `root` what serves other users: set-id bits, write permission for everybody, access
    control lists, capabilities, other owners. Removes sockets, pipes and devices, and gives the owner all rights on
    folders.

    Returns how many entries this user may not change, as they belong to others. Nothing may change the folder
    meanwhile. A missing folder is no error.
    """
    try:
        owner = root.lstat().st_uid
    except FileNotFoundError:
        return 0
    refused = 0
    at = os.open(root.parent, _ENTER & ~os.O_NOFOLLOW)
    # Without recursion, and with one open folder at a time: a program may nest more of them than a process may open.
    waiting = [(os.fstat(at), [root.name])]
    try:
        while waiting[-1][1] or len(waiting) > 1:
            if waiting[-1][1]:
                name = waiting[-1][1].pop()
                try:
                    if not _kept_to(owner, name, at):
                        continue
                    inner = os.open(name, _ENTER, dir_fd=at)
                except OSError as error:
                    refused += error.errno != errno.ENOENT
                    continue
                waiting.append((os.fstat(inner), os.listdir(inner)))
            else:
                waiting.pop()
                inner = os.open("..", _ENTER, dir_fd=at)
                # Another folder: a program that is still alive has moved this one.
                if not os.path.samestat(os.fstat(inner), waiting[-1][0]):
                    os.close(inner)
                    return refused + 1
            os.close(at)
            at = inner
    finally:
        os.close(at)
    return refused


def _kept_to(owner: int, name: str, folder: int) -> bool:
    """Keeps one entry to its owner, and returns whether it is a folder."""
    entry = os.open(name, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    try:
        info = os.fstat(entry)
        is_folder = stat.S_ISDIR(info.st_mode)
        if stat.S_ISLNK(info.st_mode):
            return False
        if not is_folder and not stat.S_ISREG(info.st_mode):
            os.unlink(name, dir_fd=folder)
            return False
        path = f"/proc/self/fd/{entry}"
        if info.st_uid != owner:
            os.chown(path, owner, -1)
        mode = stat.S_IMODE(info.st_mode)
        kept = mode & ~_FOR_OTHERS | (stat.S_IRWXU if is_folder else 0)
        if kept != mode:
            os.chmod(path, kept)
        for attribute in _attributes(path) & {*_ATTRIBUTES}:
            os.removexattr(path, attribute)
        return is_folder
    finally:
        os.close(entry)


def _attributes(path: str) -> set[str]:
    try:
        return {*os.listxattr(path)}
    except OSError as error:
        if error.errno != errno.ENOTSUP:
            raise
        return set()
