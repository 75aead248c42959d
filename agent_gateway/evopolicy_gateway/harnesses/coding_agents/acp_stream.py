"""The Agent Client Protocol's messages as a turn's stream: an agent's texts, tool calls and requests. No I/O.

Chunks of text are put together; the log then gets whole messages in the form of Claude Code's `stream-json`, which the
live page and the reports read. Its raw messages are in the log too.

https://agentclientprotocol.com
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import orjson

from evopolicy_gateway.harnesses.coding_agents.dialect import (
    Dialect,
    TurnReader,
    first_line,
    mapping,
    mappings,
    string,
)
from evopolicy_gateway.harnesses.interface.agent_config import AcpTable, AgentConfig
from evopolicy_gateway.relay.usage import Usage, count

_ENDED = ("end_turn", "max_tokens", "max_turn_requests", "refusal")
"""Reasons to stop after which the agent may be prompted again."""
MODE_THAT_ASKS = "default"
"""The mode in which agents ask the client for permission: the rules of the run decide."""
_CHANGES = ("edit", "delete", "move")
"""Kinds of tools that change files."""
_MAX_TEXT_CHARS = 1 << 20
_MAX_CALLS = 64
"""Tool calls without a result that are remembered; beyond it the oldest is forgotten."""
_MAX_INPUT_BYTES = 256 << 10
"""Of a tool call that is remembered, as JSON."""
_SHOWN_CHUNKS = 64
"""Chunks of a text that may hold its first line."""
_SKILLS = {"claude-agent-acp": "~/.claude/skills", "qwen": "~/.qwen/skills"}
"""Skill folders of programs that do not read `~/.agents/skills`, by program name."""


class Acp(Dialect):
    """An agent that speaks the protocol."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__(config)
        self.name = config.harness
        self.program = config.program
        self.table = config.acp or AcpTable()
        self.cumulative = self.table.counts == "session"
        name = os.path.basename(self.program[0]) if self.program else ""
        self.skills_at = _SKILLS.get(name, self.skills_at)

    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        return list(self.config.extra_args)

    def reader(self) -> AcpReader:
        return AcpReader()


class AcpReader(TurnReader):
    """Reads the notifications of one turn, and the answer that ends it."""

    def __init__(self) -> None:
        super().__init__()
        self._text: list[str] = []
        self._text_chars = 0
        self._entries: list[dict[str, Any]] = []
        self._calls: dict[str, dict[str, Any]] = {}
        """Tool calls without a result, by their ids."""

    def read_event(self, event: Mapping[str, object]) -> None:
        """A `session/update`."""
        kind, content = event.get("sessionUpdate"), mapping(event.get("content"))
        if kind == "agent_message_chunk":
            chunk = string(content.get("text"))
            if chunk and self._text_chars < _MAX_TEXT_CHARS:
                self._text.append(chunk)
                self._text_chars += len(chunk)
            if len(self._text) <= _SHOWN_CHUNKS:
                self.action = first_line("".join(self._text)) or self.action
            # Qwen Code's own field: the tokens of one request to its model.
            self.usage += usage_of(mapping(mapping(event.get("_meta")).get("usage")))
            return
        if kind in ("tool_call", "tool_call_update"):
            self._tool(event)

    def _tool(self, event: Mapping[str, object]) -> None:
        """A tool call, or more about one; some agents report what it does only while it runs, or when it is done."""
        self._whole()
        identity, status = string(event.get("toolCallId")), event.get("status")
        known = self._calls.setdefault(identity, {"title": "", "input": {}})
        if len(self._calls) > _MAX_CALLS:
            del self._calls[next(iter(self._calls))]
        known["title"] = string(event.get("title"))[:_MAX_INPUT_BYTES] or known["title"]
        if isinstance(given := event.get("rawInput"), dict) and _is_short(given):
            known["input"] = given
        command = string(known["input"].get("command"))
        self.action = f"$ {first_line(command)}" if command else first_line(known["title"]) or self.action
        if status not in ("completed", "failed"):
            return
        given = known["input"] or {"title": known["title"]}
        self._entry("assistant", {"type": "tool_use", "id": identity, "name": known["title"], "input": given})
        output = event.get("rawOutput") or event.get("content")
        result = {"type": "tool_result", "tool_use_id": identity, "content": output}
        self._entry("user", result | {"is_error": status == "failed"})
        del self._calls[identity]

    def ended(self, answer: Mapping[str, object]) -> None:
        """The answer to `session/prompt`."""
        self._whole()
        self.done = answer.get("stopReason") in _ENDED
        # The second is Gemini CLI's own field.
        counts = mapping(mapping(mapping(answer.get("_meta")).get("quota")).get("token_count"))
        if usage := mapping(answer.get("usage")):
            self.usage = usage_of(usage)
        elif counts:
            given, output = (count(counts.get(f"{name}_tokens")) for name in ("input", "output"))
            self.usage = Usage(input_noncached=given, output=output)

    def entries(self) -> list[dict[str, Any]]:
        """Entries for the log since the last call."""
        entries, self._entries = self._entries, []
        return entries

    def _whole(self) -> None:
        """The text so far is one message."""
        text = "".join(self._text).strip()
        self._text, self._text_chars = [], 0
        if text:
            self.text = text
            self._entry("assistant", {"type": "text", "text": text})

    def _entry(self, kind: str, block: dict[str, object]) -> None:
        self._entries.append({"type": kind, "message": {"role": kind, "content": [block]}})


def _is_short(given: dict[str, object]) -> bool:
    try:
        return len(orjson.dumps(given)) <= _MAX_INPUT_BYTES
    except TypeError:  # nested too deeply
        return False


class Choice(NamedTuple):
    """A setting that a session offers."""

    option: str
    """Its id; empty for the modes of agents that offer them apart from other settings."""
    current: str
    values: dict[str, str]
    """The values that can be chosen, by themselves and by their names."""


def offered_choice(answer: Mapping[str, object], category: str) -> Choice | None:
    """The setting of a category, such as `model`, in the answer that begins a session."""
    for option in mappings(answer.get("configOptions")):
        if category in (option.get("category"), option.get("id")):
            groups = mappings(option.get("options"))
            listed = [one for group in groups for one in mappings(group.get("options")) or [group]]
            values = {string(one.get("name")): string(one.get("value")) for one in listed}
            values |= {value: value for value in values.values()}
            return Choice(string(option.get("id")), string(option.get("currentValue")), values)
    return None


def offered_modes(answer: Mapping[str, object]) -> Choice | None:
    """The session's modes, which some agents list as one of the settings only."""
    modes = mapping(answer.get("modes"))
    if not modes:
        return offered_choice(answer, "mode")
    ids = [string(mode.get("id")) for mode in mappings(modes.get("availableModes"))]
    return Choice("", string(modes.get("currentModeId")), {each: each for each in ids})


def usage_of(usage: Mapping[str, object]) -> Usage:
    """The paper's token counts from the protocol's `usage`, whose total shows whether the input includes cached
    tokens."""
    given, output, thought = (count(usage.get(f"{name}Tokens")) for name in ("input", "output", "thought"))
    read, written = count(usage.get("cachedReadTokens")), count(usage.get("cachedWriteTokens"))
    total = count(usage.get("totalTokens"))
    apart = total >= given + output + read + written
    own = given if apart else max(0, given - read - written)
    known = own + read + written + output
    return Usage(
        input_noncached=own,
        cache_read=read,
        cache_creation=written,
        output=output + (thought if thought and total >= known + thought else 0),
        reasoning=thought or None,
    )


def permission(request: Mapping[str, object], workspace: PurePosixPath) -> dict[str, Any]:
    """The answer to `session/request_permission`: the jail confines an agent, so everything is allowed but to change
    what the rules protect, the feedback and `AGENTS.md`."""
    call = mapping(request.get("toolCall"))
    paths = [string(place.get("path")) for place in mappings(call.get("locations"))]
    whole = [PurePosixPath(os.path.normpath(workspace / path)) for path in paths]
    protected = (workspace / "feedback", workspace / "AGENTS.md")
    touched = any(path.is_relative_to(each) for path in whole for each in protected)
    forbidden = touched and call.get("kind") in _CHANGES
    for kind in ("reject_once", "reject_always") if forbidden else ("allow_once", "allow_always"):
        for option in mappings(request.get("options")):
            if option.get("kind") == kind and isinstance(option.get("optionId"), str):
                return {"outcome": {"outcome": "selected", "optionId": option["optionId"]}}
    return {"outcome": {"outcome": "cancelled"}}
