"""A test process's children: whether they live, and how code that ends "everything below this process" spares some."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
from collections.abc import Iterator
from unittest.mock import patch

from evopolicy_common.processes import proc
from evopolicy_gateway.processes import trees as processes


def alive(pid: int) -> bool:
    """Whether there is such a process; a zombie is none."""
    found = proc.stat(pid)
    return found is not None and found.state != "Z"


@contextlib.contextmanager
def only_what_starts_inside() -> Iterator[None]:
    """`processes.end_descendants` spares what ran before the `with`; a subreaper made inside is none after it."""
    spare = frozenset(proc.descendants(os.getpid()))
    bounded = functools.partial(processes.end_descendants, spare=spare)
    reaped = processes._reaps
    try:
        with patch.object(processes, "end_descendants", bounded):
            yield
    finally:
        processes._reaps = reaped
        ctypes.CDLL(None).prctl(processes._PR_SET_CHILD_SUBREAPER, int(reaped), 0, 0, 0)
