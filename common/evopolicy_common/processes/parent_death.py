"""Starts a program that ends with its parent: `python -I -S parent_death.py PARENT_PID SIGNAL JOINS
PROGRAM…`.

Joins cgroups (`JOINS`: their `cgroup.procs`, separated by colons), sets the parent-death signal, which
survives exec, and then executes the program. It is a program of its own because code between fork and exec
is not safe in a process with threads or a Zenoh session.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_PR_SET_PDEATHSIG = 1


def ending_with_parent(
    program: Sequence[str], death_signal: signal.Signals = signal.SIGTERM, joins: Sequence[str] = ()
) -> list[str]:
    """The command that starts `program` so that it ends with this process, in the cgroups of the files
    `joins`. Start it from the main thread: the signal is bound to the parent's thread."""
    parent, number = str(os.getpid()), str(int(death_signal))
    return [sys.executable, "-I", "-S", __file__, parent, number, ":".join(joins), *program]


def end_with_parent(death_signal: signal.Signals) -> None:
    """Makes the kernel send this process `death_signal` when the thread that started it ends, also after an exec."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, death_signal, 0, 0, 0)


def main(arguments: list[str]) -> None:
    """Executes the program. Exit code 1: the parent or a cgroup is gone; 127: it cannot be started."""
    parent, death_signal, program = int(arguments[0]), signal.Signals(int(arguments[1])), arguments[3:]
    end_with_parent(death_signal)
    for path in filter(None, arguments[2].split(":")):
        with open(path, "w") as file:
            file.write(str(os.getpid()))
    if os.getppid() != parent:
        # It died before the signal was set.
        print(f"not starting {program[0]}: process {parent}, which wanted it, is gone", file=sys.stderr)
        raise SystemExit(1)
    try:
        os.execvp(program[0], program)
    except OSError as error:
        print(f"cannot start {program[0]}: {error.strerror}", file=sys.stderr)
        raise SystemExit(127) from None


if __name__ == "__main__":
    main(sys.argv[1:])
