"""Cgroups of a test's own, of version 1 or 2: they keep processor or memory from a process, or freeze it.

Only root can make cgroups. Where a cgroup cannot be made, `NoCgroupError` says why; in a test it is a skip.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import SkipTest

from program_runs import run_program

from evopolicy_common.processes.cgroups import ROOT, hierarchies

TIMEOUT_S = 10.0
_numbers = itertools.count()


class NoCgroupError(SkipTest):
    """A cgroup cannot be made here."""

    def __init__(self, why: str) -> None:
        super().__init__(f"needs a cgroup of its own ({why}): make test-root as root")


class Cgroup:
    """A folder of a cgroup hierarchy. Its files are settings."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, pid: int) -> None:
        self.set("cgroup.procs", str(pid))

    def set(self, name: str, value: str) -> None:
        (self._folder / name).write_text(value)

    def get(self, name: str) -> str:
        return (self._folder / name).read_text().strip()

    def cpu_s(self) -> float:
        """Processor time of all its processes so far, also of those that nobody waited for, seconds."""
        if (self._folder / "cpuacct.usage").exists():
            return int(self.get("cpuacct.usage")) / 1e9
        return int(self.get("cpu.stat").split()[1]) / 1e6

    def release(self) -> None:
        """Its processes go on in the group above."""
        for pid in self.get("cgroup.procs").split():
            with contextlib.suppress(OSError):
                (self._folder.parent / "cgroup.procs").write_text(pid)

    def remove(self) -> None:
        """Removes it, once its last process is gone."""
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            try:
                return self._folder.rmdir()
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)


class Freezer(Cgroup):
    """Holds processes still until they are thawed, also against SIGKILL."""

    def freeze(self, pid: int) -> None:
        self.add(pid)
        self._until("FROZEN")

    def thaw(self) -> None:
        self._until("THAWED")

    def _until(self, state: str) -> None:
        self.set("freezer.state", state)
        while self.get("freezer.state") != state:
            time.sleep(0.01)


@contextlib.contextmanager
def starved() -> Iterator[Cgroup]:
    """Yields a cgroup whose processes get next to nothing of a processor that others want."""
    with _group("cpu", {"cpu.shares": "5"}, {"cpu.weight": "1"}) as group:
        yield group


@contextlib.contextmanager
def counted() -> Iterator[Cgroup]:
    """Yields a cgroup that counts its processes' time (`cpu_s`)."""
    with _group("cpuacct", {}, {}) as group:
        yield group


@contextlib.contextmanager
def limited(n_bytes: int) -> Iterator[Cgroup]:
    """Yields a cgroup whose processes have at most `n_bytes` of memory together."""
    most = str(n_bytes)
    with _group("memory", {"memory.limit_in_bytes": most}, {"memory.max": most}) as group:
        yield group


@contextlib.contextmanager
def freezer() -> Iterator[Freezer]:
    """Yields a cgroup of version 1, where SIGKILL waits for the thaw. Mounts its hierarchy if nobody has yet."""
    with contextlib.ExitStack() as stack:
        root = ROOT / "freezer"
        if not (root / "cgroup.procs").exists():
            root = stack.enter_context(_mounted("freezer"))
        group = Freezer(_folder(root))
        stack.callback(group.remove)
        stack.callback(group.thaw)
        yield group


@contextlib.contextmanager
def _group(controller: str, first: dict[str, str], second: dict[str, str]) -> Iterator[Cgroup]:
    """A cgroup with the settings of version 1 (`first`) or 2 (`second`), whichever this machine has."""
    found = hierarchies().get(controller)
    if found is None:
        raise NoCgroupError(f"no {controller} controller")
    group = Cgroup(_folder(found.folder))
    try:
        try:
            for name, value in (first if found.version == 1 else second).items():
                group.set(name, value)
        except OSError as error:
            raise NoCgroupError(f"the {controller} controller is not available: {error}") from error
        yield group
    finally:
        group.remove()


def _folder(root: Path) -> Path:
    folder = root / f"evopolicy-test-{os.getpid()}-{next(_numbers)}"
    try:
        folder.mkdir()
    except OSError as error:
        raise NoCgroupError(str(error)) from error
    return folder


@contextlib.contextmanager
def _mounted(controller: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="evp-cgroup-") as folder:
        done = run_program("mount", "-t", "cgroup", "-o", controller, "none", folder)
        if done.returncode:
            raise NoCgroupError(done.stderr.strip())
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)
