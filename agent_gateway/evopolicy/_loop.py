"""One event loop in its own thread: synchronous calls work in scripts, and in notebooks, which already run a loop."""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar

from evopolicy._arguments import in_python
from evopolicy_common.cli.conventions import setup_notices
from evopolicy_common.errors import ConfigError

T = TypeVar("T")
P = ParamSpec("P")
Started = Callable[P, Coroutine[Any, Any, T]]

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
    if threading.current_thread().name == "evopolicy":
        work.close()
        raise RuntimeError("this is called on evopolicy's own loop: await the call's _async twin there")
    ended = threading.Event()
    future = asyncio.run_coroutine_threadsafe(_notifying(work, ended), loop())
    try:
        return future.result()
    except KeyboardInterrupt:
        future.cancel()
        ended.wait()
        raise


async def awaited(work: Coroutine[Any, Any, T]) -> T:
    """Returns the result of `work` to a task of another loop. Cancellation cancels `work` and waits for its cleanup."""
    ended = threading.Event()
    future = asyncio.run_coroutine_threadsafe(_notifying(work, ended), loop())
    try:
        return await asyncio.wrap_future(future)
    except asyncio.CancelledError:
        await asyncio.to_thread(ended.wait)
        raise


async def _notifying(work: Coroutine[Any, Any, T], ended: threading.Event) -> T:
    try:
        return await work
    except ConfigError as error:
        error.args = (in_python(str(error)),)
        raise
    finally:
        ended.set()


def twins(work: Started[P, T]) -> tuple[Callable[P, T], Started[P, T]]:
    """Two public functions with the signature of `work`, which runs on the loop: one that blocks, and its async twin.

    Of `_play` they are `play` and `play_async`; the first has its docstring.
    """

    @functools.wraps(work)
    def blocking(*args: P.args, **kwargs: P.kwargs) -> T:
        return call(work(*args, **kwargs))

    @functools.wraps(work)
    async def awaiting(*args: P.args, **kwargs: P.kwargs) -> T:
        return await awaited(work(*args, **kwargs))

    name = work.__name__.removeprefix("_")
    blocking.__name__, awaiting.__name__ = name, f"{name}_async"
    awaiting.__doc__ = f"Async twin of `{name}`."
    # Python's own errors name the function.
    work.__qualname__ = work.__qualname__.replace(work.__name__, name)
    return blocking, awaiting
