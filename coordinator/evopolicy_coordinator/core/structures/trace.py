"""Recent events by job, lease, worker or run, for `trace(key)` and for errors.

A ring buffer of fixed size, so that memory does not grow.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

TRACE_ENTRIES = 20_000


class InvariantError(AssertionError):
    """The core's state is inconsistent: a bug. Carries the trace of the record concerned."""


class TraceEntry(NamedTuple):
    """One event; time in Unix seconds."""

    at: float
    stimulus_id: str
    key: str
    """Its subject: a job id, lease id, worker, run or group."""
    what: str


class Trace:
    """The last events, oldest first."""

    def __init__(self, lines: int = TRACE_ENTRIES) -> None:
        self._lines: deque[TraceEntry] = deque(maxlen=lines)

    def add(self, at: float, stimulus_id: str, key: str, what: str) -> None:
        """Append an entry; when the buffer is full, the oldest entry is dropped."""
        self._lines.append(TraceEntry(at, stimulus_id, key, what))

    def of(self, key: str) -> list[TraceEntry]:
        """Entries about `key`, its children (`run` → `run/…`) and attempts (`job#…`), and entries that mention it or
        have it as stimulus id."""
        return [
            line
            for line in self._lines
            if line.key.startswith(key) or key in line.what or line.stimulus_id == key
        ]
