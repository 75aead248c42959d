"""From what a simulator returns to a plain observation, compiled once per space because it runs on every step.

The result holds numpy arrays that are fresh, C-contiguous and of exactly the dtype of the space; ints for Discrete;
strings for Text; dicts in the order of the schema; tuples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from evopolicy_common.messages.environment import SpaceSchema

Converter = Callable[[Any], Any]


def compile_observation(schema: SpaceSchema) -> Converter:
    """A function from the simulator's observation to the plain one of this space. TypeError for an unknown space."""
    kind = schema["type"]
    if kind in ("Box", "Image"):
        return _array(np.dtype(schema["dtype"]))
    if kind == "MultiDiscrete":
        return _array(np.dtype(np.int64))
    if kind == "MultiBinary":
        return _array(np.dtype(np.int8))
    if kind == "Discrete":
        return int
    if kind == "Text":
        return str
    if kind == "Dict":
        return _dict({key: compile_observation(part) for key, part in schema["spaces"].items()})
    if kind == "Tuple":
        return _tuple([compile_observation(part) for part in schema["spaces"]])
    raise TypeError(f"no observations for a space of type {kind!r}")


def _array(dtype: np.dtype[Any]) -> Converter:
    array = np.array

    def convert(raw: Any) -> Any:
        # A transposed picture keeps its layout unless told otherwise, and would be sent with its axes mixed.
        return array(raw, dtype=dtype, order="C")

    return convert


def _dict(converters: dict[str, Converter]) -> Converter:
    items = tuple(converters.items())

    def convert(raw: Any) -> Any:
        return {key: part(raw[key]) for key, part in items}

    return convert


def _tuple(converters: list[Converter]) -> Converter:
    def convert(raw: Any) -> Any:
        return tuple(part(value) for part, value in zip(converters, raw, strict=True))

    return convert
