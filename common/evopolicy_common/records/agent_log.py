"""The parts of a line of an agent's log: texts, tool calls with their results, and notes.

`logs/agent.jsonl` holds a harness's raw stream, one JSON value a line. Known forms are `stream-json` (Claude Code, the
built-in LLM agent, agents of the Agent Client Protocol), Codex's `exec --json`, the turn protocol (`{"turn", "text",
"stop"}`), and plain lines (`{"type": "stdout", "text"}`). Other lines have no parts. An agent may write anything there:
readers bound what they take from a part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import msgspec

_NOTES = ("turn_failed", "paused", "permission", "log_full", "result", "error")


class LogPart(msgspec.Struct, frozen=True, kw_only=True):
    kind: Literal["prompt", "text", "thinking", "call", "result", "stdout", "stderr", "note"]
    value: Any
    """A text, a call's arguments, a result's content, or a note's fields, as the line has them."""
    name: str = ""
    """The tool of a call, or the type of a note."""
    id: str = ""
    """Of a call, and of its result; empty if the log tells none."""
    failed: bool = False
    """Whether a result is an error."""
    by_agent: bool = True
    message: str = ""
    """Claude Code repeats a message's id with each of its blocks; empty if there is none."""


def parts(line: dict[str, object]) -> Iterator[LogPart]:
    match line:
        case {"type": "prompt"}:
            yield LogPart(kind="prompt", value=line.get("message"), by_agent=False)
        case {"type": "assistant" | "user" as role, "message": dict(message)}:
            content = message.get("content")
            blocks = content if isinstance(content, list) else [{"type": "text", "text": content}]
            for block in blocks:
                if isinstance(block, dict):
                    yield from _block(block, role == "assistant", _name(message.get("id")))
        case {"type": "item.completed", "item": dict(item)}:
            yield from _item(item)
        case {"type": "stdout" | "stderr" as kind, "text": str(text)}:
            yield LogPart(kind=kind, value=text)
        case {"type": str(kind)} if kind in _NOTES:
            fields = {name: value for name, value in line.items() if name not in ("type", "timestamp")}
            yield LogPart(kind="note", name=kind, value=fields, by_agent=False)
        case {"turn": int(), "text": str(text)}:
            yield LogPart(kind="text", value=text)


def _block(block: dict[str, object], by_agent: bool, message: str) -> Iterator[LogPart]:
    match block.get("type"):
        case "text" | "thinking" as kind:
            yield LogPart(kind=kind, value=block.get(kind), by_agent=by_agent, message=message)
        case "tool_use":
            name, call = _name(block.get("name")), _name(block.get("id"))
            yield LogPart(
                kind="call", name=name, id=call, value=block.get("input"), by_agent=by_agent, message=message
            )
        case "tool_result":
            failed, call = block.get("is_error") is True, _name(block.get("tool_use_id"))
            yield LogPart(kind="result", value=block.get("content"), id=call, failed=failed, by_agent=False)


def _item(item: dict[str, object]) -> Iterator[LogPart]:
    """A completed item of Codex: a text, or a call together with its result."""
    kind, call = _name(item.get("type") or item.get("item_type")), _name(item.get("id"))
    failed = item.get("status") == "failed" or item.get("exit_code") not in (0, None)
    if kind in ("agent_message", "assistant_message", "reasoning"):
        yield LogPart(kind="thinking" if kind == "reasoning" else "text", value=item.get("text"))
    elif kind == "command_execution":
        yield LogPart(kind="call", name="shell", id=call, value=item.get("command"))
        yield LogPart(
            kind="result", value=item.get("aggregated_output"), id=call, failed=failed, by_agent=False
        )
    elif kind == "mcp_tool_call":
        name = f"{_name(item.get('server'))}.{_name(item.get('tool'))}"
        answer = item.get("error") or item.get("result")
        yield LogPart(kind="call", name=name, id=call, value=item.get("arguments"))
        yield LogPart(kind="result", value=answer, id=call, failed=failed, by_agent=False)
    else:
        given = {name: value for name, value in item.items() if name not in ("id", "type", "item_type")}
        yield LogPart(kind="call", name=kind, id=call, value=given)


def _name(value: object) -> str:
    return value if isinstance(value, str) else ""
