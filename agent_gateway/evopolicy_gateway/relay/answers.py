"""Reads token counts from a model API's answers, in JSON or as a stream of events (SSE). No I/O.

Each API is one row of `SHAPES`. An answer is whatever its sender says: a count that is no count is estimated from the
text, at
`CHARS_PER_TOKEN`, and so is one that a broken stream or a server without counts did not send.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

import msgspec
import orjson

from evopolicy_gateway.relay.usage import Usage

MAX_EVENT_BYTES = 16 << 20
"""Most bytes of one event, or of an answer in JSON, that are read for counts; longer ones pass on unread."""
MAX_TOKENS = 10**8
"""Limit of one request's count, above any model's context; a larger one is not believed."""
CHARS_PER_TOKEN = 4
_MAX_NAME = 200
_EVENT_END = re.compile(rb"\r\n\r\n|\n\n|\r\r")
_KINDS = ("input", "cache_read", "cache_creation", "output", "reasoning")


class Shape(msgspec.Struct, frozen=True, kw_only=True):
    """Where an API's answers and events tell counts, as dotted paths."""

    usage: tuple[str, ...]
    """Objects with counts; a later count replaces an earlier one."""
    counts: dict[str, str]
    """Path within such an object by kind."""
    input_includes_cached: bool
    model: tuple[str, ...]
    text: tuple[str, ...]
    """The model's own texts, for an estimate."""
    last: frozenset[str]
    """`type` of the events after which no count follows."""


SHAPES: dict[str, Shape] = {
    "chat/completions": Shape(
        usage=("usage",),
        counts={
            "input": "prompt_tokens",
            "cache_read": "prompt_tokens_details.cached_tokens",
            "output": "completion_tokens",
            "reasoning": "completion_tokens_details.reasoning_tokens",
        },
        input_includes_cached=True,
        model=("model",),
        text=tuple(
            f"choices.*.{part}.{field}"
            for part in ("delta", "message")
            for field in ("content", "reasoning_content", "reasoning", "tool_calls.*.function.arguments")
        ),
        last=frozenset(),
    ),
    "responses": Shape(
        usage=("usage", "response.usage"),
        counts={
            "input": "input_tokens",
            "cache_read": "input_tokens_details.cached_tokens",
            "output": "output_tokens",
            "reasoning": "output_tokens_details.reasoning_tokens",
        },
        input_includes_cached=True,
        model=("model", "response.model"),
        text=("delta", "output.*.content.*.text", "output.*.arguments"),
        last=frozenset(("response.completed", "response.incomplete", "response.failed")),
    ),
    "messages": Shape(
        usage=("message.usage", "usage"),
        counts={
            "input": "input_tokens",
            "cache_read": "cache_read_input_tokens",
            "cache_creation": "cache_creation_input_tokens",
            "output": "output_tokens",
        },
        input_includes_cached=False,
        model=("model", "message.model"),
        text=("delta.text", "delta.thinking", "delta.partial_json", "content.*.text", "content.*.thinking"),
        last=frozenset(("message_stop",)),
    ),
}
"""By the last part of the API's path."""


class AnswerReader:
    """Reads one answer as it comes."""

    def __init__(self, shape: Shape, *, events: bool, drops_usage: bool = False) -> None:
        """`events`: a stream of events, else one JSON document. `drops_usage`: an event with nothing but counts, which
        the agent did not ask for, is left out of what passes on."""
        self.complete = False
        """Whether the answer has told its last counts."""
        self._shape = shape
        self._events = events
        self._drops_usage = drops_usage
        self._held = bytearray()
        self._unread = False
        self._counts: dict[str, int] = {}
        self._wrong: set[str] = set()
        self._chars = 0
        self._model = ""

    def feed(self, data: bytes) -> bytes:
        """Reads the next bytes. Returns those that pass on: whole events, and all of a JSON document at once with
        `end`."""
        searched = max(0, len(self._held) - 3)
        self._held += data
        if len(self._held) > MAX_EVENT_BYTES:
            passed, self._unread = bytes(self._held), True
            self._held.clear()
            # All of it may be the model's text: the estimate must not be lower than what was generated.
            self._chars += len(passed)
            return passed
        if not self._events:
            return b""
        out, at = [], 0
        for match in _EVENT_END.finditer(self._held, searched):
            event = bytes(self._held[at : match.end()])
            at = match.end()
            if not (self._read_event(event) and self._drops_usage):
                out.append(event)
        del self._held[:at]
        return b"".join(out)

    def end(self) -> bytes:
        """Reads the rest at the answer's end, and returns it."""
        rest = bytes(self._held)
        self._held.clear()
        if not self._events:
            self._read(_decoded(rest))
            self.complete = not self._unread
        elif rest:
            self._read_event(rest)
        return rest

    def metered(self, request_bytes: int) -> dict[str, Any]:
        """The counts so far, as fields of a `limits.Request`. `request_bytes`: of the request, for an estimate of the
        input."""
        tokens, guessed = dict(self._counts), set(self._wrong)
        told = self.complete or not self._shape.last
        if "input" not in tokens:
            tokens["input"] = request_bytes // CHARS_PER_TOKEN
            guessed.add("input")
        if "output" not in tokens or not told:
            tokens["output"] = max(tokens.get("output", 0), self._chars // CHARS_PER_TOKEN)
            guessed.add("output")
        cached = tokens.get("cache_read", 0)
        fresh = tokens["input"] - cached if self._shape.input_includes_cached else tokens["input"]
        if fresh < 0:
            fresh, cached = 0, tokens["input"]
            guessed.add("cache_read")
        reasoning = tokens.get("reasoning")
        usage = Usage(
            input_noncached=fresh,
            cache_read=cached,
            cache_creation=tokens.get("cache_creation", 0),
            output=tokens["output"],
            reasoning=None if reasoning is None else min(reasoning, tokens["output"]),
        )
        return {"usage": usage, "estimated": bool(guessed), "answered": self._model}

    def _read_event(self, event: bytes) -> bool:
        """Returns whether the event has counts alone."""
        lines = event.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
        data = b"\n".join(line[5:].removeprefix(b" ") for line in lines if line.startswith(b"data:"))
        if data.strip() == b"[DONE]":
            self.complete = True
            return False
        return self._read(_decoded(data))

    def _read(self, document: Any) -> bool:
        if not isinstance(document, dict):
            return False
        shape, told = self._shape, False
        for path in shape.usage:
            for counts in values(document, path):
                for kind in shape.counts if isinstance(counts, dict) else ():
                    for value in values(counts, shape.counts[kind]):
                        told = self._count(kind, value) or told
        for path in shape.model:
            for name in values(document, path):
                self._model = name[:_MAX_NAME] if isinstance(name, str) else self._model
        for path in shape.text:
            self._chars += sum(len(text) for text in values(document, path) if isinstance(text, str))
        self.complete = self.complete or document.get("type") in shape.last
        return told and document.get("choices") == []

    def _count(self, kind: str, value: Any) -> bool:
        """Takes a count; a missing one (null) is none."""
        if value is None:
            return False
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_TOKENS:
            self._wrong.add(kind)
            return False
        self._counts[kind] = value
        return True


def values(document: Any, path: str) -> Iterator[Any]:
    """Yields every value at a dotted path; nothing for an empty path. `*` stands for each element of a list, and
    `[name=value]` for an object with that value."""
    if not path:
        return
    if path.startswith("["):
        condition, _, rest = path[1:].partition("]")
        name, _, wanted = condition.partition("=")
        if isinstance(document, dict) and document.get(name) == wanted:
            yield from values(document, rest.removeprefix("."))
        return
    head, _, rest = path.partition(".")
    if head == "*":
        inner: Iterable[Any] = document if isinstance(document, list) else ()
    elif isinstance(document, dict) and head in document:
        inner = (document[head],)
    else:
        return
    for value in inner:
        if rest:
            yield from values(value, rest)
        else:
            yield value


def _decoded(data: bytes) -> Any:
    try:
        return orjson.loads(data)
    except orjson.JSONDecodeError:
        return None


class Cleaner:
    """Takes secrets out of a stream of bytes, also one that is divided between pieces."""

    def __init__(self, secrets: tuple[bytes, ...]) -> None:
        self._secrets = secrets
        self._held = b""

    def feed(self, data: bytes) -> bytes:
        """The bytes that may go on. An end that could begin a secret is held back until more is known."""
        data = self._held + data
        for secret in self._secrets:
            data = data.replace(secret, b"[key]")
        starts = (secret[:n] for secret in self._secrets for n in range(1, len(secret)))
        held = max((len(start) for start in starts if data.endswith(start)), default=0)
        self._held = data[len(data) - held :]
        return data[: len(data) - held]

    def end(self) -> bytes:
        """The bytes that are held back at the end of the stream."""
        rest, self._held = self._held, b""
        return rest
