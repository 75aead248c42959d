"""The bytes between an environment's process and a policy's: observations out, actions in.

Rules: a request is written in one piece, and the reply is exactly one frame. Replies are hostile: they are bounded,
parsed as plain values and arrays, and never executed; any other bytes raise BadReplyError. The other end,
`sandbox/inside/player.py`, defines the same numbers.
"""

from __future__ import annotations

import datetime
import json
import math
import struct
from collections.abc import Callable
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_common.errors import DECODE_ERRORS, WorkerError
from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments.interface.actions import MAX_ITEMS

INIT, LOAD, RESET, ACT, FLUSH, END, COMPILE = 1, 2, 3, 4, 5, 6, 7
OK, INT, FLOAT, ARRAY, FLOATS, GENERIC, FAILED, FAULT = 0, 1, 2, 3, 4, 5, 6, 7
REQUEST_HEADER = struct.Struct("<IBxxxq")
REPLY_HEADER = struct.Struct("<IBxxx")
MAX_REPLY_BYTES = (1 << 20) + (1 << 16)
MAX_DEPTH = 24
MAX_AXES = 16
"""Axes of an array in an action."""
MAX_USED = 1 << 53
"""No process has more bytes than this; a float still counts them one by one."""
VALUE_BYTES = 16
"""Bytes of an action's limit per value that it may contain, since Python's objects take more memory than their
bytes."""

Writer = Callable[[Any], list[Any]]
"""From an observation to the buffers of its payload, in order."""

Step = Callable[[Any, list[Any]], None]
"""Appends the buffers of a value, or of a part of it."""

_INT = struct.Struct("<q")
_COUNT = struct.Struct("<I")
_NONE = 0xFFFFFFFF
"""In place of a number of edges: there are none, and no links."""
_FLOAT = struct.Struct("<d")
_EXT_ARRAY, _EXT_INT = 1, 2
_DTYPES = {
    np.dtype(name).newbyteorder("<").str.encode().ljust(4, b"\0"): np.dtype(name).newbyteorder("<")
    for name in (
        *("bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
        *("float16", "float32", "float64"),
    )
}


class BadReplyError(Exception):
    """The policy's process sent bytes that are no reply; the message describes them."""


_Word = Annotated[str, msgspec.Meta(max_length=200)]


class Report(msgspec.Struct, frozen=True):
    """The exception of the policy's own code, as its process reports it; the policy may have forged the text."""

    stage: _Word
    kind: _Word | None
    message: Annotated[str, msgspec.Meta(max_length=4000)]
    traceback: Annotated[str, msgspec.Meta(max_length=20_000)]
    missing: _Word | None = None
    used: Annotated[int, msgspec.Meta(ge=0, le=MAX_USED)] | None = None
    """Of an action that is too large: its bytes."""


_report_decoder = msgspec.json.Decoder(Report)


def compile_writer(space: SpaceSchema) -> Writer:
    """How observations of this space are laid out: fixed arrays and ints, each on a multiple of 8 bytes, then texts."""
    if space["type"] in ("Box", "Image"):
        shape = tuple(space["shape"])

        def write_array(obs: Any) -> list[Any]:
            if obs.shape != shape:
                raise WorkerError(f"the environment gave an observation of shape {obs.shape}, not {shape}")
            return [obs]

        return write_array
    fixed: list[Callable[[Any, list[Any]], None]] = []
    texts: list[Callable[[Any, list[Any]], None]] = []
    _collect(space, (), fixed, texts)
    steps = [*fixed, *texts]

    def write(obs: Any) -> list[Any]:
        out: list[Any] = []
        for step in steps:
            step(obs, out)
        return out

    return write


def _collect(space: SpaceSchema, path: tuple[Any, ...], fixed: list[Any], texts: list[Any]) -> None:
    kind = space["type"]
    if kind == "Dict":
        for key, part in space["spaces"].items():
            _collect(part, (*path, key), fixed, texts)
    elif kind == "Tuple":
        for index, part in enumerate(space["spaces"]):
            _collect(part, (*path, index), fixed, texts)
    elif kind == "Text":
        texts.append(_text_step(path))
    elif kind in ("Sequence", "Graph", "OneOf"):
        texts.append(_varying_step(path, _spelled(space)))
    elif kind == "Discrete":
        fixed.append(_int_step(path))
    else:
        widths = {"MultiDiscrete": 8, "MultiBinary": 1}
        shape, size = _shape(space), widths.get(kind) or np.dtype(space["dtype"]).itemsize
        fixed.append(_array_step(path, shape, -(int(np.prod(shape, dtype=np.int64)) * size) % 8))


def _at(obs: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        obs = obs[key]
    return obs


def _array_step(
    path: tuple[Any, ...], shape: tuple[int, ...], padding: int
) -> Callable[[Any, list[Any]], None]:
    pad = bytes(padding)

    def step(obs: Any, out: list[Any]) -> None:
        leaf = _at(obs, path)
        if leaf.shape != shape:
            raise WorkerError(f"the environment gave {path} of shape {leaf.shape}, not {shape}")
        out.append(leaf)
        if pad:
            out.append(pad)

    return step


def _int_step(path: tuple[Any, ...]) -> Callable[[Any, list[Any]], None]:
    def step(obs: Any, out: list[Any]) -> None:
        out.append(_INT.pack(_at(obs, path)))

    return step


def _text_step(path: tuple[Any, ...]) -> Callable[[Any, list[Any]], None]:
    def step(obs: Any, out: list[Any]) -> None:
        text = _at(obs, path).encode("utf-8", "surrogatepass")
        out.append(struct.pack("<I", len(text)) + text)

    return step


def _varying_step(path: tuple[Any, ...], spell: Callable[[Any, list[Any]], None]) -> Step:
    def step(obs: Any, out: list[Any]) -> None:
        spell(_at(obs, path), out)

    return step


def _spelled(space: SpaceSchema) -> Step:
    """How a value is laid out whose form the space leaves open: counts before what they count, nothing on a multiple of
    8."""
    kind = space["type"]
    if kind == "Sequence":
        item = _spelled(space["space"])
        if space["stacked"]:
            return lambda value, out: out.extend((_COUNT.pack(len(value)), value))

        def sequence(value: Any, out: list[Any]) -> None:
            out.append(_COUNT.pack(len(value)))
            for each in value:
                item(each, out)

        return sequence
    if kind == "OneOf":
        choices = [_spelled(part) for part in space["spaces"]]

        def one_of(value: Any, out: list[Any]) -> None:
            out.append(_COUNT.pack(value[0]))
            choices[value[0]](value[1], out)

        return one_of
    if kind == "Graph":

        def graph(value: Any, out: list[Any]) -> None:
            nodes, edges, links = value["nodes"], value["edges"], value["edge_links"]
            out += [_COUNT.pack(len(nodes)), _COUNT.pack(_NONE if edges is None else len(edges)), nodes]
            out += [] if edges is None else [edges, links]

        return graph
    if kind in ("Dict", "Tuple"):
        named = list(space["spaces"].items() if kind == "Dict" else enumerate(space["spaces"]))
        parts = [(key, _spelled(part)) for key, part in named]

        def compound(value: Any, out: list[Any]) -> None:
            for key, part in parts:
                part(value[key], out)

        return compound
    return (
        _text_step(())
        if kind == "Text"
        else _int_step(())
        if kind == "Discrete"
        else _array_step((), _shape(space), 0)
    )


def _shape(space: SpaceSchema) -> tuple[int, ...]:
    """Of the array that a value of this space is."""
    if "shape" in space:
        return tuple(space["shape"])
    if space["type"] == "MultiDiscrete":
        return np.shape(space["nvec"])
    return (space["n"],) if isinstance(space["n"], int) else tuple(space["n"])


def elements(space: SpaceSchema) -> int:
    """How many numbers and characters a value of this space has at most."""
    if space["type"] == "Sequence":
        return MAX_ITEMS * elements(space["space"])
    if space["type"] == "OneOf":
        return 1 + max(map(elements, space["spaces"]))
    if space["type"] == "Graph":
        edge = 0 if space["edge_space"] is None else 2 + elements(space["edge_space"])
        return MAX_ITEMS * (elements(space["node_space"]) + edge)
    if space["type"] == "Dict":
        return sum(map(elements, space["spaces"].values()))
    if space["type"] == "Tuple":
        return sum(map(elements, space["spaces"]))
    if space["type"] == "Text":
        return int(space["max_length"])
    if space["type"] == "Discrete":
        return 1
    if space["type"] == "MultiDiscrete":
        return int(np.size(space["nvec"]))
    if space["type"] == "MultiBinary":
        return int(np.prod(space["n"], dtype=np.int64))
    return int(np.prod(space["shape"], dtype=np.int64))


def init_frame(init: dict[str, Any], files: bytes) -> list[bytes]:
    """The first request: the settings of the policy's process, and its bundle."""
    head = json.dumps(init).encode()
    length = len(head) + len(files)
    return [REQUEST_HEADER.pack(length, INIT, len(head)), head, files]


def action(tag: int, payload: bytes, max_values: int = 1024) -> Any:
    """The value that `act` returned. Raises BadReplyError if the bytes encode no value; its validity is not checked
    here.

    `max_values`: how many numbers, texts, lists and dicts, with what is in them, it may be made of; of arrays the
    numbers count, or the innermost lists where there are none.
    """
    try:
        if tag == ARRAY:
            array = _array(payload)
            if array.size > max_values or (not array.size and _numbers(array) > max_values):
                raise ValueError(f"it holds {_numbers(array):,} values; {max_values:,} are the limit")
            return array
        if tag == INT:
            return _INT.unpack(payload)[0]
        if tag == FLOATS:
            if len(payload) > 8 * max_values:
                raise ValueError(f"it holds {len(payload) // 8:,} values; {max_values:,} are the limit")
            return list(struct.unpack(f"<{len(payload) // 8}d", payload))
        if tag == FLOAT:
            return _FLOAT.unpack(payload)[0]
        if tag == GENERIC:
            value = _decoder.decode(payload)
            if (n := _values(value, MAX_DEPTH)) > max_values:
                raise ValueError(f"it holds {n:,} values; {max_values:,} are the limit")
            return value
    except (struct.error, msgspec.DecodeError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise BadReplyError(f"its action cannot be read: {error}") from error
    raise BadReplyError(f"it answered with frame {tag}, which is no action")


def report(payload: bytes) -> Report:
    """The failure in a FAILED frame; BadReplyError when it is none."""
    try:
        return _report_decoder.decode(payload)
    except DECODE_ERRORS as error:
        raise BadReplyError(f"its report of a failure cannot be read: {error}") from error


def _array(data: bytes | memoryview) -> NDArray[Any]:
    code, ndim = struct.unpack_from("<4sI", data)
    dtype = _DTYPES.get(code)
    if dtype is None or ndim > MAX_AXES:
        raise ValueError(f"an array of type {code!r} with {ndim} axes")
    shape = struct.unpack_from(f"<{ndim}I", data, 8)
    return np.frombuffer(data, dtype, offset=8 + 4 * ndim).reshape(shape)


def _numbers(array: NDArray[Any]) -> int:
    """How many numbers an array is written as, or innermost lists where it holds none: (4000000000, 0) takes no
    byte."""
    return array.size or math.prod(max(1, n) for n in array.shape)


def _ext_hook(code: int, data: memoryview) -> Any:
    if code == _EXT_ARRAY:
        return _array(bytes(data))
    if code == _EXT_INT and len(data) <= 1300:
        return int(bytes(data))
    raise ValueError(f"extension {code} of {len(data)} bytes")


_decoder = msgspec.msgpack.Decoder(ext_hook=_ext_hook)


_COUNTED = (dict, list, np.ndarray, datetime.datetime)


def _values(value: Any, left: int) -> int:
    """How many values it is made of.

    ValueError when it nests deeper than `left`, or holds what the shim never sends: timestamps, and keys that are not
    texts.
    """
    if left < 0:
        raise ValueError(f"it nests deeper than {MAX_DEPTH}")
    n = 1
    if isinstance(value, dict):
        if not all(type(key) is str for key in value):
            raise ValueError("a dict with a key that is no text")
        n += len(value)
        value = value.values()
    elif isinstance(value, np.ndarray):
        return _numbers(value)
    elif isinstance(value, datetime.datetime):
        raise ValueError("a timestamp")
    elif not isinstance(value, list):
        return n
    for item in value:
        n += _values(item, left - 1) if isinstance(item, _COUNTED) else 1
    return n
