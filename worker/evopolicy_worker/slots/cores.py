"""Assigns CPU cores to slots. The workers of one machine coordinate by file locks.

A slot's environment and policy processes share one core: a pipe round trip costs 7 µs there and over 100 µs across
cores.
"""

from __future__ import annotations

import fcntl
import itertools
import os
import tempfile
from pathlib import Path
from typing import IO

_locks: list[IO[bytes]] = []
"""Of this process's cores, until it ends."""


def take(n: int | None) -> list[int]:
    """A core for each of `n` slots: those that no worker of this machine has taken, then all in turn. None:
    as many slots as this process has cores."""
    allowed = sorted(os.sched_getaffinity(0))
    n = n or len(allowed)
    folder = Path(tempfile.gettempdir()) / f"evopolicy-cores-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    taken: list[int] = []
    for core in allowed:
        if len(taken) < n:
            lock = (folder / f"core-{core}.lock").open("ab")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.close()
                continue
            _locks.append(lock)
            taken.append(core)
    return [*taken, *itertools.islice(itertools.cycle(allowed), n - len(taken))]
