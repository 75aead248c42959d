"""Deadlines and long polls. Deadlines are a heap with lazy deletion: arming, disarming and firing cost O(log n).

Rules: a key has at most one deadline; a deadline that was moved or disarmed never fires; ties fire in order of arming.

A poll is answered once; at its deadline it is answered with the current state.
"""

from __future__ import annotations

import heapq
from typing import Literal, NamedTuple

from evopolicy_coordinator.core.contract.events import RequestId
from evopolicy_coordinator.core.structures import pop_entry

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


PollKind = Literal["results", "evaluation", "run", "permit"]


class Poll(NamedTuple):
    request: RequestId
    kind: PollKind
    target: str
    """Group id, run, or `permits.poll_target`."""
    cursor: int = 0


class Polls:
    """Waiting polls, by request and by target."""

    def __init__(self, timers: Timers, max_wait_s: float) -> None:
        self._timers = timers
        self._max_wait_s = max_wait_s
        self._polls: dict[RequestId, Poll] = {}
        self._of: dict[str, dict[RequestId, None]] = {}

    def wait(self, poll: Poll, wait_s: float, now: float) -> bool:
        """Let a poll wait up to `wait_s` seconds, at most `max_wait_s`. Returns False when `wait_s` is not positive."""
        wait_s = min(wait_s, self._max_wait_s)
        if not wait_s > 0.0:
            return False
        self._polls[poll.request] = poll
        self._of.setdefault(poll.target, {})[poll.request] = None
        self._timers.arm(("poll", poll.request), now + wait_s)
        return True

    def take_poll(self, request: RequestId) -> Poll | None:
        """Remove a poll; None when it no longer waits."""
        poll = self._polls.pop(request, None)
        if poll is not None:
            self._timers.disarm(("poll", request))
            pop_entry(self._of, poll.target, request)
        return poll

    def take_all(self, target: str) -> list[Poll]:
        """Remove all polls for `target`, in order of arrival."""
        polls = [self.take_poll(request) for request in list(self._of.get(target, ()))]
        return [poll for poll in polls if poll is not None]

    def __len__(self) -> int:
        return len(self._polls)
