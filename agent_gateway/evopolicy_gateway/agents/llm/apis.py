"""OpenAI's Chat Completions and Anthropic's Messages, through the vendors' own libraries, behind one interface.

Both retry a request by themselves after rate limits, overload and lost connections, and honour `retry-after`. Answers
are streamed, so that a long one meets no timeout on the way.
"""

from __future__ import annotations

import importlib
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evopolicy_gateway.agents.llm import shell

Message = dict[str, Any]

SYSTEM = (
    "You are an autonomous engineer with a shell. Nobody answers questions: decide by yourself and keep working until"
    " the task is done. Your turn ends when you answer without calling the tool."
)
_SKILLS = "\n\nThese files describe skills. Read one with the shell when its description fits what you do:"
_MAX_HEADER = 2000
_TOOL = {"name": shell.NAME, "description": shell.DESCRIPTION}
_COUNTS = ("input_tokens", "cache_read_input_tokens", "cache_creation_input_tokens", "output_tokens")
_LEFT_OUT = "[left out, as the conversation became too long]"
_KEPT_OUTPUTS = (8, 2)
"""Outputs of the last commands that shortening keeps; fewer where the earlier ones are left out already."""
_TOO_LONG = re.compile(
    r"context.{0,20}(length|window|limit|size)|too long|too many tokens|maximum.{0,20}tokens", re.I
)


@dataclass(frozen=True, kw_only=True)
class Call:
    """A command that the model calls."""

    id: str
    name: str = shell.NAME
    given: dict[str, Any] = field(default_factory=dict)
    """The tool and the arguments as the model named them; arguments that are no object in the field `text`."""
    command: str = ""
    timeout_s: float = shell.USUAL_S
    fault: str = ""
    """Why it cannot be run; the model reads this in place of an output."""


@dataclass(frozen=True, kw_only=True)
class Reply:
    """One answer of the model."""

    text: str
    calls: tuple[Call, ...]
    usage: dict[str, int]
    """Tokens by `_COUNTS`; `input_tokens` without cached ones."""

    @property
    def context(self) -> int:
        """Tokens of the conversation so far."""
        return sum(self.usage.values())


class ApiError(Exception):
    """A request failed for good; the library has retried what can be retried."""

    def __init__(self, message: str, status: int | None, retry_after_s: float | None) -> None:
        super().__init__(message)
        self.status = status
        self.retry_after_s = retry_after_s

    @property
    def too_long(self) -> bool:
        """Whether the conversation exceeds the model's context."""
        return self.status in (400, 413) and _TOO_LONG.search(str(self)) is not None


class Api(ABC):
    """One conversation. `messages` have the form of the protocol, without the system prompt."""

    client: str
    """Name of the client's class in the vendor's library, whose own errors are named after it."""

    def __init__(self, settings: dict[str, Any], key: str, messages: list[Message]) -> None:
        self.messages = messages
        self.context_tokens = int(settings["context_tokens"])
        self._max_output_tokens = int(settings["max_output_tokens"])
        self._known = {"model": str(settings["model"]), "extra_body": settings["parameters"]}
        self._system = (settings["system"] or SYSTEM) + _skills(settings.get("skills", ()))
        library: Any = importlib.import_module(self.client.lower())
        self._error: type[Exception] = getattr(library, f"{self.client}Error")
        self._client = getattr(library, self.client)(
            api_key=key or "none",
            max_retries=int(settings["retries"]),
            timeout=float(settings["timeout_s"]),
            base_url=settings["base_url"] or None,
        )

    def say(self, text: str) -> None:
        """Adds a prompt."""
        self.messages.append({"role": "user", "content": text})

    def ask(self) -> Reply:
        """The model's answer, which is added to the messages. Raises ApiError."""
        try:
            return self._ask()
        except self._error as error:
            raise _failure(error) from error
        except Exception as error:
            # A stream that breaks off, and an answer that is none of this API, leave the libraries as errors
            # of any kind.
            why = f"the model's answer cannot be read: {type(error).__name__}: {error}"
            raise ApiError(why, None, None) from error

    @abstractmethod
    def _ask(self) -> Reply:
        """As `ask`, with the errors of the vendor's library."""

    @abstractmethod
    def answer(self, calls: Sequence[Call], outputs: Sequence[str]) -> None:
        """Adds the commands' outputs."""

    @abstractmethod
    def _outputs(self) -> list[Message]:
        """The parts of the messages that hold a command's output in `content`, oldest first."""

    def shorten(self) -> bool:
        """Leaves out the outputs of earlier commands; False when none is left to leave out."""
        outputs = self._outputs()
        for n_kept in _KEPT_OUTPUTS:
            earlier = [part for part in outputs[:-n_kept] if part["content"] != _LEFT_OUT]
            for part in earlier:
                part["content"] = _LEFT_OUT
            if earlier:
                return True
        return False


class OpenAi(Api):
    """Chat Completions."""

    client = "OpenAI"

    def _ask(self) -> Reply:
        text, usage, answered = "", None, False
        calls: dict[int, dict[str, str]] = {}
        stream = self._client.chat.completions.create(
            messages=[{"role": "system", "content": self._system}, *self.messages],
            tools=[{"type": "function", "function": _TOOL | {"parameters": shell.PARAMETERS}}],
            stream=True,
            stream_options={"include_usage": True},
            **self._known,
        )
        for chunk in stream:
            usage = chunk.usage or usage
            for choice in chunk.choices:
                answered = True
                text += choice.delta.content or ""
                for part in choice.delta.tool_calls or ():
                    call = calls.setdefault(part.index, {"id": "", "name": "", "arguments": ""})
                    call["id"] = part.id or call["id"] or f"call_{len(self.messages)}_{part.index}"
                    if part.function is not None:
                        call["name"] += part.function.name or ""
                        call["arguments"] += part.function.arguments or ""
        if not answered:
            raise ValueError("it has no choice")
        sent_back = [
            {
                "id": call["id"],
                "type": "function",
                "function": {"name": call["name"], "arguments": _sent_back(call["arguments"])},
            }
            for call in calls.values()
        ]
        message: Message = {"role": "assistant", "content": text or (None if calls else "")}
        self.messages.append(message | ({"tool_calls": sent_back} if calls else {}))
        cached = _count(getattr(usage, "prompt_tokens_details", None), "cached_tokens")
        fresh = max(0, _count(usage, "prompt_tokens") - cached)
        made = tuple(_call(call["id"], call["name"], call["arguments"]) for call in calls.values())
        return Reply(
            text=text, calls=made, usage=_usage(fresh, cached, 0, _count(usage, "completion_tokens"))
        )

    def answer(self, calls: Sequence[Call], outputs: Sequence[str]) -> None:
        for call, output in zip(calls, outputs, strict=True):
            self.messages.append({"role": "tool", "tool_call_id": call.id, "content": output})

    def _outputs(self) -> list[Message]:
        return [message for message in self.messages if message["role"] == "tool"]


class Anthropic(Api):
    """Messages. The conversation so far is marked for the provider's cache."""

    client = "Anthropic"

    def _ask(self) -> Reply:
        with self._client.messages.stream(
            max_tokens=self._max_output_tokens,
            system=self._system,
            messages=self._marked(),
            tools=[_TOOL | {"input_schema": shell.PARAMETERS}],
            **self._known,
        ) as stream:
            message = stream.get_final_message()
        # With its thinking, whose signature the API checks when it comes back.
        content = [block.model_dump(mode="json", exclude_none=True) for block in message.content]
        self.messages.append({"role": "assistant", "content": content or [{"type": "text", "text": "…"}]})
        calls = [block for block in content if block["type"] == "tool_use"]
        return Reply(
            text="\n".join(block["text"] for block in content if block["type"] == "text"),
            calls=tuple(_call(block["id"], block["name"], block["input"]) for block in calls),
            usage=_usage(*(_count(message.usage, name) for name in _COUNTS)),
        )

    def answer(self, calls: Sequence[Call], outputs: Sequence[str]) -> None:
        blocks = [
            {"type": "tool_result", "tool_use_id": call.id, "content": output}
            for call, output in zip(calls, outputs, strict=True)
        ]
        self.messages.append({"role": "user", "content": blocks})

    def _outputs(self) -> list[Message]:
        lists = [message["content"] for message in self.messages if isinstance(message["content"], list)]
        return [block for blocks in lists for block in blocks if block["type"] == "tool_result"]

    def _marked(self) -> list[Message]:
        *earlier, last = self.messages
        content = last["content"]
        blocks = [{"type": "text", "text": content}] if isinstance(content, str) else list(content)
        blocks[-1] = blocks[-1] | {"cache_control": {"type": "ephemeral"}}
        return [*earlier, last | {"content": blocks}]


APIS: dict[str, type[Api]] = {"openai": OpenAi, "anthropic": Anthropic}
"""By the name of the protocol, which is also that of the library."""


def open_api(settings: dict[str, Any], key: str, messages: list[Message]) -> Api:
    """The conversation over the protocol in `settings`, which `harnesses/coding_agents/llm.py` makes."""
    return APIS[settings["protocol"]](settings, key, messages)


def _skills(paths: Sequence[str]) -> str:
    """The part of the system prompt that lists skills: path and describing header of each file, not the whole text."""
    listed = []
    for path in paths:
        text = Path(path).expanduser().read_text(errors="replace")
        headed = text.startswith("---\n")
        header = text.removeprefix("---\n").partition("\n---" if headed else "\n")[0]
        listed.append(f"\n\n{path}\n{header.strip()[:_MAX_HEADER]}")
    return _SKILLS + "".join(listed) if listed else ""


def _call(identity: str, name: str, arguments: Any) -> Call:
    """A call as the model wrote it, which may be anything."""
    said = _decoded(arguments)
    given = said if isinstance(said, dict) else {"text": str(said)}
    known: dict[str, Any] = {"id": identity, "name": name, "given": given}
    if name != shell.NAME:
        return Call(**known, fault=f"there is no tool {name!r}; the only one is {shell.NAME}")
    if said is not given:
        return Call(**known, fault="the arguments are not a JSON object; give one with `command`")
    try:
        command, timeout_s = given["command"], float(given.get("timeout_s") or shell.USUAL_S)
    except (ValueError, TypeError, KeyError) as error:
        why = f"the arguments cannot be read ({error!r}); give a JSON object with `command`"
        return Call(**known, fault=why)
    if not isinstance(command, str) or not 0.0 < timeout_s < float("inf"):
        return Call(**known, fault="`command` must be a text, and `timeout_s` a number above zero")
    return Call(**known, command=command, timeout_s=min(timeout_s, shell.MOST_S))


def _decoded(arguments: Any) -> Any:
    try:
        return json.loads(arguments) if isinstance(arguments, str) else arguments
    except (ValueError, RecursionError):
        return arguments


def _sent_back(arguments: str) -> str:
    """A call's arguments for later requests, which some endpoints refuse for good when they are no JSON object."""
    return arguments if isinstance(_decoded(arguments), dict) else "{}"


def _count(usage: Any, name: str) -> int:
    return getattr(usage, name, None) or 0


def _usage(*counts: int) -> dict[str, int]:
    return dict(zip(_COUNTS, counts, strict=True))


def _failure(error: Exception) -> ApiError:
    status = getattr(error, "status_code", None)
    headers = getattr(getattr(error, "response", None), "headers", None) or {}
    try:
        retry_after_s = float(headers.get("retry-after", ""))
    except ValueError:
        retry_after_s = None
    return ApiError(str(error) or type(error).__name__, status, retry_after_s)
