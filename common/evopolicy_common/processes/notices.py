"""Notices for commands that wait for longer than three seconds."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Iterator

from evopolicy_common.logs import log

AFTER_S = 3.0
MANY_SLOTS = 8
"""Slots for each core beyond which a command says so."""


def notify_of_many_slots(slots: int) -> None:
    """Warns of slots that only wait for each other."""
    cores = len(os.sched_getaffinity(0))
    if slots > MANY_SLOTS * cores:
        log.warning(
            f"{slots:,} slots on {cores} cores: each takes memory for a simulator, and they wait for each other; give"
            " fewer with --slots"
        )


@contextlib.contextmanager
def notify_if_slow(what: str, after_s: float = AFTER_S) -> Iterator[None]:
    """Warns that the command waits for `what` if the body takes longer than `after_s` seconds. Needs an event loop."""
    timer = asyncio.get_running_loop().call_later(after_s, lambda: log.warning(f"waiting for {what}"))
    try:
        yield
    finally:
        timer.cancel()


class Waiting:
    """Filters repeated reports of what something waits for: each reason is shown once, after a long enough wait."""

    def __init__(self) -> None:
        self._said: set[str] = set()
        self.ended()

    def ended(self) -> None:
        """The wait is over: the next one counts from now."""
        self._since = asyncio.get_running_loop().time()

    def worth_saying(self, what: str) -> bool:
        """Whether to report now that it waits for `what`; an empty `what` means that it does not wait."""
        if not what:
            self.ended()
            return False
        # 0.9: callers poll every few seconds, so a check just before the limit would delay the notice by a whole round.
        slow = asyncio.get_running_loop().time() - self._since > 0.9 * AFTER_S
        if not slow or what in self._said:
            return False
        self._said.add(what)
        return True
