"""Child processes of a command: with a parent-death signal, a session of their own, and a log file.

They have sessions of their own so that Ctrl-C reaches only the command, which then ends them in order.
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
"""Ids of this process's running children, which a search for orphans skips."""

_locks: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Lock] = weakref.WeakKeyDictionary()


def starting() -> asyncio.Lock:
    """Lock held while a child is started: between its start and its entry in `live` it would be taken for an orphan."""
    return _locks.setdefault(asyncio.get_running_loop(), asyncio.Lock())


class ChildProcess:
    """A running child. Start it on the main thread: its parent-death signal comes when that thread ends."""

    def __init__(self, process: asyncio.subprocess.Process, log: Path, log_start: int) -> None:
        self._process, self.log, self._log_start = process, log, log_start

    @classmethod
    async def start(
        cls, program: Sequence[str], log: Path, *, talks: bool = False, keeps: Sequence[int] = ()
    ) -> Self:
        """Starts `program` with stderr appended to `log`. `talks`: its stdin and stdout are pipes to this
        process. `keeps`: file descriptors that stay open in it."""
        log.parent.mkdir(parents=True, exist_ok=True)
        pipe = asyncio.subprocess.PIPE if talks else asyncio.subprocess.DEVNULL
        with log.open("ab") as out:
            log_start = out.tell()
            async with starting():
                process = await asyncio.create_subprocess_exec(
                    *ending_with_parent(program),
                    stdin=pipe,
                    stdout=pipe,
                    stderr=out,
                    pass_fds=keeps,
                    start_new_session=True,
                    limit=_LINE_LIMIT,
                    env={
                        name: os.environ[name] for name in os.environ if not name.startswith("EVOPOLICYGYM_")
                    },
                )
                live.add(process.pid)
        ignore_broken_stdin(process)
        return cls(process, log, log_start)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """The exit status; None while it runs."""
        return self._process.returncode

    def last_words(self) -> str:
        """Its error, or else the log's last line, perhaps of another command's process."""
        return last_words(self.log, since=self._log_start)

    async def ended(self) -> int:
        """Waits for its end and returns the exit status."""
        code = await self._process.wait()
        live.discard(self.pid)
        return code

    async def end(self, grace_s: float) -> None:
        """Sends SIGTERM, and SIGKILL after `grace_s` seconds. Does nothing if it has ended already."""
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


def ignore_broken_stdin(process: asyncio.subprocess.Process) -> None:
    """Keeps Python 3.11.2 from logging a traceback when a child ends with unread input, as later versions do."""
    if process.stdin is not None:
        closed = process.stdin._protocol._get_close_waiter(process.stdin)  # type: ignore[attr-defined]
        closed.add_done_callback(asyncio.Future.exception)


def last_words(log: Path, since: int | None = None) -> str:
    """The last line of a log, or empty. With `since`, an offset: the last error after it, if any."""
    try:
        with log.open("rb") as file:
            file.seek(max(since or 0, log.stat().st_size - 4096))
            lines = file.read().decode("utf-8", "replace").strip().splitlines()
    except OSError:
        return ""
    errors = [line for line in lines if line.startswith("error: ")] if since is not None else []
    return _message_of((errors or lines)[-1]) if lines else ""


class _LogLine(msgspec.Struct):
    event: str
    error: str = ""


def _message_of(line: str) -> str:
    """A log line for people: the event and the error of a JSON line."""
    try:
        entry = msgspec.json.decode(line, type=_LogLine)
    except DECODE_ERRORS:
        return line.removeprefix("error: ")
    return f"{entry.event}: {entry.error}" if entry.error else entry.event
