"""What happened to a job, lease, worker or run, as far back as is kept: for `trace(key)` and for errors.

A ring of fixed size: memory does not grow with what happens.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

TRACE_ENTRIES = 20_000


class InvariantError(AssertionError):
    """The core contradicts itself: a bug. Carries the trace of what is concerned."""


class TraceEntry(NamedTuple):
    """One thing that happened, Unix seconds."""

    at: float
    stimulus_id: str
    key: str
    """What it happened to: a job id, lease id, worker, run or group."""
    what: str


class Trace:
    """The last things that happened, oldest first."""

    def __init__(self, lines: int = TRACE_ENTRIES) -> None:
        self._lines: deque[TraceEntry] = deque(maxlen=lines)

    def add(self, at: float, stimulus_id: str, key: str, what: str) -> None:
        """Keep a line; the oldest goes when there is no more room."""
        self._lines.append(TraceEntry(at, stimulus_id, key, what))

    def of(self, key: str) -> list[TraceEntry]:
        """Lines about `key`, what is below it (`run` → `run/…`), its attempts (`job#…`) and whatever names it."""
        return [
            line
            for line in self._lines
            if line.key.startswith(key) or key in line.what or line.stimulus_id == key
        ]
