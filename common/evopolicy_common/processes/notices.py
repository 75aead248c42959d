"""A command that waits says for what, once that has taken longer than three seconds."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator

import structlog

log: structlog.stdlib.BoundLogger = structlog.get_logger()

AFTER_S = 3.0


@contextlib.contextmanager
def notify_if_slow(what: str, after_s: float = AFTER_S) -> Iterator[None]:
    """Warns that `what` is waited for if the inside takes longer than `after_s` seconds. On an event loop."""
    timer = asyncio.get_running_loop().call_later(after_s, lambda: log.warning(f"waiting for {what}"))
    try:
        yield
    finally:
        timer.cancel()


class Waiting:
    """What something waits for, told again and again: said when it is new and has been waited for long enough."""

    def __init__(self) -> None:
        self._since = asyncio.get_running_loop().time()
        self._said = ""

    def goes_on(self) -> None:
        """It waits no longer."""
        self._since = asyncio.get_running_loop().time()
        self._said = ""

    def worth_saying(self, what: str) -> bool:
        """Whether people should hear now that it waits for `what`; empty: for nothing."""
        if not what:
            self.goes_on()
            return False
        # Whoever asks does so every few seconds: a moment too early would be a whole round too late.
        slow = asyncio.get_running_loop().time() - self._since > 0.9 * AFTER_S
        if not slow or what == self._said:
            return False
        self._said = what
        return True
