"""Cgroups of this process's own making, which limit and count other processes. Linux only, versions 1 and 2.

Rules:
- Each controller (`cpu`, `memory`, `pids`) is used where the machine has it: in a hierarchy of version 1, or
  in version 2.
- A new group lies below the cgroup of this process, so that the limits of that one hold too.
- Version 2 is used only where it is this process's own: in a cgroup that systemd has delegated
  (`user.delegate`), or at the root of the cgroup namespace. A group with controllers for groups below it may
  not hold processes, so those of the delegated one move to a group `SIBLINGS` below it.
- A group that cannot be made is left out, as without rights; `ControlGroup.held` says what holds.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path("/sys/fs/cgroup")
SIBLINGS = "evopolicy-others"
_NAME = "evopolicy-agent-"
_PERIOD_US = 100_000
_SETTLES = 100


class _Files(NamedTuple):
    """One controller's files in one version."""

    limit: str
    form: str
    """Of the limit, with `value`."""
    also: Mapping[str, str]
    """Further settings, where the file exists."""
    hits: tuple[str, str]
    """File, and its word before the number of times that the limit was reached."""


_FILES: dict[tuple[str, int], _Files] = {
    ("cpu", 1): _Files("cpu.cfs_quota_us", "{value}", {}, ("cpu.stat", "nr_throttled")),
    ("cpu", 2): _Files("cpu.max", f"{{value}} {_PERIOD_US}", {}, ("cpu.stat", "nr_throttled")),
    ("memory", 1): _Files(
        "memory.limit_in_bytes",
        "{value}",
        {"memory.memsw.limit_in_bytes": "{value}"},
        ("memory.oom_control", "oom_kill"),
    ),
    ("memory", 2): _Files("memory.max", "{value}", {"memory.swap.max": "0"}, ("memory.events", "oom_kill")),
    ("pids", 1): _Files("pids.max", "{value}", {}, ("pids.events", "max")),
    ("pids", 2): _Files("pids.max", "{value}", {}, ("pids.events", "max")),
}
"""By controller and version."""
CONTROLLERS = ("cpu", "memory", "pids")


class Hierarchy(NamedTuple):
    """A cgroup in which this process may make others."""

    folder: Path
    version: int


class ControlGroup:
    """A group of processes, in every hierarchy that this process may use. Empty where it may use none."""

    def __init__(self, limits: Mapping[str, int]) -> None:
        """By controller: `cpu` (µs of processor time in 0.1 s), `memory` (bytes), `pids` (tasks)."""
        self.held: dict[str, int] = {}
        """Version of the cgroup that counts, and limits where a limit was given, by controller."""
        self._folders: dict[str, Path] = {}
        made: dict[Path, Path] = {}
        for controller, hierarchy in hierarchies().items():
            with contextlib.suppress(OSError):
                folder = made.get(hierarchy.folder) or _made(hierarchy.folder)
                made[hierarchy.folder] = folder
                if controller in limits:
                    _limit(folder, _FILES[controller, hierarchy.version], limits[controller])
                if controller in CONTROLLERS:
                    self.held[controller] = hierarchy.version
                self._folders[controller] = folder
        self._made = tuple(made.values())

    @property
    def procs(self) -> tuple[str, ...]:
        """Files into which a process writes its id to join."""
        return tuple(str(folder / "cgroup.procs") for folder in self._made)

    def cpu_s(self) -> float | None:
        """Processor seconds so far; None where nothing counts them."""
        if (usage := self._number("cpuacct", "cpuacct.usage")) is not None:
            return usage / 1e9
        used = self._number("cpu", "cpu.stat", "usage_usec")
        return None if used is None else used / 1e6

    def peak_bytes(self) -> int | None:
        """Most memory so far, the file system's cache included; None where nothing counts it."""
        first = self._number("memory", "memory.max_usage_in_bytes")
        return first if first is not None else self._number("memory", "memory.peak")

    def hits(self, controller: str) -> int:
        """How often the limit was reached: processes ended for memory, or forks refused."""
        if controller not in self.held:
            return 0
        return self._number(controller, *_FILES[controller, self.held[controller]].hits) or 0

    def remove(self) -> None:
        """Removes it; call it when its processes are gone."""
        for folder in self._made:
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _number(self, controller: str, name: str, word: str = "") -> int | None:
        if (folder := self._folders.get(controller)) is None:
            return None
        with contextlib.suppress(OSError, ValueError):
            for line in (folder / name).read_text().splitlines():
                *words, number = line.split()
                if words == [word] or not (words or word):
                    return int(number)
        return None


def hierarchies(own: str | None = None, root: Path = ROOT) -> dict[str, Hierarchy]:
    """Where this process may make groups, by controller. `own`: the content of /proc/self/cgroup."""
    usable: dict[str, Hierarchy] = {}
    second: Path | None = None
    try:
        lines = (Path("/proc/self/cgroup").read_text() if own is None else own).splitlines()
    except OSError:
        return {}
    for line in lines:
        _, names, path = line.split(":", 2)
        if not names:
            second = _own_of_version_2(root, path)
            continue
        base = root / names
        # A container may show its own cgroup as the root.
        folder = next((each for each in (base / path.lstrip("/"), base) if _is_ours(each)), None)
        if folder is not None:
            wanted = {*CONTROLLERS, "cpuacct"} & {*names.split(",")}
            usable |= dict.fromkeys(sorted(wanted), Hierarchy(folder, 1))
    if second is not None:
        for controller in _enabled(second, {*CONTROLLERS} - usable.keys()):
            usable[controller] = Hierarchy(second, 2)
    return usable


def _own_of_version_2(root: Path, path: str) -> Path | None:
    mount = root if (root / "cgroup.controllers").exists() else root / "unified"
    folder = mount / path.lstrip("/")
    if folder.name == SIBLINGS:
        folder = folder.parent
    with contextlib.suppress(OSError):
        if (path == "/" or os.getxattr(folder, "user.delegate") == b"1") and _is_ours(folder):
            return folder
    return None


def _is_ours(folder: Path) -> bool:
    return os.access(folder, os.W_OK) and os.access(folder / "cgroup.procs", os.W_OK)


def _enabled(folder: Path, wanted: set[str]) -> list[str]:
    """The controllers among `wanted` that groups below a cgroup of version 2 have; enables them."""
    control = folder / "cgroup.subtree_control"
    with contextlib.suppress(OSError):
        missing = wanted & {*(folder / "cgroup.controllers").read_text().split()}
        missing -= {*control.read_text().split()}
        # The root of the machine's hierarchy has no such file, and may hold processes beside groups.
        if missing and (folder / "cgroup.type").exists():
            _move_away(folder)
        for controller in sorted(missing):
            with contextlib.suppress(OSError):
                control.write_text(f"+{controller}")
        return sorted(wanted & {*control.read_text().split()})
    return []


def _move_away(folder: Path) -> None:
    leaf = folder / SIBLINGS
    leaf.mkdir(exist_ok=True)
    for _ in range(_SETTLES):
        pids = (folder / "cgroup.procs").read_text().split()
        if not pids:
            return
        for pid in pids:
            with contextlib.suppress(OSError):  # it has ended meanwhile
                (leaf / "cgroup.procs").write_text(pid)


def _made(below: Path) -> Path:
    """A new group. Removes those that killed processes left."""
    for stale in below.glob(f"{_NAME}*"):
        if not Path("/proc", stale.name.removeprefix(_NAME)).exists():
            with contextlib.suppress(OSError):
                stale.rmdir()
    folder = below / f"{_NAME}{os.getpid()}"
    folder.mkdir(exist_ok=True)
    return folder


def _limit(folder: Path, files: _Files, value: int) -> None:
    (folder / files.limit).write_text(files.form.format(value=value))
    for name, form in files.also.items():
        with contextlib.suppress(OSError):
            (folder / name).write_text(form.format(value=value))
