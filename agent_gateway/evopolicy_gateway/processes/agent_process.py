"""One program of an agent, and its pipes, of which memory holds at most one line at a time."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections import deque
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import orjson

from evopolicy_common.processes.child_process import ignore_broken_stdin
from evopolicy_common.processes.parent_death import ending_with_parent
from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.jail.settings import without_proxy

MAX_LINE_BYTES = 1 << 20
MAX_LOG_BYTES = 1 << 30
"""Limit of the log, bytes, so that an agent cannot fill the disk. A last line notes that the rest is missing."""


class AgentLog:
    """Appends lines without keys and tokens, unbuffered. Lines that the disk refuses are lost; the agent continues."""

    def __init__(self, path: Path, redact: Redaction | None = None) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab", buffering=0)
        self._left = MAX_LOG_BYTES - path.stat().st_size
        self.redact = redact or Redaction()
        self.last_errors: deque[str] = deque(maxlen=20)
        """The last lines of stderr, for a message about why a program ended."""

    def raw(self, line: bytes, stream: str) -> None:
        """Logs a line of the agent: unchanged if it is JSON on stdout, else wrapped with the name of its stream."""
        line = line.rstrip(b"\r\n")
        if stream == "stderr":
            self.last_errors.append(line[:500].decode("utf-8", "replace").strip())
        if stream == "stdout" and line.startswith(b"{") and len(line) <= MAX_LINE_BYTES:
            with contextlib.suppress(orjson.JSONDecodeError):
                orjson.loads(line)
                self._write(line)
                return
        cut = line[:MAX_LINE_BYTES]
        document: dict[str, Any] = {"type": stream, "text": cut.decode("utf-8", "backslashreplace")}
        if len(cut) < len(line):
            document["cut_bytes"] = len(line) - len(cut)
        self.note(document)

    def note(self, document: dict[str, object]) -> None:
        """Logs a line of our own, such as a prompt. It may hold parts of an agent's message."""
        try:
            line = orjson.dumps(document)
        except TypeError:
            # An agent's message may nest deeper than can be written.
            line = orjson.dumps({"type": str(document.get("type")), "text": "nested too deeply to be kept"})
        self._write(line)

    def close(self) -> None:
        self._file.close()

    def _write(self, line: bytes) -> None:
        if self._left <= 0:
            return
        line = self.redact(line)
        self._left -= len(line) + 1
        if self._left <= 0:
            line = orjson.dumps(
                {"type": "log_full", "text": f"more than {MAX_LOG_BYTES} bytes: the rest is not kept"}
            )
        with contextlib.suppress(OSError):
            self._file.write(line + b"\n")


_CHUNK = 64 << 10
_LAST_WORDS_S = 1.0


class AgentProcess:
    """A running program in a session of its own. All its output goes to the agent's log."""

    def __init__(self, process: asyncio.subprocess.Process, log: AgentLog) -> None:
        self._process = process
        self._log = log
        self._stderr = asyncio.create_task(self._drain_stderr())

    @classmethod
    async def start(
        cls,
        program: list[str],
        cwd: Path,
        environment: Mapping[str, str],
        log: AgentLog,
        *,
        talks: bool,
        pass_fds: Sequence[int] = (),
        joins: Sequence[str] = (),
    ) -> AgentProcess:
        """Starts the program, or raises OSError. `talks`: stdin is a pipe. `joins`: as in `ending_with_parent`."""
        process = await asyncio.create_subprocess_exec(
            *ending_with_parent(program, signal.SIGKILL, joins),
            cwd=cwd,
            env=dict(environment),
            stdin=asyncio.subprocess.PIPE if talks else asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
            pass_fds=tuple(pass_fds),
        )
        ignore_broken_stdin(process)
        return cls(process, log)

    @property
    def pid(self) -> int:
        return self._process.pid

    async def lines(self) -> AsyncIterator[bytes]:
        """Yields lines of stdout until it ends; lines longer than `MAX_LINE_BYTES` are split."""
        assert self._process.stdout is not None
        async for line in _lines(self._process.stdout):
            self._log.raw(line, "stdout")
            yield line

    async def say(self, line: bytes) -> bool:
        """Writes a line to its stdin and waits until the program reads it. Returns False when stdin is closed."""
        stdin = self._process.stdin
        if stdin is not None and not stdin.is_closing():
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                stdin.write(line + b"\n")
                return await self.drained()
        return False

    async def drained(self) -> bool:
        """Waits until the program has read most of its input. Returns False when stdin is closed."""
        stdin = self._process.stdin
        if stdin is not None and not stdin.is_closing():
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                await stdin.drain()
                return True
        return False

    def hang_up(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()

    async def ended(self) -> int:
        """Waits for its end and returns the exit status (negative: the signal that ended it)."""
        # `Process.wait` would also wait for the pipes, which a daemonised child can hold open forever.
        while self._process.returncode is None:  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        return self._process.returncode

    async def close(self) -> None:
        """Stops reading. Call it after the program has ended."""
        # The pipe may still hold the last lines; do not wait for a child that keeps it open.
        await asyncio.wait([self._stderr], timeout=_LAST_WORDS_S)
        self._stderr.cancel()
        await asyncio.gather(self._stderr, return_exceptions=True)
        self.hang_up()
        # asyncio closes the pipes of a process only when all their other ends are closed.
        self._process._transport.close()  # type: ignore[attr-defined]

    async def _drain_stderr(self) -> None:
        assert self._process.stderr is not None
        async for line in _lines(self._process.stderr):
            self._log.raw(line, "stderr")


async def _lines(stream: asyncio.StreamReader) -> AsyncIterator[bytes]:
    buffer = bytearray()
    while chunk := await stream.read(_CHUNK):
        buffer += chunk
        *whole, rest = bytes(buffer).split(b"\n")
        for line in whole:
            yield line
        buffer = bytearray(rest)
        if len(buffer) > MAX_LINE_BYTES:
            yield bytes(buffer)
            buffer.clear()
    if buffer:
        yield bytes(buffer)


def environment_of(urls: Mapping[str, str]) -> dict[str, str]:
    """The operator's variables except this project's own, plus the URLs, to which no proxy leads."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("EVOPOLICY")}
    return kept | dict(urls) | without_proxy(urls, kept)
