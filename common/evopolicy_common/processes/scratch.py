"""Folders in the system's temporary folder that are deleted even if their owner was killed.

Rules: a folder belongs to the process that holds the lock on its file `owner`; the lock is taken before the file gets
that name. The folder is deleted by its owner, or at the next start of a command of the same kind and user. A folder
without the file, whose creator was killed early, is deleted once it is a minute old. Paths are short, for unix sockets.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from evopolicy_common.processes.preflight import check_scratch

_OWNER = "owner"
_MAKING_S = 60.0
"""More than the time between creation of the folder and its file, seconds."""


@contextlib.contextmanager
def scratch_folder(kind: str) -> Iterator[Path]:
    """A new private folder `evopolicy-<kind>-…`; deletes those of killed owners. Raises MachineError."""
    check_scratch()
    clear_stale(kind)
    root = Path(tempfile.mkdtemp(prefix=f"evopolicy-{kind}-"))
    lock = -1
    try:
        unnamed = root / f".{_OWNER}"
        lock = os.open(unnamed, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        fcntl.flock(lock, fcntl.LOCK_EX)
        unnamed.rename(root / _OWNER)
        yield root
    finally:
        remove_tree(root)
        if lock >= 0:
            os.close(lock)


def clear_stale(kind: str) -> int:
    """Deletes this user's folders of that kind whose owner is gone, and returns their number."""
    cleared = 0
    for root in Path(tempfile.gettempdir()).glob(f"evopolicy-{kind}-*"):
        with contextlib.suppress(OSError):
            if root.is_symlink() or root.lstat().st_uid != os.getuid():
                continue
            try:
                lock = os.open(root / _OWNER, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            except FileNotFoundError:
                if time.time() - root.lstat().st_mtime > _MAKING_S:
                    remove_tree(root)
                    cleared += 1
                continue
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_tree(root)
                cleared += 1
            finally:
                os.close(lock)
    return cleared


def remove_tree(folder: Path) -> None:
    """Deletes a folder and its content, as far as this user may; never raises for its content, which may nest
    deeper than Python recurses or lack permissions. Nothing may change the folder meanwhile."""
    with contextlib.suppress(RecursionError):
        shutil.rmtree(folder, ignore_errors=True)
    if folder.exists() and not folder.is_symlink():
        with contextlib.suppress(OSError):
            _flatten_away(folder)


def give_back_rights(folder: Path) -> None:
    """Restores this user's permissions to list, enter and write its own folder; a missing one is no error."""
    with contextlib.suppress(FileNotFoundError):
        mode = stat.S_IMODE(folder.stat().st_mode)
        if mode & stat.S_IRWXU != stat.S_IRWXU:
            folder.chmod(mode | stat.S_IRWXU)


def _flatten_away(folder: Path) -> None:
    """Deletes nested folders without recursion: moves their content up into `folder`, level by level."""
    folder.chmod(0o700)
    root = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fresh = (f"{secrets.token_hex(8)}-{n}" for n in itertools.count())
        names = os.listdir(root)
        while names:
            name = names.pop()
            if not _is_folder(name, root):
                os.unlink(name, dir_fd=root)
                continue
            os.chmod(name, 0o700, dir_fd=root)
            inner = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=root)
            try:
                for child in os.listdir(inner):
                    if _is_folder(child, inner):
                        # Moving a folder to another parent needs write permission on the folder.
                        os.chmod(child, 0o700, dir_fd=inner)
                    os.rename(child, here := next(fresh), src_dir_fd=inner, dst_dir_fd=root)
                    names.append(here)
            finally:
                os.close(inner)
            os.rmdir(name, dir_fd=root)
    finally:
        os.close(root)
    folder.rmdir()


def _is_folder(name: str, parent: int) -> bool:
    return stat.S_ISDIR(os.stat(name, dir_fd=parent, follow_symlinks=False).st_mode)
