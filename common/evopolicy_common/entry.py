"""The console scripts: Ctrl-C while a program imports its modules ends it with one line and exit code 130, and so does
a limit on address space that does not hold its modules, with exit code 2.

This module imports next to nothing, so that little time passes before it can do so.
"""

from __future__ import annotations

import importlib
import os
import signal
from functools import partial
from types import FrameType


def interruptible() -> None:
    """From here on Ctrl-C raises KeyboardInterrupt. A command calls it when it has been imported, before it begins."""
    if signal.getsignal(signal.SIGINT) is _interrupted:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _start(module: str, function: str) -> None:
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell's background job ignores it
        signal.signal(signal.SIGINT, _interrupted)
    try:
        getattr(importlib.import_module(module), function)()
    except (ImportError, MemoryError) as error:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            raise
        last = (str(error).strip() or "no memory").splitlines()[-1]
        text = f"error: a limit of {limit >> 10:,} KiB on address space (ulimit -v) is too low: {last}"
        os.write(2, f"{text}; give: ulimit -v unlimited\n".encode())
        os._exit(2)


def _interrupted(_: int, __: FrameType | None) -> None:
    # No exception: an import may swallow it, and there is nothing yet to clean up.
    os.write(2, b"error: interrupted\n")
    os._exit(130)


evopolicy = partial(_start, "evopolicy_gateway.cli.main", "main")
coordinator = partial(_start, "evopolicy_coordinator.cli", "program")
worker = partial(_start, "evopolicy_worker.cli", "main")
"""The programs: `evopolicy` and, with a hyphen after it, the others."""
