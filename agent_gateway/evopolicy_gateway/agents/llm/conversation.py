"""One conversation with a model, through pydantic-ai's `Model` classes, which know the providers.

A provider's answer comes back to it as it came, with its reasoning, signatures and ids. An answer whose stream cannot
be used is asked for once more without streaming, and so are the later ones if that helped.
"""

from __future__ import annotations

import difflib
import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic_ai import exceptions as errors
from pydantic_ai.exceptions import UserError as UserError
from pydantic_ai.messages import (
    ModelMessage,
    ModelMessagesTypeAdapter,
    ModelRequest,
    ModelRequestPart,
    ModelResponse,
    SystemPromptPart,
    TextPart,
    ToolCallPart,
    ToolReturnPart,
    UserPromptPart,
)
from pydantic_ai.models import ModelRequestParameters
from pydantic_ai.tools import ToolDefinition

from evopolicy_gateway.agents.llm import shell
from evopolicy_gateway.agents.llm.models import opened

SYSTEM = (
    "You are an autonomous engineer with a shell. Nobody answers questions: decide by yourself and keep working until"
    " the task is done. Your turn ends when you answer without calling the tool."
)
_SKILLS = "\n\nThese files describe skills. Read one with the shell when its description fits what you do:"
_MAX_HEADER = 2000
_TOOL = ToolDefinition(
    name=shell.NAME, description=shell.DESCRIPTION, parameters_json_schema=shell.PARAMETERS, strict=False
)
_LEFT_OUT = "[left out, as the conversation became too long]"
_KEPT_OUTPUTS = (8, 2)
"""Outputs of the last commands that shortening keeps; fewer where the earlier ones are left out already."""
_TOO_LONG = re.compile(
    r"context.{0,20}(length|window|limit|size)|too long|too many tokens|maximum.{0,20}tokens", re.I
)
_MERGED = re.compile(rf"({shell.NAME}){{2,}}")
"""The name of several calls that a stream gave the same index."""
_AS_TEXT = re.compile(
    r"<tool_call>|<\|tool_calls?|<function=|<function_call|\[TOOL_CALLS\]|\A\W*(json)?\W*\{\s*\"(name|command)\""
)
_CALL_IN_TEXT = (
    "the model wrote a call of the tool as text: the server's tool parser is off, or not that of the model (of vLLM:"
    " --enable-auto-tool-choice --tool-call-parser NAME)"
)
_CUT = "the answer was cut at its length; write less in one answer (api.max_output_tokens, or the server's own limit)"
_NO_TOOLS = re.compile(
    r"tool.{0,60}(support|enabl|allow|requires|parser)|(support|enabl|allow).{0,60}tool", re.I
)
_MAX_NAMES = 20
_LEAST_QUOTA_WAIT_S = 60.0


@dataclass(frozen=True, kw_only=True)
class ToolCall:
    id: str
    name: str = shell.NAME
    given: dict[str, Any] = field(default_factory=dict)
    """The tool and the arguments as the model named them; arguments that are no object in the field `text`."""
    command: str = ""
    timeout_s: float = shell.USUAL_S
    fault: str = ""
    """Why it cannot be run; the model reads this in place of an output."""


@dataclass(frozen=True, kw_only=True)
class ModelReply:
    text: str
    calls: tuple[ToolCall, ...]
    fault: str = ""
    """Why it is neither an end of the turn nor calls of the tool."""
    usage: dict[str, int]
    """Tokens by the names of Anthropic's Messages; `input_tokens` without cached ones."""

    @property
    def context(self) -> int:
        """Tokens of the conversation so far."""
        return sum(self.usage.values())


class ApiError(Exception):
    """A request failed for good; the vendor's library has retried what can be retried."""

    def __init__(
        self,
        message: str,
        status: int | None = None,
        retry_after_s: float | None = None,
        *,
        too_long: bool = False,
    ) -> None:
        """`too_long`: whether the conversation exceeds the model's context."""
        super().__init__(message)
        self.status, self.retry_after_s, self.too_long = status, retry_after_s, too_long


class _AsSent(ToolCallPart):  # type: ignore[misc]
    """A call whose arguments go back byte for byte; the library would write its JSON anew."""

    def args_as_json_str(self) -> str:
        return self.args if isinstance(self.args, str) else super().args_as_json_str()


class Conversation:
    def __init__(self, settings: dict[str, Any], key: str, kept: bytes = b"") -> None:
        """`settings`: made by `harnesses/coding_agents/llm.py`. `kept`: an earlier conversation, from `dumped`."""
        self.context_tokens = int(settings["context_tokens"])
        self._model, self._settings, self._listed = opened(settings, key)
        self._of = settings
        saved = json.loads(kept or "{}")
        self._streams = bool(saved.get("streams", True))
        self.messages: list[ModelMessage] = ModelMessagesTypeAdapter.validate_python(
            saved.get("messages", [])
        )
        for part in _parts(self.messages, ToolCallPart):
            part.__class__ = _AsSent
        self._known = ModelRequestParameters(function_tools=[_TOOL])
        listed = []  # of each skill the path and the describing header, not the whole text
        for path in settings.get("skills", ()):
            text = Path(path).expanduser().read_text(errors="replace")
            headed = text.startswith("---\n")
            header = text.removeprefix("---\n").partition("\n---" if headed else "\n")[0]
            listed.append(f"\n\n{path}\n{header.strip()[:_MAX_HEADER]}")
        self._system = (settings["system"] or SYSTEM) + (_SKILLS + "".join(listed) if listed else "")

    def dumped(self) -> bytes:
        messages = ModelMessagesTypeAdapter.dump_python(self.messages, mode="json")
        return json.dumps({"streams": self._streams, "messages": messages}).encode()

    def say(self, text: str) -> None:
        system: list[ModelRequestPart] = [] if self.messages else [SystemPromptPart(self._system)]
        self.messages.append(ModelRequest([*system, UserPromptPart(text)]))

    async def ask_model(self) -> ModelReply:
        """The model's answer, which is added to the messages. Raises ApiError."""
        try:
            with warnings.catch_warnings(action="ignore"):
                response = await self._response()
            if not response.parts and response.finish_reason is None:
                raise ValueError("it says nothing")
        except errors.ModelHTTPError as error:
            raise await self._told(error) from error
        except errors.ModelConnectionError as error:
            raise ApiError(f"the connection failed: {error}") from error
        except Exception as error:
            # An answer that is none of this API leaves the libraries as errors of any kind.
            text = str(error).partition("\n")[0]
            if isinstance(error, AttributeError | LookupError | TypeError):
                text = "it lacks parts that answers of this API have"
            raise ApiError(f"the model's answer cannot be read: {text}") from error
        made = []
        for n, part in enumerate(_parts([response], ToolCallPart)):
            part.__class__ = _AsSent
            if part.tool_call_id.startswith("pyd_ai_"):
                # The library's random id of a call without one; a replay needs the same each time.
                part.tool_call_id = f"call_{len(self.messages)}_{n}"
            made.append(_call(part.tool_call_id, part.tool_name, part.args))
            if not isinstance(_decoded(part.args), dict):
                part.args = {}  # some endpoints refuse anything else for good
        self.messages.append(response)
        text = "\n".join(part.content for part in _parts([response], TextPart))
        cut = _CUT if response.finish_reason == "length" else ""
        as_text = _CALL_IN_TEXT if not made and _AS_TEXT.search(text) else ""
        return ModelReply(text=text, calls=tuple(made), usage=_usage(response), fault=cut or as_text)

    async def _told(self, error: errors.ModelHTTPError) -> ApiError:
        """The error in words that say what to do."""
        words, status = _words(error.body) or str(error), error.status_code
        too_long = isinstance(error, errors.ModelContextWindowExceededError)
        if too_long or (status in (400, 413) and _TOO_LONG.search(words)):
            why = f"the conversation is longer than the model's context, set context_tokens below it: {words}"
            return ApiError(why, status, too_long=True)
        wait_s = error.retry_after
        if isinstance(error, errors.ModelQuotaExceededError):
            words = f"quota exceeded: {words}"
            # A shorter wait is the relay's or the server's usual one, and brings no quota back.
            wait_s = wait_s if wait_s is not None and wait_s > _LEAST_QUOTA_WAIT_S else None
        elif isinstance(error, errors.ModelAuthenticationError):
            words = (
                f"the provider does not accept the key in {self._of['variable'] or 'no variable'}: {words}"
            )
        elif status in (400, 404, 422, 501) and _NO_TOOLS.search(words):
            words = f"the model or its server takes no tools, which the agent needs: {words}"
        elif isinstance(error, errors.ModelNotFoundError):
            names = await self._listed()
            near = difflib.get_close_matches(self._of["model"], names, _MAX_NAMES, 0.0)
            listed = f"; the server lists {', '.join(near)}" if near else ""
            words = f"there is no model {self._of['model']} for this key: {words}{listed}"
        return ApiError(words, status, wait_s)

    async def _response(self) -> ModelResponse:
        request = (self.messages, self._settings, self._known)
        if not self._streams:
            return await self._model.request(*request)
        try:
            async with self._model.request_stream(*request) as stream:
                async for _ in stream:
                    pass
            if _is_usable(response := stream.get()):
                return response
        except Exception as error:
            if not _is_of_stream(error):
                raise
        response = await self._model.request(*request)
        self._streams = not _is_usable(response)
        return response

    def answer(self, calls: Sequence[ToolCall], outputs: Sequence[str]) -> None:
        pairs = zip(calls, outputs, strict=True)
        parts = [ToolReturnPart(call.name, output, tool_call_id=call.id) for call, output in pairs]
        self.messages.append(ModelRequest(parts))

    def shorten(self) -> bool:
        """Leaves out the outputs of earlier commands; False when none is left to leave out."""
        outputs = _parts(self.messages, ToolReturnPart)
        for n_kept in _KEPT_OUTPUTS:
            earlier = [part for part in outputs[:-n_kept] if part.content != _LEFT_OUT]
            for part in earlier:
                part.content = _LEFT_OUT
            if earlier:
                return True
        return False


def _is_usable(response: ModelResponse) -> bool:
    """Whether an answer says anything, and its calls are neither lost nor several in one."""
    names = [part.tool_name for part in _parts([response], ToolCallPart)]
    lost = response.finish_reason == "tool_call" and not names
    return bool(response.parts) and not lost and not any(map(_MERGED.fullmatch, names))


Part = TypeVar("Part")


def _parts(messages: Sequence[ModelMessage], kind: type[Part]) -> list[Part]:
    return [part for message in messages for part in message.parts if isinstance(part, kind)]


def _is_of_stream(error: Exception) -> bool:
    """Whether the same request may succeed without streaming."""
    if isinstance(error, errors.ModelHTTPError):
        return error.status_code in (400, 422) and "stream" in json.dumps(error.body, default=str)
    return not isinstance(error, errors.ModelConnectionError)


def _words(body: object) -> str:
    """The provider's own words in the body of an error."""
    while isinstance(body, (dict, list)) and body:
        if isinstance(body, list):
            body = body[0]
        else:
            body = next(
                (body[name] for name in ("error", "message", "detail") if body.get(name)), json.dumps(body)
            )
    return body if isinstance(body, str) else ""


def _call(identity: str, name: str, arguments: object) -> ToolCall:
    """A call as the model wrote it, which may be anything."""
    said = _decoded(arguments)
    given = said if isinstance(said, dict) else {"text": str(said)}
    call = ToolCall(id=identity, name=name, given=given)
    if name != shell.NAME:
        return replace(call, fault=f"there is no tool {name!r}; the only one is {shell.NAME}")
    if said is not given:
        return replace(call, fault="the arguments are not a JSON object; give one with `command`")
    try:
        command, timeout_s = given["command"], float(given.get("timeout_s") or shell.USUAL_S)
    except (ValueError, TypeError, KeyError) as error:
        why = f"the arguments cannot be read ({error!r}); give a JSON object with `command`"
        return replace(call, fault=why)
    if not isinstance(command, str) or not 0.0 < timeout_s < float("inf"):
        return replace(call, fault="`command` must be a text, and `timeout_s` a number above zero")
    return replace(call, command=command, timeout_s=min(timeout_s, shell.MOST_S))


def _decoded(arguments: object) -> Any:
    try:
        return json.loads(arguments) if isinstance(arguments, str) else arguments
    except (ValueError, RecursionError):
        return arguments


def _usage(response: ModelResponse) -> dict[str, int]:
    usage = response.usage
    cached, created = usage.cache_read_tokens, usage.cache_write_tokens
    return {
        "input_tokens": max(0, usage.input_tokens - cached - created),
        "cache_read_input_tokens": cached,
        "cache_creation_input_tokens": created,
        "output_tokens": usage.output_tokens,
    }
