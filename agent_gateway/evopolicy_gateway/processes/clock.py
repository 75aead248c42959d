"""An agent's two clocks: its total time, and the time since its last activity.

The first pauses during outages of its provider, and waits for hidden episodes do not count. The second applies to plain
programs only, as a coding agent's stream has a timeout of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from evopolicy_gateway.processes import trees as processes

SILENCE_S = 3600.0
"""Default limit of an agent's inactivity, seconds: longer than any pause for thought, far shorter than its wall
limit."""
_POLL_S = 1.0
_SAMPLES = 20
"""Number of measurements of processor time within the limit of inactivity."""
_BUSY_SHARE = 0.05
"""Share of one core above which the agent is active; a program that only waits and polls uses less."""


class AgentClock:
    """Counts down from `limit_s` seconds; pauses and waits for hidden episodes do not count."""

    def __init__(self, limit_s: float, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._limit_s = limit_s
        self._started = now()
        self._paused_s = 0.0
        self._paused_at: float | None = None
        self._held_s = 0.0

    def set_held(self, seconds: float) -> None:
        """Sets the total seconds that its submits waited for hidden episodes, which do not count."""
        self._held_s = max(self._held_s, seconds)

    def used_s(self) -> float:
        now = self._now() if self._paused_at is None else self._paused_at
        return now - self._started - self._paused_s - self._held_s

    def remaining_s(self) -> float:
        """Seconds until the limit; negative when the time is up."""
        return self._limit_s - self.used_s()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        self._paused_at = self._now()
        try:
            yield
        finally:
            self._paused_s += self._now() - self._paused_at
            self._paused_at = None

    async def run_out(self) -> None:
        # Checks repeatedly, as the clock may be paused meanwhile.
        while (remaining_s := self.remaining_s()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(min(remaining_s, _POLL_S))


class Activity:
    """Tracks an agent's recent activity, and detects inactivity.

    An agent is active while one of its submits runs, when it requests one, when a file of its workspace changes, and
    while its processes use processor time. Its output and its answers do not count: a program may produce them forever.
    """

    def __init__(
        self, limit_s: float, workspace: Path, cpu_s: Callable[[], float] = processes.cpu_below
    ) -> None:
        """Inactive after `limit_s` seconds; `cpu_s` returns the processor seconds used by the agent's processes."""
        self.limit_s = limit_s
        self.submits = 0
        self._workspace = workspace
        self._cpu_s = cpu_s
        self._running = False
        self._active_at = time.monotonic()

    def note(self, submits: int, running: bool) -> None:
        """Reports how many submits it has requested, and whether one of them is unanswered."""
        if submits != self.submits or running or self._running:
            self._active_at = time.monotonic()
        self.submits, self._running = submits, running

    async def silence(self) -> str:
        """Returns after `limit_s` seconds of inactivity, with a text that describes it."""
        pause_s = min(self.limit_s / _SAMPLES, 3600.0)
        while True:
            cpu_s, sampled_at = self._cpu_s(), time.monotonic()
            await asyncio.sleep(pause_s)
            now = time.monotonic()
            if self._running or self._cpu_s() - cpu_s > _BUSY_SHARE * (now - sampled_at):
                self._active_at = now
            if now - self._active_at < self.limit_s:
                continue
            # A workspace may hold very many files, so it is scanned only when no other activity was seen.
            unchanged_s = max(0.0, time.time() - await asyncio.to_thread(_last_change, self._workspace))
            if unchanged_s >= self.limit_s:
                return (
                    f"for {self.limit_s:g} s it asked for no submit, changed no file of its workspace and took no"
                    " processor time"
                )
            self._active_at = now - unchanged_s


def _last_change(folder: Path) -> float:
    """Unix time of the latest change of a file below a folder, except in feedback (not the agent's)."""
    last = 0.0
    for root, folders, files in os.walk(folder):
        if Path(root) == folder and "feedback" in folders:
            folders.remove("feedback")
        for name in files:
            with contextlib.suppress(OSError):
                last = max(last, os.lstat(os.path.join(root, name)).st_ctime)
    return last
