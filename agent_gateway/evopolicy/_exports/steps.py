"""An agent's log as steps: prompts, messages with tool calls and their results, notes of ours.

An agent may write anything into its log, so reading takes linear time and bounded memory, and raises for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_common.records.agent_log import LogPart, parts
from evopolicy_common.regular_files import open_regular

MAX_LOG_BYTES = 64 << 20
"""Later bytes of a log are not read; a last step says so."""
_MAX_DEPTH = 8
_MAX_LEVELS = 100
"""Lines whose values are nested deeper are skipped: no reader or writer of JSON here may run out of stack on what
another one read."""
_NOTES = ("turn_failed", "paused", "permission", "log_full")
"""Lines of our own that explain what the agent met."""


@dataclass(kw_only=True)
class LoggedCall:
    id: str
    """Unique within the log."""
    name: str
    arguments: dict[str, Any]


@dataclass(kw_only=True)
class Result:
    """The result of one tool call."""

    call: LoggedCall | None
    """None when the log does not show the call."""
    text: str
    failed: bool


@dataclass(kw_only=True)
class LogStep:
    """A prompt (`user`), a message of the agent with its tool calls and their results, or a note (`system`)."""

    source: Literal["user", "agent", "system"]
    texts: list[str] = field(default_factory=list)
    reasoning: list[str] = field(default_factory=list)
    calls: list[LoggedCall] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)
    at: str | None = None
    """ISO 8601, where the log tells it."""
    key: str = ""
    """Later events with this key belong to the same message."""

    @property
    def text(self) -> str:
        return "\n".join(self.texts)


def read_steps(path: Path) -> list[LogStep]:
    """The steps of a log in order; none when it is missing or not a regular file."""
    log = _Log()
    try:
        # A run directory may be untrusted: a link would quote another file, and reading a pipe would block.
        with open_regular(path) as file:
            for line in file.read(MAX_LOG_BYTES).splitlines():
                log.read_line(line)
            if file.read(1):
                log.step("system").texts.append(f"The log continues after {MAX_LOG_BYTES} bytes.")
    except OSError:
        pass
    return log.steps


class _Log:
    def __init__(self) -> None:
        self.steps: list[LogStep] = []
        self._calls: dict[str, tuple[LogStep, LoggedCall]] = {}
        """The latest call of each id in the log: a resumed program begins to count anew."""
        self._n_calls = 0

    def step(
        self, source: Literal["user", "agent", "system"], key: str = "", at: str | None = None
    ) -> LogStep:
        """The step that an event belongs to: the last one if it has the same key, else a new one."""
        if key and self.steps and self.steps[-1].key == key:
            return self.steps[-1]
        self.steps.append(LogStep(source=source, key=key, at=at))
        return self.steps[-1]

    def read_line(self, line: bytes) -> None:
        try:
            event = msgspec.json.decode(line)
        except DECODE_ERRORS:
            return
        if not isinstance(event, dict) or _is_deeper(event, _MAX_LEVELS):
            return
        at = _time(event.get("timestamp"))
        step: LogStep | None = None
        for part in parts(event):
            match part.kind:
                case "prompt":
                    self.step("user", at=at).texts.append(_text(part.value))
                case "stdout" | "stderr":
                    self.step("agent" if part.kind == "stdout" else "system", part.kind, at).texts.append(
                        part.value
                    )
                case "note" if part.name in _NOTES:
                    self.step("system", at=at).texts.append(f"{part.name}: {_json(part.value)}")
                case "result":
                    self.result(part)
                case "call" | "text" | "thinking" if part.by_agent:
                    step = step or self.step("agent", part.message, at)
                    if part.kind == "call":
                        self.call(step, part)
                    elif text := _text(part.value).strip():
                        (step.texts if part.kind == "text" else step.reasoning).append(text)

    def call(self, step: LogStep, part: LogPart) -> None:
        self._n_calls += 1
        unique = part.id
        while not unique or unique in self._calls:
            unique = f"{part.id or 'call'}-{self._n_calls}"
            self._n_calls += unique in self._calls
        arguments = {"command": part.value} if part.name == "shell" else part.value
        if not isinstance(arguments, dict):
            arguments = {} if arguments is None else {"input": arguments}
        call = LoggedCall(id=unique, name=part.name or "tool", arguments=arguments)
        step.calls.append(call)
        self._calls[part.id] = self._calls[unique] = step, call

    def result(self, part: LogPart) -> None:
        step, call = self._calls.get(part.id) or (self.step("system"), None)
        step.results.append(Result(call=call, text=_text(part.value), failed=part.failed))


def _text(value: object, depth: int = 0) -> str:
    """A text, or the texts within content blocks; anything else as JSON."""
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, list) and depth < _MAX_DEPTH:
        return "\n".join(_text(one, depth + 1) for one in value)
    if isinstance(value, dict) and depth < _MAX_DEPTH:
        inner = next((value[name] for name in ("text", "content") if name in value), None)
        if inner is not None:
            return _text(inner, depth + 1)
    return _json(value)


def _is_deeper(value: object, levels: int) -> bool:
    """Whether lists and objects are nested more than `levels` deep."""
    if not isinstance(value, dict | list):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_is_deeper(one, levels - 1) for one in inner)


def _json(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _time(value: object) -> str | None:
    try:
        return datetime.fromisoformat(value).isoformat() if isinstance(value, str) else None
    except ValueError:
        return None
