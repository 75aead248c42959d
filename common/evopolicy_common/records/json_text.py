"""Encodes values as JSON, with the same bytes every time.

JSON has no NaN and no infinities, so they become the texts `"NaN"`, `"Inf"` and `"-Inf"` wherever a number may stand.
numpy numbers are written in the shortest form that parses to the same number of their own dtype.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
import orjson

from evopolicy_common.errors import DECODE_ERRORS


def json_bytes(value: object) -> bytes:
    """`value` as compact JSON: numpy arrays and numbers, tuples as lists, bytes and unknown objects as text."""
    try:
        data = orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)
    except orjson.JSONEncodeError:
        pass
    else:
        # orjson writes NaN and infinities as null, so output without null contains none. Nearly every row returns here.
        if b"null" not in data:
            return data
    cleaned = plain(value)
    try:
        return orjson.dumps(cleaned, option=orjson.OPT_SERIALIZE_NUMPY)
    except orjson.JSONEncodeError:
        # Hostile policies can produce such values: lone surrogates, integers of more than 64 bits.
        return json.dumps(cleaned, separators=(",", ":"), allow_nan=False, default=_numpy_as_plain).encode()


def _numpy_as_plain(value: object) -> object:
    return json.loads(orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY))


def plain(value: object) -> Any:
    """`value` with every number that JSON cannot represent as text; arrays without such numbers stay arrays."""
    if isinstance(value, float | np.floating):
        if not np.isfinite(value):
            return "NaN" if np.isnan(value) else "Inf" if value > 0 else "-Inf"
        return float(value) if isinstance(value, np.floating) and value.dtype.itemsize > 8 else value
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, np.ndarray):
        return _plain_array(value)
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bytes | bytearray | memoryview):
        return bytes(value).decode("utf-8", "backslashreplace")
    return str(value)


def _plain_array(array: np.ndarray[Any, Any]) -> Any:
    if array.ndim == 0:
        return plain(array[()])
    if array.dtype.kind == "f":
        if array.dtype.itemsize > 8:
            array = array.astype(np.float64)
        if not np.isfinite(array).all():
            return [plain(item) for item in array]
    elif array.dtype.kind not in "iub":
        return [plain(item) for item in array.tolist()]
    return np.ascontiguousarray(array)


# ---- rows ----

_BETWEEN = b'},{"t":'


def rows_text(
    first: int,
    obs: Sequence[object] | None,
    actions: Iterable[object],
    rewards: Iterable[float],
    terminated: Iterable[bool],
    truncated: Iterable[bool],
    infos: Iterable[object],
) -> bytes:
    """Lines of `trajectory.jsonl` from step `first` on: the bytes of `json_bytes` of each row, encoded at
    once. `obs` None: observations are stored in a file of their own."""
    columns = (itertools.repeat(None) if obs is None else obs, actions, rewards, terminated, truncated, infos)
    rows = [
        {
            "t": t,
            "obs": received,
            "action": action,
            "reward": reward,
            "terminated": ended,
            "truncated": cut,
            "info": info,
        }
        for t, (received, action, reward, ended, cut, info) in enumerate(zip(*columns, strict=False), first)
    ]
    try:
        text = orjson.dumps(rows, option=orjson.OPT_SERIALIZE_NUMPY)
    except orjson.JSONEncodeError:
        text = b""
    # Texts of a policy may contain the border of two rows: then there are more matches than borders. The same holds for
    # null, which also stands for NaN.
    nulls = len(rows) if obs is None else 0
    if text and text.count(_BETWEEN) == len(rows) - 1 and text.count(b"null") == nulls:
        return text[1:-1].replace(_BETWEEN, b'}\n{"t":') + b"\n"
    return b"".join([json_bytes(row) + b"\n" for row in rows])


def as_lists(value: object) -> Any:
    """`value` in the form that policies with `observations` "lists" receive."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: as_lists(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [as_lists(item) for item in value]
    return value


def objects(lines: Iterable[bytes]) -> Iterator[dict[str, Any]]:
    """The JSON objects among the lines, in order; all other lines are skipped."""
    for line in lines:
        try:
            value = msgspec.json.decode(line)
        except DECODE_ERRORS:
            continue
        if isinstance(value, dict):
            yield value
