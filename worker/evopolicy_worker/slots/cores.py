"""Assigns CPU cores to slots. The workers of one machine coordinate by names of Unix sockets.

A slot's environment and policy processes share one core: a pipe round trip costs 7 µs there and over 100 µs across
cores. The kernel frees a name with its process, and no file of another user can be in the way.
"""

from __future__ import annotations

import itertools
import os
import socket

_NAME = "\0evopolicy-core-{}"
_names: list[socket.socket] = []
"""Of this process's cores, until it ends."""


def take(n: int | None) -> list[int]:
    """A core for each of `n` slots: those that no worker of this machine has taken, then all in turn. None:
    as many slots as this process has cores."""
    allowed = sorted(os.sched_getaffinity(0))
    n = n or len(allowed)
    taken: list[int] = []
    for core in allowed:
        if len(taken) < n:
            name = socket.socket(socket.AF_UNIX)
            try:
                name.bind(_NAME.format(core))
            except OSError:
                name.close()
                continue
            _names.append(name)
            taken.append(core)
    return [*taken, *itertools.islice(itertools.cycle(allowed), n - len(taken))]
