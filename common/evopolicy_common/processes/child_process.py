"""Child processes of a command: with a parent-death signal, in a session of their own, with their log in a file.

They are in sessions of their own so that Ctrl-C reaches the command alone, which then ends them in order.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_common.processes.parent_death import ending_with_parent

_LINE_LIMIT = 4 << 20

live: set[int] = set()
"""Ids of the running children of this process, which a search for orphans leaves alone."""

_locks: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Lock] = weakref.WeakKeyDictionary()


def starting() -> asyncio.Lock:
    """Held while a child is started: between its birth and its place in `live` it would be taken for an orphan."""
    return _locks.setdefault(asyncio.get_running_loop(), asyncio.Lock())


class ChildProcess:
    """A running child. Start it on the main thread: it gets its signal when that thread ends."""

    def __init__(self, process: asyncio.subprocess.Process, log: Path) -> None:
        self._process = process
        self.log = log

    @classmethod
    async def start(cls, program: Sequence[str], log: Path, *, talks: bool = False) -> Self:
        """Starts `program` with stderr appended to `log`; `talks`: its standard input and output are pipes to us."""
        log.parent.mkdir(parents=True, exist_ok=True)
        pipe = asyncio.subprocess.PIPE if talks else asyncio.subprocess.DEVNULL
        with log.open("ab") as out:
            async with starting():
                process = await asyncio.create_subprocess_exec(
                    *ending_with_parent(program),
                    stdin=pipe,
                    stdout=pipe,
                    stderr=out,
                    start_new_session=True,
                    limit=_LINE_LIMIT,
                    env={
                        name: value
                        for name, value in os.environ.items()
                        if not name.startswith("EVOPOLICYGYM_")
                    },
                )
                live.add(process.pid)
        return cls(process, log)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.returncode

    async def ended(self) -> int:
        """Its exit status."""
        code = await self._process.wait()
        live.discard(self.pid)
        return code

    async def end(self, grace_s: float) -> None:
        """SIGTERM, and SIGKILL after `grace_s` seconds. Nothing when it is gone already."""
        if self._process.returncode is None:
            self._signal(signal.SIGTERM)
            try:
                async with asyncio.timeout(grace_s):
                    await self.ended()
            except TimeoutError:
                self._signal(signal.SIGKILL)
        await self.ended()

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)


def last_words(log: Path) -> str:
    """The last line of a log, for a message about why its process ended; empty where there is none."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 4096))
            lines = file.read().decode("utf-8", "replace").strip().splitlines()
    except OSError:
        return ""
    return _said(lines[-1]) if lines else ""


class _LogLine(msgspec.Struct):
    event: str
    error: str = ""


def _said(line: str) -> str:
    """A log line for people: of a JSON line what happened and why."""
    try:
        entry = msgspec.json.decode(line, type=_LogLine)
    except DECODE_ERRORS:
        return line.removeprefix("error: ")
    return f"{entry.event}: {entry.error}" if entry.error else entry.event
