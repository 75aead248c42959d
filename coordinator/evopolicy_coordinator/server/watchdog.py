"""Tells when the event loop stands still, and where.

A coordinator whose loop stands hears no heartbeats; the core then lets nothing expire, but whoever wrote the code that
stood still should know.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
import traceback

import structlog

log: structlog.stdlib.BoundLogger = structlog.get_logger()

GAP_S = 1.0
_BEAT_S = 0.25


class LoopWatchdog:
    """A thread that watches the running event loop; made on that loop, stopped by `close`."""

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
            log.warning("the event loop stood still", gap_s=round(gap, 2))
        self._beat = now
        self._handle = self._loop.call_later(_BEAT_S, self._tick)

    def _watch(self) -> None:
        told = 0.0
        while not self._stop.wait(_BEAT_S):
            beat = self._beat
            if time.monotonic() - beat > self._gap_s + _BEAT_S and told != beat:
                told = beat
                log.warning("the event loop stands still", stack=self._stack())

    def _stack(self) -> str:
        """Where the loop's thread is; empty where it moves on too fast to tell."""
        try:
            frame = sys._current_frames().get(self._loop_thread)
            return "" if frame is None else "".join(traceback.format_stack(frame, limit=12))
        except Exception:
            # Frames and source lines are read while they change. To watch on matters more.
            return ""
