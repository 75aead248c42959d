"""Long polls for outcomes, permits and the end of a run, with their targets and deadlines.

Rules that this module owns: a poll is answered once; at its deadline it is answered with the current state.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from evopolicy_coordinator.core.contract.events import RequestId
from evopolicy_coordinator.core.structures import take
from evopolicy_coordinator.core.structures.timers import Timers

PollKind = Literal["results", "evaluation", "run", "permit"]


class Poll(NamedTuple):
    """A waiting request."""

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

    def take(self, request: RequestId) -> Poll | None:
        """Remove a poll; None when it no longer waits."""
        poll = self._polls.pop(request, None)
        if poll is not None:
            self._timers.disarm(("poll", request))
            take(self._of, poll.target, request)
        return poll

    def take_all(self, target: str) -> list[Poll]:
        """Remove all polls for `target`, in order of arrival."""
        polls = [self.take(request) for request in list(self._of.get(target, ()))]
        return [poll for poll in polls if poll is not None]

    def __len__(self) -> int:
        return len(self._polls)
