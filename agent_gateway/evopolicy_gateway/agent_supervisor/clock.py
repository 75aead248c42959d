"""An agent's two clocks: its time as a whole, and how long it has done nothing.

The first stands still while its provider is away, and waits for hidden episodes are given back to it. The second is of
programs alone, as a coding agent's stream has a limit of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from evopolicy_gateway.run import processes

SILENCE_S = 3600.0
"""Usual limit of an agent's silence: longer than any pause for thought, and much shorter than its wall limit."""
_LOOK_S = 1.0
_LOOKS = 20
"""So often is looked for processor time within the limit of silence."""
_BUSY_SHARE = 0.05
"""Of one core, from one look to the next: a program that only waits and polls takes less."""


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


class Activity:
    """What an agent has done lately, and whether it has fallen silent.

    It is active while a submit of it runs, whenever it asks for one, when a file of its workspace has changed, and while its
    processes take processor time. What it prints and answers does not count: a program may do so for ever.
    """

    def __init__(
        self, limit_s: float, workspace: Path, cpu_s: Callable[[], float] = processes.cpu_below
    ) -> None:
        """Silent after `limit_s` seconds; `cpu_s` tells the processor seconds of the agent's processes so far."""
        self.limit_s = limit_s
        self.submits = 0
        """It has asked for so many."""
        self._workspace = workspace
        self._cpu_s = cpu_s
        self._running = False
        self._active_at = time.monotonic()

    def told(self, submits: int, running: bool) -> None:
        """How many submits it has asked for, and whether one has no answer yet."""
        if submits != self.submits or running or self._running:
            self._active_at = time.monotonic()
        self.submits, self._running = submits, running

    async def silence(self) -> str:
        """Returns when it has lasted for `limit_s`, with what to say of it."""
        pause_s = min(self.limit_s / _LOOKS, 3600.0)
        while True:
            cpu_s, looked_at = self._cpu_s(), time.monotonic()
            await asyncio.sleep(pause_s)
            now = time.monotonic()
            if self._running or self._cpu_s() - cpu_s > _BUSY_SHARE * (now - looked_at):
                self._active_at = now
            if now - self._active_at < self.limit_s:
                continue
            # A workspace may hold very many files, so it is looked at only when nothing else was seen.
            unchanged_s = max(0.0, time.time() - await asyncio.to_thread(_last_change, self._workspace))
            if unchanged_s >= self.limit_s:
                return (
                    f"for {self.limit_s:g} s it asked for no submit, changed no file of its workspace and took no"
                    " processor time"
                )
            self._active_at = now - unchanged_s


def _last_change(folder: Path) -> float:
    """Latest change of a file below a folder, Unix time; feedback aside, which is not the agent's to write."""
    last = 0.0
    for root, folders, files in os.walk(folder):
        if Path(root) == folder and "feedback" in folders:
            folders.remove("feedback")
        for name in files:
            with contextlib.suppress(OSError):
                last = max(last, os.lstat(os.path.join(root, name)).st_ctime)
    return last
