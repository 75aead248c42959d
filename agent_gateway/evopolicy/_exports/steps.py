"""An agent's log as steps: prompts, messages with tool calls and their results, notes of ours.

`logs/agent.jsonl` holds a harness's raw stream. The known forms are those of `stream-json` (Claude Code, the built-in
LLM agent, agents of the Agent Client Protocol), Codex's `exec --json`, the turn protocol, and plain lines. Other lines
are skipped. An agent may write anything there, so reading takes linear time and bounded memory, and raises for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
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
class Call:
    """A tool call."""

    id: str
    """Unique within the log."""
    name: str
    arguments: dict[str, Any]


@dataclass(kw_only=True)
class Result:
    """The result of one tool call."""

    call: Call | None
    """None when the log does not show the call."""
    text: str
    failed: bool


@dataclass(kw_only=True)
class LogStep:
    """A prompt (`user`), a message of the agent with its tool calls and their results, or a note (`system`)."""

    source: Literal["user", "agent", "system"]
    texts: list[str] = field(default_factory=list)
    reasoning: list[str] = field(default_factory=list)
    calls: list[Call] = field(default_factory=list)
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
                log.read(line)
            if file.read(1):
                log.step("system").texts.append(f"The log continues after {MAX_LOG_BYTES} bytes.")
    except OSError:
        pass
    return log.steps


class _Log:
    """The steps so far."""

    def __init__(self) -> None:
        self.steps: list[LogStep] = []
        self._calls: dict[str, tuple[LogStep, Call]] = {}
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

    def read(self, line: bytes) -> None:
        try:
            event = msgspec.json.decode(line)
        except DECODE_ERRORS:
            return
        if not isinstance(event, dict) or _is_deeper(event, _MAX_LEVELS):
            return
        kind, at = event.get("type"), _time(event.get("timestamp"))
        message, text = event.get("message"), event.get("text")
        if kind == "prompt":
            self.step("user", at=at).texts.append(_text(message))
        elif kind in ("assistant", "user") and isinstance(message, dict):
            self._message(message, at, by_agent=kind == "assistant")
        elif kind == "item.completed" and isinstance(event.get("item"), dict):
            self._item(event["item"], at)
        elif kind in ("stdout", "stderr") and isinstance(text, str):
            self.step("agent" if kind == "stdout" else "system", kind, at).texts.append(text)
        elif kind in _NOTES:
            fields = {name: value for name, value in event.items() if name not in ("type", "timestamp")}
            self.step("system", at=at).texts.append(f"{kind}: {_json(fields)}")
        elif isinstance(event.get("turn"), int) and isinstance(text, str):
            self.step("agent", at=at).texts.append(text)

    def _message(self, message: dict[str, Any], at: str | None, *, by_agent: bool) -> None:
        """A message of `stream-json`. Claude Code repeats a message's id with each of its blocks."""
        identity = message.get("id")
        key = f"message {identity}" if by_agent and isinstance(identity, str) and identity else ""
        content = message.get("content")
        blocks = content if isinstance(content, list) else [{"type": "text", "text": content}]
        step: LogStep | None = None
        for block in blocks:
            if not isinstance(block, dict):
                continue
            kind = block.get("type")
            if kind == "tool_result":
                self.result(block.get("tool_use_id"), block.get("content"), block.get("is_error") is True)
            elif by_agent and kind in ("text", "thinking", "tool_use"):
                step = step or self.step("agent", key, at)
                if kind == "tool_use":
                    self.call(step, block.get("id"), block.get("name"), block.get("input"))
                elif text := _text(block.get("text" if kind == "text" else "thinking")).strip():
                    (step.texts if kind == "text" else step.reasoning).append(text)

    def _item(self, item: dict[str, Any], at: str | None) -> None:
        """A completed item of Codex: a message, reasoning, or a call together with its result."""
        kind = item.get("type") or item.get("item_type")
        identity = item.get("id")
        failed = item.get("status") == "failed" or item.get("exit_code") not in (0, None)
        step = self.step("agent", at=at)
        if kind in ("agent_message", "assistant_message", "reasoning"):
            (step.reasoning if kind == "reasoning" else step.texts).append(_text(item.get("text")))
        elif kind == "command_execution":
            self.call(step, identity, "shell", {"command": item.get("command")})
            self.result(identity, item.get("aggregated_output"), failed)
        elif kind == "mcp_tool_call":
            name = f"{_text(item.get('server'))}.{_text(item.get('tool'))}"
            self.call(step, identity, name, item.get("arguments"))
            self.result(identity, item.get("error") or item.get("result"), failed)
        else:
            given = {name: value for name, value in item.items() if name not in ("id", "type", "item_type")}
            self.call(step, identity, kind, given)

    def call(self, step: LogStep, identity: Any, name: Any, arguments: Any) -> None:
        self._n_calls += 1
        known = identity if isinstance(identity, str) and identity else ""
        unique = known
        while not unique or unique in self._calls:
            unique = f"{known or 'call'}-{self._n_calls}"
            self._n_calls += unique in self._calls
        if not isinstance(arguments, dict):
            arguments = {} if arguments is None else {"input": arguments}
        call = Call(id=unique, name=_text(name) or "tool", arguments=arguments)
        step.calls.append(call)
        self._calls[known] = self._calls[unique] = step, call

    def result(self, identity: Any, content: Any, failed: bool) -> None:
        known = self._calls.get(identity if isinstance(identity, str) else "")
        step, call = known or (self.step("system"), None)
        step.results.append(Result(call=call, text=_text(content), failed=failed))


def _text(value: Any, depth: int = 0) -> str:
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


def _is_deeper(value: Any, levels: int) -> bool:
    """Whether lists and objects are nested more than `levels` deep."""
    if not isinstance(value, dict | list):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_is_deeper(one, levels - 1) for one in inner)


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def _time(value: Any) -> str | None:
    try:
        return datetime.fromisoformat(value).isoformat() if isinstance(value, str) else None
    except ValueError:
        return None
