"""Assigns a CPU core to each slot. The workers of one machine coordinate by file locks.

A slot's environment and policy processes share one core: a pipe round trip costs 7 µs there and over 100 µs across
cores.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO


class Cores:
    """Assigns cores, preferring those that no worker of this machine has taken."""

    def __init__(self) -> None:
        self.allowed = sorted(os.sched_getaffinity(0))
        """The cores that this process may use; by default it has a slot for each."""
        self._locks: dict[int, IO[bytes]] = {}
        self._shared = 0
        self._folder = Path(tempfile.gettempdir()) / f"evopolicy-cores-{os.getuid()}"
        self._folder.mkdir(mode=0o700, exist_ok=True)

    def take(self) -> int:
        """A core for one more slot: a free one, or the next in turn when all are taken."""
        for core in self.allowed:
            if core in self._locks:
                continue
            lock = (self._folder / f"core-{core}.lock").open("ab")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.close()
                continue
            self._locks[core] = lock
            return core
        core = self.allowed[self._shared % len(self.allowed)]
        self._shared += 1
        return core

    def close(self) -> None:
        """Releases the cores."""
        for lock in self._locks.values():
            lock.close()
        self._locks.clear()
