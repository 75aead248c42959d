"""Processes that survive being killed: held by the kernel in a frozen cgroup (version 1, where SIGKILL waits for the thaw)."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

FREEZER = Path("/sys/fs/cgroup/freezer")


class Freezer:
    """A cgroup; whatever is put into it stands still until it is thawed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def freeze(self, pid: int) -> None:
        (self._folder / "cgroup.procs").write_text(str(pid))
        self._set("FROZEN")

    def thaw(self) -> None:
        self._set("THAWED")

    def _set(self, state: str) -> None:
        (self._folder / "freezer.state").write_text(state)
        while (self._folder / "freezer.state").read_text().strip() != state:
            time.sleep(0.01)

    def empty(self) -> bool:
        return not (self._folder / "cgroup.procs").read_text().strip()


@contextlib.contextmanager
def freezer() -> Iterator[Freezer]:
    """Skips the test where this machine has none that we may use."""
    if not os.access(FREEZER / "cgroup.procs", os.W_OK):
        pytest.skip(
            f"needs root and the freezer of cgroups version 1: mount -t cgroup -o freezer none {FREEZER}"
        )
    folder = FREEZER / f"evopolicy-test-{os.getpid()}"
    folder.mkdir()
    found = Freezer(folder)
    try:
        yield found
    finally:
        found.thaw()
        deadline = time.monotonic() + 10.0
        while not found.empty() and time.monotonic() < deadline:
            time.sleep(0.01)
        folder.rmdir()
