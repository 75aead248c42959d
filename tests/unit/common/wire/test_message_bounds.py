"""Every part of every message has a bound, which holds where a message is made and where it is read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, get_args

import msgspec
import pytest
from msgspec import inspect

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages import bounds
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.gateway import CloseRun, GatewayReply, GatewayRequest
from evopolicy_common.messages.operator import OperatorReply, OperatorRequest
from evopolicy_common.messages.worker import Message, WorkerReply, WorkerRequest
from evopolicy_common.wire import codec

DECODERS = {
    "worker requests": (WorkerRequest, codec.worker_requests),
    "worker replies": (WorkerReply, codec.worker_replies),
    "gateway requests": (GatewayRequest, codec.gateway_requests),
    "gateway replies": (GatewayReply, codec.gateway_replies),
    "operator requests": (OperatorRequest, codec.operator_requests),
    "operator replies": (OperatorReply, codec.operator_replies),
}
MESSAGES = [
    pytest.param(kind, decoder, id=f"{name}: {kind.__name__}")
    for name, (union, decoder) in DECODERS.items()
    for kind in get_args(union)
]

REQUESTS = get_args(WorkerRequest | GatewayRequest | OperatorRequest)
"""Their plain values are looked into."""

Path = tuple[str | int, ...]


def plain(found: inspect.Type) -> bool:
    return isinstance(found, inspect.Metadata) and bool((found.extra or {}).get("plain"))


def parts(found: inspect.Type, path: Path = ()) -> Iterator[tuple[Path, inspect.Type]]:
    """Every part of a type with the path on which it stands in `sample`."""
    if isinstance(found, inspect.Metadata) and not plain(found):
        found = found.type
    if isinstance(found, inspect.UnionType):
        for each in found.types:
            yield from parts(each, path)
        return
    yield path, found
    if isinstance(found, inspect.StructType):
        for field in found.fields:
            yield from parts(field.type, (*path, field.encode_name))
    elif isinstance(found, inspect.VarTupleType):
        yield from parts(found.item_type, (*path, 0))
    elif isinstance(found, inspect.DictType):
        key = sample(found.key_type)
        yield (*path, "key of a map"), found.key_type
        yield from parts(found.value_type, (*path, key))


def sample(found: inspect.Type) -> Any:
    """A valid value of a type, as msgpack has it, with something in every list and map."""
    match found:
        case inspect.Metadata():
            return {} if plain(found) else sample(found.type)
        case inspect.StructType():
            tagged = {found.tag_field: found.tag} if found.tag_field else {}
            return tagged | {field.encode_name: sample(field.type) for field in found.fields}
        case inspect.UnionType():
            return sample(next(each for each in found.types if not isinstance(each, inspect.NoneType)))
        case inspect.VarTupleType():
            return [sample(found.item_type)]
        case inspect.DictType():
            return {sample(found.key_type): sample(found.value_type)}
        case inspect.LiteralType():
            return found.values[0]
        case inspect.EnumType():
            return next(iter(found.cls)).value
    plain_values = {inspect.StrType: "a", inspect.BytesType: b"a", inspect.IntType: 1, inspect.FloatType: 0.5}
    if type(found) in plain_values:
        return plain_values[type(found)]
    if isinstance(found, inspect.BoolType):
        return True
    raise AssertionError(f"no sample of {found}")


def nested(depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = {"a": [value]}
    return value


def encoded(value: Any) -> msgspec.Raw:
    return msgspec.Raw(msgspec.msgpack.encode(value))


ENDLESS = msgspec.Raw(b"\x81\xa1a\x91" * 50_000 + b"\0")
"""Maps in lists, deeper than Python encodes."""
NOT_PLAIN = [
    encoded(value)
    for value in (
        nested(bounds.MAX_DEPTH),
        {"a": [None] * (bounds.MAX_VALUES + 1)},
        {"a": ENDLESS},
        {"a": [{1: 2}]},
        {"a": [b"b"]},
        {"a": [math.nan]},
        {"a": {"b": math.inf}},
        {"a": msgspec.msgpack.Ext(5, b"b")},
    )
]


@cache
def several(kind: type[inspect.Type], n: int) -> msgspec.Raw:
    """A list, or a map with keys of this kind, of `n` parts: encoded once, since some bounds are of millions."""
    if kind is inspect.VarTupleType:
        return encoded([None] * n)
    return encoded({(k if kind is inspect.IntType else f"{k}"): None for k in range(n)})


def beyond(found: inspect.Type) -> list[Any]:
    """Values that a part must not have."""
    match found:
        case inspect.Metadata():
            return NOT_PLAIN
        case inspect.StrType(max_length=int(n)):
            return ["x" * (n + 1), b"\xd6 "]
        case inspect.BytesType(max_length=int(n)):
            return [bytes(n + 1)]
        case inspect.IntType(ge=int(), le=int()):
            return [2**64 - 1]
        case inspect.FloatType(ge=float(), le=float()):
            return [math.nan, math.inf, -math.inf]
        case inspect.VarTupleType(max_length=int(n)):
            return [several(inspect.VarTupleType, n + 1)]
        case inspect.DictType(max_length=int(n)):
            return [several(type(found.key_type), n + 1)]
        case inspect.NoneType():
            return []
        case inspect.EnumType():
            return [7]  # a word that is not known counts as one of a newer version
        case inspect.StructType() | inspect.LiteralType() | inspect.BoolType():
            return ["no such value"]
    raise AssertionError(f"{found} has no bound")


def replaced(value: Any, path: Path, new: Any) -> Any:
    if not path:
        return new
    head, *rest = path
    if head == "key of a map":
        return dict.fromkeys([new], *value.values())
    changed = dict(value) if isinstance(value, dict) else list(value)
    changed[head] = replaced(value[head], tuple(rest), new)
    return changed


@pytest.mark.parametrize(("kind", "decoder"), MESSAGES)
def test_no_part_of_a_message_may_be_beyond_its_bound(kind: type[Message], decoder: Any) -> None:
    found = inspect.type_info(kind)
    whole = sample(found)
    message = codec.decode(decoder, msgspec.msgpack.encode(whole))
    assert codec.decode(decoder, codec.encode(message)) == message
    for path, part in parts(found):
        if not path or (plain(part) and kind not in REQUESTS):
            continue
        for value in beyond(part):
            data = msgspec.msgpack.encode(replaced(whole, path, value))
            if len(data) > codec.MAX_MESSAGE_BYTES and isinstance(part, inspect.BytesType):
                continue
            with pytest.raises(ProtocolError):
                pytest.fail(f"{path}: {codec.decode(decoder, data)}")


def test_what_a_peer_would_refuse_is_not_sent() -> None:
    def close(**fields: Any) -> CloseRun:
        return CloseRun(**{"run": "r", "token": "t", "reason": "agent_stopped"} | fields)

    assert codec.encode(close(agent={"turns": 3, "tokens": {"input": [1, 2]}}))
    for wrong in (
        close(run="r" * 2000),
        close(reason="x" * (1 << 19)),
        close(reason="\ud800"),
        close(reason=7),
        close(agent=nested(200)),
        close(agent=nested(100_000)),
        close(agent={"n": [0] * (bounds.MAX_VALUES + 1)}),
        close(agent={"n": 2**70}),
        close(agent={"n": object()}),
        close(agent={"n": {1: 2}}),
        close(agent={f"{k}": "x" * 60_000 for k in range(300)}),
    ):
        with pytest.raises(ProtocolError, match="a CloseRun"):
            codec.encode(wrong)


@pytest.mark.parametrize("decoder", [decoder for _, decoder in DECODERS.values()])
def test_a_message_longer_than_the_transport_takes_is_refused(decoder: Any) -> None:
    with pytest.raises(ProtocolError, match="are the limit"):
        codec.decode(decoder, bytes(codec.MAX_MESSAGE_BYTES + 1))


def test_outcomes_in_a_blob_are_held_to_the_same_bounds() -> None:
    outcome = EpisodeOutcome(index=0, episode_return=1.0, length=1, terminated=True, truncated=False)
    assert codec.unpack_outcomes(codec.pack_outcomes([outcome])) == (outcome,)
    for wrong in (
        msgspec.structs.replace(outcome, episode_return=math.nan),
        msgspec.structs.replace(outcome, stdout=bytes((16 << 20) + 1)),
    ):
        with pytest.raises(ProtocolError):
            codec.unpack_outcomes(msgspec.msgpack.encode([wrong]))
    # A blob of the greatest size could hold millions, each of which takes more in memory.
    with pytest.raises(ProtocolError, match="length"):
        codec.unpack_outcomes(msgspec.msgpack.encode([outcome] * ((1 << 16) + 1)))
    with pytest.raises(ProtocolError, match="not the outcomes"):
        codec.unpack_outcomes(b"\xc1")
