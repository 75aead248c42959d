"""One event loop in its own thread: synchronous calls work in scripts, and in notebooks, which already run a loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from evopolicy_common.cli.conventions import setup_notices

T = TypeVar("T")

_lock = threading.Lock()
_running: asyncio.AbstractEventLoop | None = None


def loop() -> asyncio.AbstractEventLoop:
    """Returns the loop; the first call starts it."""
    global _running
    with _lock:
        if _running is None:
            setup_notices()
            _running = asyncio.new_event_loop()
            # The kernel ends child processes with the thread that started them: this one lasts as long as the process.
            threading.Thread(target=_running.run_forever, name="evopolicy", daemon=True).start()
        return _running


def call(work: Coroutine[Any, Any, T]) -> T:
    """Returns the result of `work`. Ctrl-C cancels `work`, waits for its cleanup, and is raised as KeyboardInterrupt.

    Raises RuntimeError when called on the loop's own thread.
    """
    ended = threading.Event()
    where = loop()

    async def notify_end() -> T:
        try:
            return await work
        finally:
            ended.set()

    if threading.current_thread().name == "evopolicy":
        work.close()
        raise RuntimeError("this is called on evopolicy's own loop: await the call's _async twin there")
    future = asyncio.run_coroutine_threadsafe(notify_end(), where)
    try:
        return future.result()
    except KeyboardInterrupt:
        future.cancel()
        ended.wait()
        raise


async def awaited(work: Coroutine[Any, Any, T]) -> T:
    """Returns the result of `work` to a task of another loop. Cancellation cancels `work` and waits for its cleanup."""
    ended = threading.Event()

    async def notify_end() -> T:
        try:
            return await work
        finally:
            ended.set()

    future = asyncio.run_coroutine_threadsafe(notify_end(), loop())
    try:
        return await asyncio.wrap_future(future)
    except asyncio.CancelledError:
        await asyncio.to_thread(ended.wait)
        raise
