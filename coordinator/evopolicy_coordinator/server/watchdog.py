"""Logs stalls of the event loop, with the stack.

A coordinator whose loop is blocked receives no heartbeats. The core then lets nothing expire, but developers need to
find the code that blocked.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
import traceback

from evopolicy_common.logs import structlog

log: structlog.stdlib.BoundLogger = structlog.get_logger()

GAP_S = 1.0
_BEAT_S = 0.25


class LoopWatchdog:
    """A thread that watches the running event loop. Construct it on that loop; stop it with `close`."""

    def __init__(self, gap_s: float = GAP_S) -> None:
        self._gap_s = gap_s
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        self._beat = time.monotonic()
        self._stop = threading.Event()
        self._handle = self._loop.call_later(_BEAT_S, self._tick)
        self._thread = threading.Thread(target=self._watch, name="loop-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._handle.cancel()
        self._stop.set()
        self._thread.join()

    def _tick(self) -> None:
        now = time.monotonic()
        gap = now - self._beat - _BEAT_S
        if gap > self._gap_s:
            log.warning("the event loop was blocked", gap_s=round(gap, 2))
        self._beat = now
        self._handle = self._loop.call_later(_BEAT_S, self._tick)

    def _watch(self) -> None:
        reported_at = 0.0
        while not self._stop.wait(_BEAT_S):
            beat = self._beat
            if time.monotonic() - beat > self._gap_s + _BEAT_S and reported_at != beat:
                reported_at = beat
                log.warning("the event loop is blocked", stack=self._stack())

    def _stack(self) -> str:
        """The stack of the loop's thread; empty when it moves on too fast to be read."""
        try:
            frame = sys._current_frames().get(self._loop_thread)
            return "" if frame is None else "".join(traceback.format_stack(frame, limit=12))
        except Exception:
            # Frames and source lines may change while they are read. The watch itself must go on.
            return ""
