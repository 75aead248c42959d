"""One event loop in a thread of its own: synchronous calls work in scripts, and in notebooks, whose main thread has a loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from evopolicy_common.cli import setup_notices

T = TypeVar("T")

_lock = threading.Lock()
_running: asyncio.AbstractEventLoop | None = None


def loop() -> asyncio.AbstractEventLoop:
    """The loop, which runs from now on.

    The kernel ends child processes with the thread that started them, so this thread lasts as long as the process.
    """
    global _running
    with _lock:
        if _running is None:
            setup_notices()
            _running = asyncio.new_event_loop()
            threading.Thread(target=_running.run_forever, name="evopolicy", daemon=True).start()
        return _running


def call(work: Coroutine[Any, Any, T]) -> T:
    """The result of `work`. Ctrl-C cancels it, waits until it has put its things in order, and is raised then."""
    ended = threading.Event()
    where = loop()

    async def told() -> T:
        try:
            return await work
        finally:
            ended.set()

    if threading.current_thread().name == "evopolicy":
        work.close()
        raise RuntimeError("this is called on evopolicy's own loop: await the call's _async twin there")
    future = asyncio.run_coroutine_threadsafe(told(), where)
    try:
        return future.result()
    except KeyboardInterrupt:
        future.cancel()
        ended.wait()
        raise


async def awaited(work: Coroutine[Any, Any, T]) -> T:
    """The result of `work`, which runs on the one loop, from any other; cancelled, it is cancelled and waited for."""
    ended = threading.Event()

    async def told() -> T:
        try:
            return await work
        finally:
            ended.set()

    future = asyncio.run_coroutine_threadsafe(told(), loop())
    try:
        return await asyncio.wrap_future(future)
    except asyncio.CancelledError:
        await asyncio.to_thread(ended.wait)
        raise
