"""Bounds of the parts of a message, enforced by the decoder and by `codec.encode` before sending.

`codec.MAX_MESSAGE_BYTES` bounds a message as a whole.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Annotated, Any, TypeVar

from msgspec import Meta, Struct, inspect, to_builtins

T = TypeVar("T")

MAX_DEPTH = 32
"""Maximal nesting of a `Plain` value."""
MAX_VALUES = 1 << 20
"""Maximal number of values in it."""

Word = Annotated[str, Meta(max_length=1024)]
"""A name, an id, a token, a digest."""
Text = Annotated[str, Meta(max_length=1 << 18)]
Bytes = Annotated[bytes, Meta(max_length=16 << 20)]
Blob = Annotated[bytes, Meta(max_length=1 << 30)]
"""Bytes that a slot's pipe carries whole. In a message to or from the coordinator, its own limit is the lower one."""
Int = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Number = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
"""A finite float."""
LARGEST = 1e100
"""Greatest magnitude of a return and of every other number of a run, so that sums over many runs and sums of squares
stay finite."""
Many = Annotated[tuple[T, ...], Meta(max_length=1 << 20)]
Named = Annotated[dict[Word, T], Meta(max_length=1 << 16)]
Plain = Annotated[dict[str, Any], Meta(max_length=1 << 16, extra={"plain": True})]
"""Data of JSON's kinds; `check_plain` checks and bounds its content."""


def check_plausible(record: T) -> T:
    """Returns the record. Raises ValueError for a field with a number beyond `LARGEST`, which JSON allows."""
    queue: list[tuple[str, object]] = [("", to_builtins(record))]
    while queue:
        name, value = queue.pop()
        if isinstance(value, dict):
            queue += [(f"{name}.{key}" if name else str(key), inner) for key, inner in value.items()]
        elif isinstance(value, list | tuple):
            queue += [(name, inner) for inner in value]
        elif isinstance(value, int | float) and not -LARGEST <= value <= LARGEST:
            raise ValueError(f"{name}: a number beyond {LARGEST:g} is not plausible in a run")
    return record


def plain_parts(message: Struct) -> Iterator[object]:
    """Yields the `Plain` parts of a message and of the structs in it."""
    for name, plain in _fields(type(message)):
        value = getattr(message, name)
        if value is None:
            continue
        if plain:
            yield value
        else:
            for item in value if isinstance(value, tuple) else (value,):
                yield from plain_parts(item)


@cache
def _fields(kind: type) -> tuple[tuple[str, bool], ...]:
    """The fields of a struct that are `Plain` (True), or structs or tuples of structs with such fields (False)."""
    info = inspect.type_info(kind)
    assert isinstance(info, inspect.StructType)
    fields = []
    for field in info.fields:
        kinds = list(_alternatives(field.type))
        if any(isinstance(each, inspect.Metadata) and (each.extra or {}).get("plain") for each in kinds):
            fields.append((field.name, True))
        elif any(isinstance(each, inspect.StructType) and _fields(each.cls) for each in kinds):
            fields.append((field.name, False))
    return tuple(fields)


def _alternatives(kind: inspect.Type) -> Iterator[inspect.Type]:
    """The types that a field may have, and for a tuple also those of its items."""
    if isinstance(kind, inspect.UnionType):
        for each in kind.types:
            yield from _alternatives(each)
    elif isinstance(kind, inspect.VarTupleType):
        yield from _alternatives(kind.item_type)
    else:
        yield kind
        if isinstance(kind, inspect.Metadata):
            yield from _alternatives(kind.type)


def check_plain(value: object) -> None:
    """Raises ValueError for a value that nests too deep, consists of too many values, or is not what JSON has."""
    n = 0
    level = [value]
    for _ in range(MAX_DEPTH):
        n += len(level)
        if n > MAX_VALUES:
            raise ValueError(f"it is made of more than {MAX_VALUES:,} values")
        level = [item for part in level for item in _items(part)]
        if not level:
            return
    raise ValueError(f"it nests deeper than {MAX_DEPTH}")


def _items(part: object) -> Iterable[object]:
    if isinstance(part, dict):
        for key in part:
            if not isinstance(key, str):
                raise ValueError(f"a key in it is {key!r:.80}; keys have to be texts")
        return part.values()
    if isinstance(part, list | tuple):
        return part
    if isinstance(part, float) and not math.isfinite(part):
        # JSON would have null in its place, so a digest would not tell them apart.
        raise ValueError(f"a number in it is {part}; JSON has no such number")
    if part is None or isinstance(part, str | int | float):
        return ()
    raise ValueError(f"a value in it is of type {type(part).__name__}; JSON has no such value")
