"""Waiting for what is to come true: long enough for a slow machine, and no longer than it takes."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

T = TypeVar("T")

TIMEOUT_S = 150.0
"""Less than a test may take."""
_PAUSE_S = 0.05


def wait_until(what: Callable[[], T], message: Callable[[], str] = lambda: "it did not come true") -> T:
    """The first value that counts as true; AssertionError with what is `told` when none comes."""
    deadline = time.monotonic() + TIMEOUT_S
    while not (value := what()):
        assert time.monotonic() < deadline, message()
        time.sleep(_PAUSE_S)
    return value


async def eventually(
    condition: Callable[[], bool | Awaitable[bool]],
    what: str = "it comes true",
    timeout_s: float = TIMEOUT_S,
) -> None:
    """Returns once the condition holds; AssertionError when it never does."""
    deadline = time.monotonic() + timeout_s
    while True:
        holds = condition()
        if inspect.isawaitable(holds):
            holds = await holds
        if holds:
            return
        assert time.monotonic() < deadline, f"never: {what}"
        await asyncio.sleep(_PAUSE_S)
