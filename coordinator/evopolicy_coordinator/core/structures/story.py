"""What happened to a job, lease, worker or run, as far back as is kept: for `story(key)` and for errors.

A ring of fixed size: memory does not grow with what happens.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

STORY_LINES = 20_000


class InvariantError(AssertionError):
    """The core contradicts itself: a bug. Carries the story of what is concerned."""


class StoryLine(NamedTuple):
    """One thing that happened, Unix seconds."""

    at: float
    stimulus_id: str
    key: str
    """What it happened to: a job id, lease id, worker, run or group."""
    what: str


class Story:
    """The last things that happened, oldest first."""

    def __init__(self, lines: int = STORY_LINES) -> None:
        self._lines: deque[StoryLine] = deque(maxlen=lines)

    def tell(self, at: float, stimulus_id: str, key: str, what: str) -> None:
        """Keep a line; the oldest goes when there is no more room."""
        self._lines.append(StoryLine(at, stimulus_id, key, what))

    def of(self, key: str) -> list[StoryLine]:
        """Lines about `key`, what is below it (`run` → `run/…`), its attempts (`job#…`) and whatever names it."""
        return [
            line
            for line in self._lines
            if line.key.startswith(key) or key in line.what or line.stimulus_id == key
        ]
