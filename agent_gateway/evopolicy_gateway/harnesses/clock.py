"""The agent's wall clock, which stands still while its provider is away; waits for hidden episodes are given back to it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator

_LOOK_S = 1.0


class AgentClock:
    """Counts down from `limit_s` seconds."""

    def __init__(self, limit_s: float, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._limit_s = limit_s
        self._started = now()
        self._paused_s = 0.0
        self._paused_at: float | None = None
        self._held_s = 0.0

    def held(self, seconds: float) -> None:
        """Gives back so many seconds in all, for which its submits have waited because hidden episodes had the machines."""
        self._held_s = max(self._held_s, seconds)

    def left_s(self) -> float:
        """Seconds that are left; below zero when it has run out."""
        now = self._now() if self._paused_at is None else self._paused_at
        return self._limit_s - (now - self._started - self._paused_s - self._held_s)

    def used_s(self) -> float:
        """Seconds that have passed on it."""
        return self._limit_s - self.left_s()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """It stands still inside the `with`."""
        self._paused_at = self._now()
        try:
            yield
        finally:
            self._paused_s += self._now() - self._paused_at
            self._paused_at = None

    async def run_out(self) -> None:
        """Returns when it has."""
        # Looks again and again: it may be stopped meanwhile.
        while (left := self.left_s()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(min(left, _LOOK_S))
