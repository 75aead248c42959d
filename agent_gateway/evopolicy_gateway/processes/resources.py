"""An agent's share of its machine: its limits, the mechanism that keeps each, and the use by its programs.

Cgroups keep the limits where the agent supervisor may make one. Elsewhere a jailed agent has a number of
cores, by affinity, and a number of processes, by a resource limit that Linux counts in each user namespace
since 5.14, though never for root. A limit that no mechanism keeps is recorded as unlimited. No quota keeps
the size of files: the supervisor measures it, and ends the agent. Space counts, not length: a sparse file takes
little. Each file and folder counts at least `LEAST_BYTES`, since file systems have a bounded number of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import re
import stat
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.processes import cgroups, proc
from evopolicy_common.records.run_record import AgentLimits, AgentResources
from evopolicy_gateway.processes import trees

_POLL_S = 1.0
_PAUSE_FACTOR = 50
"""A measurement of the files is followed by a pause of at least this many times its length."""
_QUOTA_US = 100_000
_COUNTED_BY_NAMESPACE = (5, 14)
_WORDS = {"cpus": "cores {:g}", "memory_bytes": "memory {:,} bytes", "pids": "processes {:,}"}
_CONTROLLERS = {"cpus": "cpu", "memory_bytes": "memory", "pids": "pids"}


class Resources:
    """The limits and the use of one agent, from its supervisor's start to its end."""

    def __init__(self, asked: AgentLimits, folders: Sequence[Path], skipped: Path, *, jailed: bool) -> None:
        """`folders`: with the agent's files, without `skipped`. Where no cgroup holds the cores, this thread
        and the programs that it starts are bound to some."""
        self._asked = asked
        self._folders, self._skipped = folders, skipped
        quota = asked.cpus and max(1000, round(asked.cpus * _QUOTA_US))
        wanted = {"cpu": quota, "memory": asked.memory_bytes, "pids": asked.pids}
        self._group = cgroups.ControlGroup({name: value for name, value in wanted.items() if value})
        self.joins = self._group.procs
        """Files into which a program of the agent writes its id before it starts."""
        held = self._group.held
        by = {
            name: f"cgroup v{held[controller]}"
            for name, controller in _CONTROLLERS.items()
            if controller in held and getattr(asked, name) is not None
        }
        cpus = asked.cpus if "cpus" in by else None
        memory_bytes = asked.memory_bytes if "memory_bytes" in by else None
        pids = asked.pids if "pids" in by else None
        self.fixed_cores = bool(asked.cpus and "cpus" not in by and jailed)
        """Whether the programs may not choose their cores."""
        if self.fixed_cores:
            # This thread is bound to that many of its cores, others for each process.
            cores = sorted(os.sched_getaffinity(0))
            first = os.getpid() % len(cores)
            chosen = (cores[first:] + cores[:first])[: math.ceil(asked.cpus or 0)]
            os.sched_setaffinity(0, chosen)
            cpus, by["cpus"] = float(len(chosen)), "affinity"
        self.own_pids: int | None = None
        """Resource limit for the programs themselves."""
        release = tuple(map(int, re.findall(r"\d+", os.uname().release)[:2]))
        counted = release >= _COUNTED_BY_NAMESPACE and os.getuid() != 0
        if asked.pids and "pids" not in by and jailed and counted:
            self.own_pids = pids = asked.pids
            by["pids"] = "rlimit"
        kept = msgspec.structs.replace(asked, cpus=cpus, memory_bytes=memory_bytes, pids=pids)
        self._now = AgentResources(limits=kept, kept_by=by)

    def limits_text(self) -> str:
        """For the operator: the requested limits and the mechanism that keeps each; empty without any."""
        none = "no cgroup can be made here: unlimited"
        return ", ".join(
            f"{form.format(getattr(self._now.limits, name) or asked)} ({self._now.kept_by.get(name, none)})"
            for name, form in _WORDS.items()
            if (asked := getattr(self._asked, name)) is not None
        )

    def used(self) -> AgentResources:
        now, group = self._now, self._group
        cpu_s, peak = group.cpu_s(), group.peak_bytes()
        if peak is None:
            sizes = [proc.sizes(pid) for pid in proc.descendants(os.getpid())]
            peak = sum(size[1] for size in sizes if size is not None)
        self._now = msgspec.structs.replace(
            now,
            cpu_s=round(max(now.cpu_s, trees.cpu_below() if cpu_s is None else cpu_s), 3),
            memory_peak_bytes=max(now.memory_peak_bytes, peak),
            ended_for_memory=max(now.ended_for_memory, group.hits("memory")),
            refused_forks=max(now.refused_forks, group.hits("pids")),
        )
        return self._now

    def reached(self) -> str:
        """Which limits the kernel has applied so far, for the operator; empty for none."""
        now, limits = self.used(), self._now.limits
        parts = []
        if now.ended_for_memory and limits.memory_bytes:
            parts.append(
                f"its memory limit of {limits.memory_bytes:,} bytes (agent_memory): the kernel has ended"
                f" {now.ended_for_memory} of its processes"
            )
        if now.refused_forks and limits.pids:
            parts.append(f"its limit of {limits.pids:,} processes (agent_pids)")
        return "the agent reached " + ", and ".join(parts) if parts else ""

    async def too_large(self) -> str:
        """Watches the space that the agent's files take; returns why the agent has to end."""
        before = ""
        while True:
            begun = time.monotonic()
            why = await asyncio.to_thread(self._measured)
            if why and before:  # seen twice: files that move meanwhile may count twice
                return why
            before = why
            await asyncio.sleep(max(_POLL_S, _PAUSE_FACTOR * (time.monotonic() - begun)))

    def remove(self) -> None:
        """Call it when all processes of the agent are gone."""
        self._group.remove()

    def _measured(self) -> str:
        try:
            n_bytes = used_bytes(self._folders, self._skipped, proc.descendants(os.getpid()))
        except TooDeepError:
            return f"its folders are nested deeper than {MAX_DEPTH}, so that their size is unknown"
        self._now = msgspec.structs.replace(self._now, disk_bytes=max(self._now.disk_bytes, n_bytes))
        most = self._asked.disk_bytes
        taken = f"its files take {n_bytes:,} bytes; {most:,} are allowed (agent_disk)"
        return taken if n_bytes > most else ""


LEAST_BYTES = 4096
MAX_DEPTH = 256
_BLOCK = 512
_ENTER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class TooDeepError(Exception):
    """Folders are nested deeper than `MAX_DEPTH`."""


def used_bytes(folders: Iterable[Path], skipped: Path, pids: Iterable[int]) -> int:
    """Space of `folders` without `skipped`, and of deleted files open in `pids`. Raises TooDeepError."""
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
    """Enters folders by descriptors: a path may be too long, or lead elsewhere a moment later."""
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
