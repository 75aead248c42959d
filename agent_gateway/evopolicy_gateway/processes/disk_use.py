"""The disk space that an agent's files take, which the agent may change meanwhile.

Space counts, not length: a sparse file takes little. Each file and folder counts at least `LEAST_BYTES`,
since file systems have a bounded number of them. Deleted files count while a process of the agent has them
open.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable
from pathlib import Path

LEAST_BYTES = 4096
MAX_DEPTH = 256
_BLOCK = 512
_ENTER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class TooDeepError(Exception):
    """Folders are nested deeper than `MAX_DEPTH`."""


def used_bytes(folders: Iterable[Path], skipped: Path, pids: Iterable[int]) -> int:
    """Space of all in `folders` without `skipped`, and of deleted files that `pids` have open. Raises
    TooDeepError."""
    counted: set[tuple[int, int]] = set()
    total, devices = 0, set()
    for folder in folders:
        with contextlib.suppress(OSError):
            devices.add(os.stat(folder).st_dev)
            total += _below(folder, skipped, counted)
    for pid in pids:
        with contextlib.suppress(OSError):
            for name in os.listdir(f"/proc/{pid}/fd"):
                with contextlib.suppress(OSError):
                    info = os.stat(f"/proc/{pid}/fd/{name}")
                    if info.st_nlink == 0 and info.st_dev in devices:
                        total += _space(info, counted)
    return total


def _below(root: Path, skipped: Path, counted: set[tuple[int, int]]) -> int:
    """Enters folders by descriptors: a path may be longer than the system takes, or lead elsewhere a moment
    later."""
    total = 0
    stack: list[tuple[int, list[str]]] = []
    try:
        stack.append((os.open(root, _ENTER), [""]))
        while stack:
            at, names = stack[-1]
            if not names:
                os.close(stack.pop()[0])
                continue
            name = names.pop()
            inner: list[str] = []
            try:
                folder = os.dup(at) if not name else os.open(name, _ENTER, dir_fd=at)
            except OSError:
                continue
            stack.append((folder, inner))
            if len(stack) > MAX_DEPTH:
                raise TooDeepError
            with contextlib.suppress(OSError), os.scandir(folder) as entries:
                for entry in entries:
                    with contextlib.suppress(OSError):
                        info = entry.stat(follow_symlinks=False)
                        if len(stack) == 2 and root / entry.name == skipped:
                            continue
                        total += _space(info, counted)
                        if stat.S_ISDIR(info.st_mode):
                            inner.append(entry.name)
    finally:
        for at, _ in stack:
            os.close(at)
    return total


def _space(info: os.stat_result, counted: set[tuple[int, int]]) -> int:
    if info.st_nlink != 1 and not stat.S_ISDIR(info.st_mode):
        if (info.st_dev, info.st_ino) in counted:
            return 0
        counted.add((info.st_dev, info.st_ino))
    return max(LEAST_BYTES, info.st_blocks * _BLOCK)
