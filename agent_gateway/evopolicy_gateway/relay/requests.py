"""Reads an agent's requests: their model, their tools, their service tier, and most tokens that they can use. No I/O.

`RULES` has the fields and tools of each API that a run with `models = "declared"` or `hosted_tools = "refuse"` may use.
A template of known fields is a dict of templates by name, a list of the template of its elements, a text that has to
be the value, or `ANY`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import msgspec
import orjson

from evopolicy_gateway.relay.answers import APIS, CHARS_PER_TOKEN, MAX_TOKENS, values

ANY = None
MAX_MARKS = 2_000_000
"""Limit of commas, colons and brackets in a body: each element of a document takes about 100 bytes of memory."""
DEFAULT_OUTPUT = 128_000
"""Most output tokens of an answer whose request states no limit."""
USUAL_TIERS = ("", "auto", "default", "standard", "standard_only")
"""Service tiers at the usual prices."""
_TIERS = ("servicetier", "speed")
_MAX_NAMES, _SHOWN = 20, 200


class RequestRules(msgspec.Struct, frozen=True, kw_only=True):
    """The permitted parts of an API's request."""

    fields: dict[str, Any]
    tools: dict[str, Any]
    """Templates of the tools that the agent runs, by kind."""
    most: tuple[str, ...]
    """Paths of the most output tokens of one answer."""
    hosted: dict[str, Any] = {}
    """Templates of tools that the provider runs."""
    answers: str = ""
    """Path of the number of answers."""


def _template(about: Any) -> Any:
    """A template as `apis.toml` writes it."""
    if isinstance(about, str):
        return dict.fromkeys(about.split(), ANY)
    if isinstance(about, list):
        return [_template(about[0])]
    if "is" in about:
        return about["is"]
    nested = {name: _template(each) for name, each in about.items() if name != "_"}
    return dict.fromkeys(about.get("_", "").split(), ANY) | nested


def _rules(about: dict[str, Any]) -> RequestRules:
    return RequestRules(
        fields=_template(about["fields"]),
        tools=_template(about["tools"]),
        hosted=_template(about.get("hosted", {})),
        most=tuple(about["most"]),
        answers=about.get("answers", ""),
    )


RULES = {api: _rules(about) for api, about in APIS.items()}
RULES["messages/count_tokens"] = RULES["messages"]
RULES["countTokens"] = RULES["generateContent"]
_HOSTED_FIELDS = (
    *("mcp_servers", "plugins", "prompt", "container", "cachedContent"),
    *("web_search_options", "enable_search", "search_parameters"),
)
"""Other fields that let the provider run tools; a stored prompt or cache may have some."""


class RequestFacts(msgspec.Struct, frozen=True, kw_only=True):
    """The facts about a request that the relay decides by."""

    body: bytes = b""
    """The document as it was understood; empty for a request without."""
    with_counts: bytes | None = None
    """The body that also asks for counts, where the request is for a stream that would have none."""
    asked: str = ""
    hosted: tuple[str, ...] = ()
    """Kinds of tools that the provider runs."""
    unknown: str = ""
    """The first place with a field or tool that `RULES` do not know; empty: none."""
    tier: str = ""
    """Service tier, where it is not a usual one."""
    background: bool = False
    n_answers: int = 1
    input: int = 0
    """Estimated tokens of the input."""
    output: int = 0
    """Most tokens of the output, of all answers together."""


def facts(api: str, body: bytes, model: str | None) -> RequestFacts:
    """Reads a request. `model`: the one that its path names. Raises ValueError for what two readers could understand
    in two ways, and for what is too complex."""
    document = parsed(body)
    rules = RULES[api]
    kinds, unknown = _tools(document, rules)
    kinds += [name for name in _HOSTED_FIELDS if document.get(name)]
    unknown += _unknown({name: each for name, each in document.items() if name != "tools"}, rules.fields, "")
    most = [n for path in rules.most for n in values(document, path) if _is_count(n)]
    answers = next(filter(_is_count, values(document, rules.answers)), 1)
    tiers = [each for name, each in document.items() if name.lower().replace("_", "") in _TIERS]
    try:
        data = orjson.dumps(document)
        with_counts = _with_counts(document) if api == "chat/completions" else None
    except TypeError as error:
        raise ValueError(f"the request cannot be sent on: {error}") from error
    return RequestFacts(
        body=data,
        with_counts=with_counts,
        asked=(str(document.get("model", "")) if model is None else model)[:_SHOWN],
        hosted=tuple(sorted(set(kinds))[:_MAX_NAMES]),
        unknown=next(iter(unknown), ""),
        tier=next((str(tier)[:_SHOWN] for tier in tiers if tier not in (None, *USUAL_TIERS)), ""),
        background=bool(document.get("background")),
        n_answers=answers,
        input=len(data) // CHARS_PER_TOKEN,
        output=min(max(most, default=DEFAULT_OUTPUT) * answers, MAX_TOKENS),
    )


def parsed(body: bytes) -> dict[str, Any]:
    """The JSON object of a body. Raises ValueError."""
    if sum(body.count(mark) for mark in b",:[{") > MAX_MARKS:
        raise ValueError(f"the request has more than {MAX_MARKS:,} values")
    try:
        document = json.loads(body.decode(), object_pairs_hook=_once, parse_constant=_no_number)
    except RecursionError as error:
        raise ValueError("the request is nested too deeply") from error
    if not isinstance(document, dict):
        raise ValueError("the request is not a JSON object")
    return document


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the field {twice[:_SHOWN]!r} occurs twice in one object")
    return found


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a number of JSON")


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= MAX_TOKENS


def _with_counts(document: dict[str, object]) -> bytes | None:
    options = document.get("stream_options") or {}
    if document.get("stream") is not True or not isinstance(options, dict) or options.get("include_usage"):
        return None
    return orjson.dumps(document | {"stream_options": options | {"include_usage": True}})


def _tools(document: dict[str, object], rules: RequestRules) -> tuple[list[str], list[str]]:
    """The kinds of tools that the provider runs, without the version of Anthropic's, and the places of unknown parts.
    An unknown kind counts as one of these."""
    hosted: list[str] = []
    unknown: list[str] = []
    for at, tool in _offered(document):
        if not isinstance(tool, dict):
            unknown.append(at)
        for kind, part in _kinds(tool, rules):
            known = rules.tools.get(kind)
            if known is None or (kind == "shell" and next(_unknown(part, known, at), "")):
                hosted.append(kind[:_SHOWN])
                known = known or rules.hosted.get(kind, {})
            unknown += list(_unknown(part, known, at))[:1]
    return hosted, unknown


def _offered(document: dict[str, object]) -> Iterator[tuple[str, object]]:
    """Every tool with its place: those of a message (a search for tools brings some) and of a namespace too."""
    items = document.get("input")
    holders = [("", document)] + [
        (f"input[{n}].", item)
        for n, item in enumerate(items if isinstance(items, list) else ())
        if isinstance(item, dict) and "tools" in item
    ]
    while holders:
        at, holder = holders.pop()
        tools = holder.get("tools")
        for n, tool in enumerate(tools if isinstance(tools, list) else [tools] if tools else ()):
            place = f"{at}tools[{n}]"
            if isinstance(tool, dict) and tool.get("type") == "namespace":
                holders.append((f"{place}.", tool))
                tool = {name: each for name, each in tool.items() if name != "tools"}
            yield place, tool


def _kinds(tool: object, rules: RequestRules) -> list[tuple[str, dict[str, Any]]]:
    """The kinds in a tool, each with its part: Google's may hold several."""
    if not isinstance(tool, dict):
        return []
    if "functionDeclarations" in rules.tools:
        return [
            (re.sub(r"_([a-z])", lambda match: match[1].upper(), name), {name: each})
            for name, each in tool.items()
        ]
    return [(re.sub(r"_\d{8}$", "", str(tool.get("type") or "custom")), tool)]


def _unknown(value: object, known: object, at: str) -> Iterator[str]:
    """The places in `value` that a template does not know."""
    if isinstance(known, str):
        if value != known:
            yield f"{at} = {str(value)[:_SHOWN]}"
    elif isinstance(known, list) and isinstance(value, list):
        for n, each in enumerate(value):
            yield from _unknown(each, known[0], f"{at}[{n}]")
    elif isinstance(known, dict) and isinstance(value, dict):
        # A text in a template has to be there.
        needed = [name for name, each in known.items() if isinstance(each, str) or _has_text(each)]
        for name in dict.fromkeys((*value, *needed)):
            place = f"{at}.{name[:_SHOWN]}".removeprefix(".")
            if name in known:
                yield from _unknown(value.get(name), known[name], place)
            else:
                yield place
    elif known is not ANY:
        yield at


def _has_text(known: object) -> bool:
    return isinstance(known, dict) and any(isinstance(each, str) for each in known.values())
