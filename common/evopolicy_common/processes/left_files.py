"""The files that a program which nobody trusts has left in a folder, found without being led astray.

Links are not followed, pipes and devices are left out, and folders that nest deeper than `MAX_DEPTH` (or than a path may be
long) are not gone into: `os.walk` recurses, and a path that leads to a pipe is opened for ever.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

MAX_DEPTH = 64


def left_files(root: Path, enter: Callable[[str], bool] = lambda name: True) -> Iterator[tuple[Path, int]]:
    """Regular files below `root` with their sizes: a folder's own by name, then those of its folders, by name.

    `enter` tells by its name whether a folder is gone into. What cannot be read is left out.
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
