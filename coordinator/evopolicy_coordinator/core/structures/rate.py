"""Episodes done, in total and over the last minute."""

from __future__ import annotations

from collections import deque

RATE_S = 60


class Rate:
    """Keeps one count per second."""

    def __init__(self) -> None:
        self.total = 0
        self._seconds: deque[list[int]] = deque(maxlen=RATE_S)

    def count(self, n: int, now: float) -> None:
        """Add `n` episodes, done at `now` (Unix seconds)."""
        self.total += n
        second = int(now)
        if self._seconds and self._seconds[-1][0] == second:
            self._seconds[-1][1] += n
        else:
            self._seconds.append([second, n])

    def per_s(self, now: float) -> float:
        """Episodes per second over the last minute."""
        return sum(n for second, n in self._seconds if second > now - RATE_S) / RATE_S
