"""Folders in the system's temporary folder that are thrown away, also after their owner was killed.

Rules: a folder belongs to the process that holds the lock on its file `owner`, from before that file has its name; it goes
with the owner, or at the next start of anything of its kind by the same user. Short paths, for unix sockets.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

_OWNER = "owner"


@contextlib.contextmanager
def scratch_folder(kind: str) -> Iterator[Path]:
    """A new private folder `evopolicy-<kind>-…` inside the `with`; clears away what killed owners have left."""
    clear_stale(kind)
    root = Path(tempfile.mkdtemp(prefix=f"evopolicy-{kind}-"))
    lock = -1
    try:
        lock = _own(root)
        yield root
    finally:
        shutil.rmtree(root, ignore_errors=True)
        if lock >= 0:
            os.close(lock)


def clear_stale(kind: str) -> int:
    """Removes this user's folders of that kind whose owner is gone, and returns how many."""
    cleared = 0
    for root in Path(tempfile.gettempdir()).glob(f"evopolicy-{kind}-*"):
        with contextlib.suppress(OSError):
            if root.is_symlink() or root.lstat().st_uid != os.getuid():
                continue
            lock = os.open(root / _OWNER, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(root, ignore_errors=True)
                cleared += 1
            finally:
                os.close(lock)
    return cleared


def _own(root: Path) -> int:
    """The lock on the folder, held until it is closed."""
    unnamed = root / f".{_OWNER}"
    lock = os.open(unnamed, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)
    unnamed.rename(root / _OWNER)
    return lock
