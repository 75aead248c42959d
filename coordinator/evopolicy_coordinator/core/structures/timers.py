"""Deadlines: a heap with lazy deletion, so that arming, disarming and firing cost O(log n).

Rules: a key has at most one deadline; a deadline that was moved or disarmed never fires; ties fire in order of arming.
"""

from __future__ import annotations

import heapq

TimerKey = tuple[str, object]
"""Kind of timer, and its subject."""


class Timers:
    """Named deadlines, in Unix seconds."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, TimerKey]] = []
        self._armed: dict[TimerKey, tuple[float, int]] = {}
        self._count = 0

    def __len__(self) -> int:
        return len(self._armed)

    def __contains__(self, key: TimerKey) -> bool:
        return key in self._armed

    def arm(self, key: TimerKey, at: float) -> None:
        """Set the deadline of `key`, replacing any other."""
        self._count += 1
        self._armed[key] = (at, self._count)
        heapq.heappush(self._heap, (at, self._count, key))
        # Void entries are dropped once they outnumber the armed ones.
        if len(self._heap) > 2 * len(self._armed) + 64:
            self._heap = [(when, count, name) for name, (when, count) in self._armed.items()]
            heapq.heapify(self._heap)

    def arm_once(self, key: TimerKey, at: float) -> None:
        """Set the deadline of `key` unless it has one."""
        if key not in self._armed:
            self.arm(key, at)

    def disarm(self, key: TimerKey) -> None:
        """Remove the deadline of `key`, if it has one."""
        self._armed.pop(key, None)

    def next(self) -> float | None:
        """The earliest deadline; None when none is set."""
        heap = self._heap
        while heap:
            at, count, key = heap[0]
            if self._armed.get(key) == (at, count):
                return at
            heapq.heappop(heap)
        return None

    def pop_due(self, now: float) -> TimerKey | None:
        """Remove and return the earliest key whose deadline is at or before `now`; None when no key is due."""
        at = self.next()
        if at is None or at > now:
            return None
        key = heapq.heappop(self._heap)[2]
        del self._armed[key]
        return key
