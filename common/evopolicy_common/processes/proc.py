"""Reads this machine's processes from /proc: state, tree, processor time and memory. Linux only."""

from __future__ import annotations

import contextlib
import os
import platform
import secrets
import subprocess
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

_TICKS = os.sysconf("SC_CLK_TCK")
_PF_EXITING = 0x4


class Stat(NamedTuple):
    """A process, from /proc/PID/stat."""

    pid: int
    state: str
    """One letter, such as R (runs), S (sleeps), T (stopped), t (held by a debugger) or Z (a zombie)."""
    parent: int
    session: int
    exiting: bool
    cpu_s: float
    """Processor time of all its threads, and of the children that it has waited for, seconds."""
    threads: int = 1

    @property
    def dead(self) -> bool:
        """Whether it is a zombie. Its state alone does not tell: it is Z as soon as the first thread has ended."""
        return self.state in ("Z", "X") and self.threads <= 1


def parse_stat(line: bytes) -> Stat:
    """The content of /proc/PID/stat. Raises ValueError when it is none."""
    # The command's name is in parentheses, and may itself contain spaces and parentheses.
    head, _, tail = line.rpartition(b")")
    fields = tail.split()
    if len(fields) < 18:
        raise ValueError(f"not the stat of a process: {line[:200]!r}")
    return Stat(
        pid=int(head.partition(b" ")[0]),
        state=fields[0].decode("ascii"),
        parent=int(fields[1]),
        session=int(fields[3]),
        exiting=bool(int(fields[6]) & _PF_EXITING),
        cpu_s=sum(map(int, fields[11:15])) / _TICKS,
        threads=int(fields[17]),
    )


def stat(pid: int | str) -> Stat | None:
    """The process; None when there is no such process."""
    with contextlib.suppress(OSError, ValueError), open(f"/proc/{pid}/stat", "rb") as file:
        return parse_stat(file.read())
    return None


def table() -> list[Stat]:
    """All processes, zombies included."""
    processes = [stat(name) for name in os.listdir("/proc") if name.isdecimal()]
    return [each for each in processes if each is not None]


def family(root: int, *, spare: Collection[int] = ()) -> list[Stat]:
    """The process `root` and all below it, parents first, zombies included, without `spare` and all below it.
    Reads the process table once: between two reads, a spared process could start one that looks like an
    orphan."""
    children: dict[int, list[Stat]] = {}
    stack: list[Stat] = []
    for each in table():
        children.setdefault(each.parent, []).append(each)
        if each.pid == root:
            stack.append(each)
    processes: list[Stat] = []
    while stack:
        each = stack.pop()
        processes.append(each)
        stack += [child for child in reversed(children.get(each.pid, [])) if child.pid not in spare]
    return processes


def descendants(root: int, *, spare: Collection[int] = ()) -> list[int]:
    """The ids of the live processes below `root`, as `family` has them, without zombies."""
    return [each.pid for each in family(root, spare=spare)[1:] if not each.dead]


def clock(pid: int) -> int:
    """The clock of a process's own processor time, for `time.clock_gettime`; see clock_getcpuclockid(3)."""
    return (~pid << 3) | 2


def sizes(pid: int) -> tuple[int, int] | None:
    """Address space and resident memory of a process, bytes; None when it cannot be read."""
    with contextlib.suppress(OSError, ValueError):
        space, resident = Path(f"/proc/{pid}/statm").read_text().split()[:2]
        page = os.sysconf("SC_PAGE_SIZE")
        return int(space) * page, int(resident) * page
    return None


def number(path: str, name: str) -> int | None:
    """The number after a name at the start of a line of a file of /proc; None when it cannot be read."""
    with contextlib.suppress(OSError, ValueError, IndexError), open(path) as lines:
        for line in lines:
            if line.startswith((f"{name}:", f"{name} ")):
                return int(line.split()[1])
    return None


def proportional_bytes(pid: int) -> int | None:
    """Proportional set size of a process: its resident memory, in which memory that several processes share is divided
    among them. Bytes; None where the kernel does not show it."""
    size = number(f"/proc/{pid}/smaps_rollup", "Pss")
    return None if size is None else size << 10


_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

NO_BOOT_ID = f"the kernel does not show its boot id: mount /proc so that {_BOOT_ID} can be read"
"""Why a worker plays no hidden episodes, and why an agent counts as being on every kernel."""


def new_worker_name() -> str:
    """The host's name with a random suffix."""
    return f"{os.uname().nodename.split('.')[0][:40] or 'worker'}-{secrets.token_hex(3)}"


def boot_id() -> str:
    """The running kernel's id, new at every boot and equal in all its containers; empty if it is not available."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        pass
    if platform.system() != "Darwin":
        return ""
    done = subprocess.run(
        ["sysctl", "-n", "kern.bootsessionuuid"], capture_output=True, text=True, check=False
    )
    return done.stdout.strip().lower() if done.returncode == 0 else ""
