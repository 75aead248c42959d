"""The part of a simulator's `info` that goes into a trajectory: plain scalars, short strings, short lists, one level
of dicts.

The keys `OURS` are ours in every row; an environment's own values under them get the prefix `THEIRS`.
Values that name a seed, and values of the simulator's own types, are left out. The result can be encoded as JSON and
msgpack (the trajectory codec encodes NaN and infinities).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from evopolicy_worker.environments.interface.spaces import as_text

MAX_ELEMENTS = 16
"""Longer arrays, lists and nested dicts are dropped."""
MAX_CHARACTERS = 256
"""Longer strings are dropped."""
OURS = frozenset({"steps", "action_invalid", "policy_failed"})
"""Number of steps so far, and the marks of an action that was repaired, and of one in place of a failed policy's."""
THEIRS = "environment."

_KEPT = (float, bool)
_SCALARS: dict[type, Callable[[Any], Any]] = {
    **dict.fromkeys(_KEPT, lambda value: value),
    int: lambda value: value if -(2**63) <= value < 2**63 else None,
    np.bool_: bool,
    **dict.fromkeys((np.float16, np.float32, np.float64), float),
    **dict.fromkeys((np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32), int),
}


def plain_info(info: Mapping[Any, Any]) -> dict[str, Any]:
    """The part of `info` that may be kept, as plain values, in the simulator's order."""
    plain: dict[str, Any] = {}
    for key, value in info.items():
        kind = type(value)
        kept = value if kind in _KEPT else _SCALARS.get(kind, _compound)(value)
        if kept is not None and _may_name(key):
            plain[key] = kept
    return plain


def _compound(value: Any) -> Any:
    """A short string, list or dict as plain values; None when it is not kept."""
    if isinstance(value, str):
        return as_text(value) if len(value) <= MAX_CHARACTERS else None
    if isinstance(value, np.ndarray):
        is_plain = value.dtype.kind in "biuf" and value.dtype != np.longdouble
        return value.tolist() if value.size <= MAX_ELEMENTS and is_plain else None
    if isinstance(value, Mapping):
        flat = {key: _scalar(item) for key, item in value.items() if _may_name(key)}
        return flat if len(flat) <= MAX_ELEMENTS and None not in flat.values() else None
    if isinstance(value, list | tuple):
        items = [_scalar(item) for item in value[: MAX_ELEMENTS + 1]]
        return items if len(items) <= MAX_ELEMENTS and None not in items else None
    return None


def _scalar(value: Any) -> Any:
    convert = _SCALARS.get(type(value))
    return None if convert is None else convert(value)


@lru_cache(maxsize=4096)
def _may_name(key: Any) -> bool:
    return isinstance(key, str) and "seed" not in key.lower() and as_text(key) == key
