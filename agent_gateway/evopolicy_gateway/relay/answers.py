"""Reads token counts from a model API's answers, in JSON or as a stream of events (SSE). No I/O.

`apis.toml` has the form of each API's answers. An answer is whatever its sender says: a count that is no count is
estimated from the text, at `CHARS_PER_TOKEN`, and so is one that a broken stream or a server without counts did not
send.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import orjson

from evopolicy_gateway.relay.usage import Usage

MAX_EVENT_BYTES = 16 << 20
"""Most bytes of one event, or of an answer in JSON; a longer one breaks off."""
MAX_TOKENS = 10**8
"""Limit of one request's count, above any model's context; a larger one is not believed."""
CHARS_PER_TOKEN = 4
_MAX_NAME = 200
_EVENT_END = re.compile(rb"\r\n\r\n|\n\n|\r\r")


class Shape(msgspec.Struct, frozen=True, kw_only=True):
    """Where an API's answers and events tell counts, as dotted paths; `apis.toml` explains the fields."""

    usage: tuple[str, ...] = ("usage",)
    counts: dict[str, tuple[str, ...]] = {}
    input_includes_cached: bool = True
    model: tuple[str, ...] = ("model",)
    tier: tuple[str, ...] = ("service_tier",)
    text: tuple[str, ...] = ()
    last: frozenset[str] = frozenset()


FREE = Shape()
"""Of an answer that costs nothing."""
APIS: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("apis.toml").read_text("utf-8"))
SHAPES = {api: msgspec.convert(about["answer"], Shape) for api, about in APIS.items()}
"""By `apis.Route.api`."""


class AnswerReader:
    def __init__(self, shape: Shape, *, events: bool, drops_usage: bool = False) -> None:
        """`events`: a stream of events, else one JSON document. `drops_usage`: an event with nothing but counts, which
        the agent did not ask for, is left out of what passes on."""
        self.complete = False
        """Whether the answer has told its last counts."""
        self._shape = shape
        self._events = events
        self._drops_usage = drops_usage
        self._held = bytearray()
        self._counts: dict[str, int] = {}
        self._wrong: set[str] = set()
        self._chars = 0
        self._model = self._tier = ""

    @property
    def held_bytes(self) -> int:
        """Bytes of an event, or of a document, that is not whole yet."""
        return len(self._held)

    def feed(self, data: bytes) -> bytes:
        """Reads the next bytes. Returns those that pass on: whole events, and all of a JSON document at once with
        `end`. Raises ValueError for an event that is too long."""
        searched = max(0, len(self._held) - 3)
        self._held += data
        out, at = [], 0
        for match in _EVENT_END.finditer(self._held, searched) if self._events else ():
            event = bytes(self._held[at : match.end()])
            at = match.end()
            if not (self._read_event(event) and self._drops_usage):
                out.append(event)
        del self._held[:at]
        if len(self._held) > MAX_EVENT_BYTES:
            # All of it may be the model's text: the estimate must not be lower than what was generated.
            self._chars += len(self._held)
            self._held.clear()
            raise ValueError(f"the answer has an event of more than {MAX_EVENT_BYTES:,} bytes")
        return b"".join(out)

    def end(self) -> bytes:
        """Reads the rest at the answer's end, and returns it."""
        rest = bytes(self._held)
        self._held.clear()
        if not self._events:
            self._read(_decoded(rest))
        elif rest:
            self._read_event(rest)
        # A stream of an API that names its last event is whole only with it.
        self.complete = self.complete or not self._events or not self._shape.last
        return rest

    def metered(self, input_tokens: int) -> tuple[Usage, bool, str, str]:
        """The counts, whether they are estimated, model and tier. `input_tokens`: estimated from the request."""
        guessed = set(self._wrong)
        tokens: dict[str, int] = {}
        for kind, paths in self._shape.counts.items():
            told = [self._counts[path] for path in paths if path in self._counts]
            if told:
                tokens[kind] = max(told) if kind == "cache_read" else sum(told)
        if "input" not in tokens:
            tokens["input"] = input_tokens
            guessed.add("input")
        if "output" not in tokens or not self.complete:
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
        return usage, bool(guessed), self._model, self._tier

    def _read_event(self, event: bytes) -> bool:
        """Returns whether the event has counts alone."""
        lines = event.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
        data = b"\n".join(line[5:].removeprefix(b" ") for line in lines if line.startswith(b"data:"))
        if data.strip() == b"[DONE]":
            self.complete = True
            return False
        return self._read(_decoded(data))

    def _read(self, document: object) -> bool:
        if isinstance(document, list):
            # Google's stream without events is one list of documents.
            for each in document:
                self._read(each if isinstance(each, dict) else None)
        if not isinstance(document, dict):
            return False
        shape, told = self._shape, False
        for path in shape.usage:
            for counts in values(document, path):
                for name in dict.fromkeys(each for paths in shape.counts.values() for each in paths):
                    for value in values(counts, name):
                        told = self._count(name, value) or told
        self._model = _name(document, shape.model) or self._model
        self._tier = _name(document, shape.tier) or self._tier
        for path in shape.text:
            self._chars += sum(len(text) for text in values(document, path) if isinstance(text, str))
        self.complete = self.complete or document.get("type") in shape.last
        return told and document.get("choices") == []

    def _count(self, path: str, value: object) -> bool:
        """Takes a count; a missing one (null) is none."""
        if value is None:
            return False
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_TOKENS:
            self._wrong.add(path)
            return False
        self._counts[path] = value
        return True


def values(document: object, path: str) -> Iterator[Any]:
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


def _name(document: object, paths: tuple[str, ...]) -> str:
    found = [each for path in paths for each in values(document, path) if isinstance(each, str)]
    return found[-1][:_MAX_NAME] if found else ""


def _decoded(data: bytes) -> Any:
    try:
        return orjson.loads(data)
    except orjson.JSONDecodeError:
        return None
