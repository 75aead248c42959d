"""Safely lists the files that an untrusted program left in a folder.

Links are not followed, and pipes and devices are skipped, as opening a pipe can block forever. Folders nested deeper
than `MAX_DEPTH`, or beyond the system's longest path, are not entered; `os.walk` would recurse into them.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

MAX_DEPTH = 64


def left_files(root: Path, enter: Callable[[str], bool] = lambda name: True) -> Iterator[tuple[Path, int]]:
    """Yields regular files below `root` with their sizes (bytes): first a folder's own, then those of its folders, by
    name.

    `enter` decides by its name whether a folder is entered. Unreadable entries are skipped.
    """
    waiting = [(str(root), 0)]
    while waiting:
        folder, depth = waiting.pop()
        names = _names(folder)
        folders = []
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


def _names(folder: str) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []
