"""`logs/agent.jsonl`: the agent's raw stream, one JSON document per line, bounded in size."""

from __future__ import annotations

import contextlib
from collections import deque
from pathlib import Path
from typing import Any

import orjson

from evopolicy_common.records.secrets import Redaction

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

    def note(self, document: dict[str, Any]) -> None:
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
