"""Every type of message that may reach a gateway, field by field: a field that `gateway_messages.toml` does
not have fails the test. With a new row there its author says that an agent may know the field.

Attacks, each with its defence:
- searches its messages, memory, logs, and workspace for a hidden seed, case, or return: no message to a
  gateway has a field for one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from msgspec import inspect

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.gateway import EpisodeFeedback, GatewayReply, ResultsPage
from evopolicy_common.messages.worker import Message
from evopolicy_common.wire import codec

ALLOWED = tomllib.loads(Path(__file__).with_name("gateway_messages.toml").read_text())
"""Type to field to what the field may hold."""


def described(kind: inspect.Type) -> str:
    """A field's type in short."""
    match kind:
        case inspect.UnionType(types=types):
            return " | ".join(described(one) for one in types)
        case inspect.Metadata(type=plain):
            return described(plain)
        case inspect.StructType(cls=cls):
            return cls.__name__
        case inspect.LiteralType(values=values):
            return " | ".join(repr(value) for value in sorted(values))
        case inspect.VarTupleType(item_type=item) | inspect.ListType(item_type=item):
            return f"[{described(item)}]"
        case inspect.DictType(key_type=key, value_type=value):
            return f"{{{described(key)}: {described(value)}}}"
        case _:
            return type(kind).__name__.removesuffix("Type").lower()


def structs_in(kind: inspect.Type) -> Iterator[inspect.StructType]:
    """Every struct that a value of that type may hold, the type itself first; one that holds itself only once."""
    seen: set[type] = set()

    def walk(one: object) -> Iterator[inspect.StructType]:
        if isinstance(one, inspect.StructType):
            if one.cls in seen:
                return
            seen.add(one.cls)
            yield one
            for field in one.fields:
                yield from walk(field.type)
        elif isinstance(one, inspect.Type):
            for part in one.__struct_fields__:
                held = getattr(one, part)
                for inner in held if isinstance(held, tuple | list) else (held,):
                    yield from walk(inner)

    yield from walk(kind)


def fields_in(kind: Any) -> dict[str, dict[str, str]]:
    """Type to field to what it may hold, of everything that may be in a value of that type."""
    return {
        struct.cls.__name__: {field.name: described(field.type) for field in struct.fields}
        for struct in structs_in(inspect.type_info(kind))
    }


def test_no_message_to_a_gateway_has_a_field_that_is_not_allowed() -> None:
    found = fields_in(GatewayReply)
    for name in {**ALLOWED, **found}:
        remedy = f"if a gateway may be told, [{name}] of gateway_messages.toml says the same as the message"
        assert found.get(name) == ALLOWED.get(name), remedy


def test_what_a_gateway_decodes_is_what_was_walked() -> None:
    assert codec.gateway_replies.type == GatewayReply
    assert {kind.__name__ for kind in get_args(GatewayReply)} <= set(ALLOWED)
    assert all(issubclass(kind, Message) for kind in get_args(GatewayReply))


class LeakyCase(Message, frozen=True, kw_only=True, tag="leaky_case"):
    pages: dict[str, tuple[Case | None, ...]]


class LeakyOutcome(Message, frozen=True, kw_only=True, tag="leaky_outcome"):
    episodes: tuple[EpisodeOutcome, ...]


class SeededFeedback(EpisodeFeedback, frozen=True, kw_only=True):
    case_seed: int


class SeededPage(ResultsPage, frozen=True, kw_only=True, tag="seeded_page"):
    others: tuple[SeededFeedback, ...] = ()


@pytest.mark.parametrize(
    ("message", "planted"), [(LeakyCase, Case), (LeakyOutcome, EpisodeOutcome), (SeededPage, SeededFeedback)]
)
def test_the_walk_finds_what_is_planted_anywhere_below_a_message(message: type, planted: type) -> None:
    found = fields_in(GatewayReply | message)
    assert planted.__name__ in found
    assert found != ALLOWED


def test_the_walk_finds_a_field_that_is_added_to_a_message() -> None:
    found = fields_in(SeededPage)
    assert set(found["SeededFeedback"]) - set(ALLOWED["EpisodeFeedback"]) == {"case_seed"}
    assert found["SeededPage"]["others"] == "[SeededFeedback]"
