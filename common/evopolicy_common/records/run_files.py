"""Finds finished runs below folders and the submits of a run's folder, and reads files that others wrote."""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterable
from pathlib import Path

_SUBMIT = re.compile(r"submit_([0-9]{1,9})")


def read_regular(path: Path) -> bytes:
    """The bytes of a file that others wrote. Raises OSError, also when it is no regular file: to open a pipe would wait
    for its writer forever."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        return file.read()


def run_folders(paths: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Run directories at or under `paths`, sorted and distinct, and those of `paths` that contain none.

    A run directory is a folder with a `run.json`, or one of a started run (`workspace/` beside `logs/` or
    `checkpoints/`); it is not searched further. Links below the given paths are not followed.
    """
    found: set[Path] = set()
    without: list[Path] = []
    for path in paths:
        root = path.resolve()
        if root.is_file() and root.name == "run.json":
            found.add(root.parent)
            continue
        before = len(found)
        is_repeat = False
        for folder, names, files in os.walk(root):
            begun = "workspace" in names and ("logs" in names or "checkpoints" in names)
            if "run.json" in files or begun:
                is_repeat = is_repeat or Path(folder) in found
                found.add(Path(folder))
                names.clear()
            names[:] = [name for name in names if not name.startswith(".")]
        if len(found) == before and not is_repeat:
            without.append(path)
    return sorted(found), without


def submit_folders(folder: Path) -> dict[int, Path]:
    """The folders `submit_NNN` in `folder` by their indices, in order; empty if it has none or does not exist.

    NNN has at least three digits, more if the budget has more.
    """
    if not folder.is_dir():
        return {}
    matches = ((_SUBMIT.fullmatch(child.name), child) for child in folder.iterdir())
    return dict(sorted((int(match[1]), child) for match, child in matches if match))
