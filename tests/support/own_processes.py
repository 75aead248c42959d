"""Code that ends "everything below this process", called inside a test process whose other fixtures have children too."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
from collections.abc import Iterator
from unittest.mock import patch

from evopolicy_gateway import processes


@contextlib.contextmanager
def only_what_starts_inside() -> Iterator[None]:
    """`processes.end_descendants` spares what ran before the `with`; a subreaper made inside is none after it."""
    spare = frozenset(processes.descendants(os.getpid()))
    bounded = functools.partial(processes.end_descendants, spare=spare)
    reaped = processes._reaps
    try:
        with patch.object(processes, "end_descendants", bounded):
            yield
    finally:
        processes._reaps = reaped
        ctypes.CDLL(None).prctl(processes._PR_SET_CHILD_SUBREAPER, int(reaped), 0, 0, 0)
