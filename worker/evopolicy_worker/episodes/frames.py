"""The bytes between an environment's process and a policy's: observations out, actions in.

Rules: a request is written in one piece, and the reply is exactly one frame. Replies are hostile: they are bounded,
parsed as plain values and arrays, and never executed; any other bytes raise BadReplyError. The other end,
`sandbox/inside/policy_server.py`, defines the numbers.
"""

from __future__ import annotations

import datetime
import functools
import math
import struct
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_common.errors import DECODE_ERRORS, WorkerError
from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments.interface.actions import MAX_ITEMS
from evopolicy_worker.environments.interface.spaces import VARYING, array_of, parts
from evopolicy_worker.sandbox.inside.policy_server import (
    ACT,
    ARRAY,
    FLOAT,
    FLOATS,
    GENERIC,
    INT,
    MAX_AXES,
    MAX_USED,
    NONE,
    REQUEST_HEADER,
    numbers_of,
)

MAX_REPLY_BYTES = (1 << 20) + (1 << 16)
MAX_DEPTH = 24
_MOST_DIGITS = 1300
"""Of an integer of more than 64 bits."""

Writer = Callable[[Any], tuple[list[Any], int]]
"""From an observation to the request for an action, as buffers in order, and its bytes."""

Step = Callable[[Any, list[Any]], None]
"""Appends the buffers of a value, or of a part of it."""

_INT = struct.Struct("<q")
_COUNT = struct.Struct("<I")
_FLOAT = struct.Struct("<d")
_EXT_ARRAY, _EXT_INT = 1, 2
_CODES = ("?", "<i1", "<i2", "<i4", "<i8", "<u1", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8")
_DTYPES = {dtype.str.encode().ljust(4, b"\0"): dtype for dtype in map(np.dtype, _CODES)}


class BadReplyError(Exception):
    """The policy's process sent bytes that are no reply; the message describes them."""


_Word = Annotated[str, msgspec.Meta(max_length=200)]


class PolicyException(msgspec.Struct, frozen=True):
    """The exception of the policy's own code, as its process reports it; the policy may have forged the text."""

    stage: _Word
    kind: _Word | None
    message: Annotated[str, msgspec.Meta(max_length=4000)]
    traceback: Annotated[str, msgspec.Meta(max_length=20_000)]
    missing: _Word | None = None
    used: Annotated[int, msgspec.Meta(ge=0, le=MAX_USED)] | None = None
    """Of an action that is too large: its bytes."""


_report_decoder = msgspec.json.Decoder(PolicyException)


def compile_writer(space: SpaceSchema) -> Writer:
    """How observations of this space are laid out: fixed arrays and ints, each on a multiple of 8 bytes, then texts."""
    if space["type"] in ("Box", "Image"):
        shape, dtype = array_of(space)
        n = math.prod(shape) * dtype.itemsize
        header = REQUEST_HEADER.pack(n, ACT, 0)

        def write_array(obs: Any) -> tuple[list[Any], int]:
            if obs.shape != shape or obs.nbytes != n:
                given = f"shape {obs.shape} and dtype {obs.dtype}"
                raise WorkerError(f"the environment gave an observation of {given}, not {shape} and {dtype}")
            return [header, obs], len(header) + n

        return write_array
    leaves = sorted(_leaves(space), key=lambda leaf: leaf[1]["type"] in ("Text", *VARYING))
    steps = [(path, _step(part, padded=True)) for path, part in leaves]

    def write(obs: Any) -> tuple[list[Any], int]:
        out: list[Any] = [b""]
        for path, step in steps:
            value = obs
            for key in path:
                value = value[key]
            step(value, out)
        n = 0
        for part in out:
            n += len(part) if type(part) is bytes else part.nbytes
        out[0] = REQUEST_HEADER.pack(n, ACT, 0)
        return out, REQUEST_HEADER.size + n

    return write


def _leaves(space: SpaceSchema, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], SpaceSchema]]:
    if space["type"] in ("Dict", "Tuple"):
        for key, part in _named(space):
            yield from _leaves(part, (*path, key))
    else:
        yield path, space


def _named(space: SpaceSchema) -> Iterable[tuple[Any, SpaceSchema]]:
    inner = space["spaces"]
    return inner.items() if isinstance(inner, dict) else enumerate(inner)


def _array_step(space: SpaceSchema, *, padded: bool) -> Step:
    shape, dtype = array_of(space)
    pad = bytes(-(math.prod(shape) * dtype.itemsize) % 8) if padded else b""

    def step(value: Any, out: list[Any]) -> None:
        if value.shape != shape:
            raise WorkerError(f"the environment gave an array of shape {value.shape}, not {shape}")
        out.append(value)
        if pad:
            out.append(pad)

    return step


def _text_step() -> Step:
    last, data = "", _COUNT.pack(0)

    def step(text: Any, out: list[Any]) -> None:
        nonlocal last, data
        if text is not last:  # Many environments give the same text, such as a mission, at each step.
            encoded = text.encode("utf-8", "surrogatepass")
            last, data = text, _COUNT.pack(len(encoded)) + encoded
        out.append(data)

    return step


def _graph_step(value: Any, out: list[Any]) -> None:
    nodes, edges, links = value["nodes"], value["edges"], value["edge_links"]
    out += [_COUNT.pack(len(nodes)), _COUNT.pack(NONE if edges is None else len(edges)), nodes]
    out += [] if edges is None else [edges, links]


def _step(space: SpaceSchema, *, padded: bool = False) -> Step:
    """`padded`: in the fixed part, where arrays end on a multiple of 8 bytes. In a value whose form the space leaves
    open, counts stand before the parts that they count."""
    kind = space["type"]
    if kind == "Text":
        return _text_step()
    if kind == "Discrete":
        return lambda value, out: out.append(_INT.pack(value))
    if kind == "Graph":
        return _graph_step
    if kind == "Sequence":
        if space["stacked"]:
            return lambda value, out: out.extend((_COUNT.pack(len(value)), value))
        item = _step(space["space"])

        def sequence(value: Any, out: list[Any]) -> None:
            out.append(_COUNT.pack(len(value)))
            for each in value:
                item(each, out)

        return sequence
    if kind in ("OneOf", "Dict", "Tuple"):
        steps = {key: _step(part) for key, part in _named(space)}

        def compound(value: Any, out: list[Any]) -> None:
            if kind == "OneOf":
                out.append(_COUNT.pack(value[0]))
                steps[value[0]](value[1], out)
                return
            for key, step in steps.items():
                step(value[key], out)

        return compound
    return _array_step(space, padded=padded)


def elements(space: SpaceSchema) -> int:
    """How many numbers and characters a value of this space has at most."""
    if space["type"] == "Sequence":
        return MAX_ITEMS * elements(space["space"])
    if space["type"] == "OneOf":
        return 1 + max(map(elements, space["spaces"]))
    if space["type"] == "Graph":
        edge = 0 if space["edge_space"] is None else 2 + elements(space["edge_space"])
        return MAX_ITEMS * (elements(space["node_space"]) + edge)
    if space["type"] in ("Dict", "Tuple"):
        return sum(map(elements, parts(space)))
    return int(space["max_length"]) if space["type"] == "Text" else math.prod(array_of(space)[0])


def action(tag: int, payload: bytes, max_values: int = 1024) -> Any:
    """The value that `act` returned. Raises BadReplyError if the bytes encode no value; its validity is not checked
    here.

    `max_values`: how many numbers, texts, lists and dicts, with what is in them, it may be made of; of arrays the
    numbers count, or the innermost lists where there are none.
    """
    value: Any
    try:
        if tag == INT:
            return _INT.unpack(payload)[0]
        if tag == FLOAT:
            return _FLOAT.unpack(payload)[0]
        if tag == ARRAY:
            value = _array(payload)
            n = value.size or numbers_of(value)
        elif tag == FLOATS:
            n = len(payload) // 8
            value = list(struct.unpack(f"<{n}d", payload))
        elif tag == GENERIC:
            value = _decoder.decode(payload)
            n = _values(value, MAX_DEPTH)
        else:
            raise BadReplyError(f"it answered with frame {tag}, which is no action")
        if n > max_values:
            raise ValueError(f"it holds {n:,} values; {max_values:,} are the limit")
    except (struct.error, msgspec.DecodeError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise BadReplyError(f"its action cannot be read: {error}") from error
    return value


def report(payload: bytes) -> PolicyException:
    """The failure in a FAILED frame; BadReplyError when it is none."""
    try:
        return _report_decoder.decode(payload)
    except DECODE_ERRORS as error:
        raise BadReplyError(f"its report of a failure cannot be read: {error}") from error


def _array(data: bytes | memoryview) -> NDArray[Any]:
    if len(data) < 8:
        raise ValueError(f"an array of {len(data)} bytes")
    # The lowest byte of the number of axes; `_form` refuses larger numbers.
    start = 8 + 4 * data[4]
    dtype, shape = _form(bytes(data[:start]))
    array = np.frombuffer(data, dtype, offset=start)
    return array if array.shape == shape else array.reshape(shape)


@functools.lru_cache(256)
def _form(head: bytes) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """Dtype and shape of an array by the bytes before its numbers."""
    code, ndim = struct.unpack_from("<4sI", head)
    dtype = _DTYPES.get(code)
    if dtype is None or ndim > MAX_AXES:
        raise ValueError(f"an array of type {code!r} with {ndim} axes")
    return dtype, struct.unpack_from(f"<{ndim}I", head, 8)


def _ext_hook(code: int, data: memoryview) -> Any:
    if code == _EXT_ARRAY:
        return _array(bytes(data))
    if code == _EXT_INT and len(data) <= _MOST_DIGITS:
        return int(bytes(data))
    raise ValueError(f"extension {code} of {len(data)} bytes")


_decoder = msgspec.msgpack.Decoder(ext_hook=_ext_hook)


_COUNTED = (dict, list, np.ndarray, datetime.datetime)


def _values(value: Any, depth: int) -> int:
    """How many values it is made of.

    ValueError when it nests deeper than `depth`, or holds what the shim never sends: timestamps, and keys that are not
    texts.
    """
    if depth < 0:
        raise ValueError(f"it nests deeper than {MAX_DEPTH}")
    n = 1
    if isinstance(value, dict):
        if not all(type(key) is str for key in value):
            raise ValueError("a dict with a key that is no text")
        n += len(value)
        value = value.values()
    elif isinstance(value, np.ndarray):
        return numbers_of(value)
    elif isinstance(value, datetime.datetime):
        raise ValueError("a timestamp")
    elif not isinstance(value, list):
        return n
    for item in value:
        n += _values(item, depth - 1) if isinstance(item, _COUNTED) else 1
    return n
