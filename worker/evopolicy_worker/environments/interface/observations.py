"""From what a simulator returns to a plain observation, compiled once per space because it runs on every step.

The result holds numpy arrays that are fresh, C-contiguous and of exactly the dtype of the space; ints for Discrete;
strings for Text; dicts in the order of the schema; tuples, of any length for Sequence (one array where it is stacked);
an index and a value for OneOf; for Graph a dict of `nodes`, `edges` and `edge_links`, the last two None where there are
none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments.interface.spaces import array_of

Converter = Callable[[Any], Any]


def compile_observation(schema: SpaceSchema) -> Converter:
    """A function from the simulator's observation to the plain one of this space. TypeError for an unknown space."""
    kind = schema["type"]
    if kind in ("Box", "Image", "MultiDiscrete", "MultiBinary"):
        return _array(array_of(schema)[1])
    if kind == "Discrete":
        return int
    if kind == "Text":
        return str
    if kind == "Dict":
        return _dict({key: compile_observation(part) for key, part in schema["spaces"].items()})
    if kind == "Tuple":
        return _tuple([compile_observation(part) for part in schema["spaces"]])
    if kind == "Sequence":
        return _sequence(schema)
    if kind == "Graph":
        return _graph(schema)
    if kind == "OneOf":
        return _one_of([compile_observation(part) for part in schema["spaces"]])
    raise TypeError(f"no observations for a space of type {kind!r}")


def _array(dtype: np.dtype[Any]) -> Converter:
    array = np.array

    def convert(raw: Any) -> Any:
        # A transposed image keeps its layout by default, and would be sent with swapped axes.
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


def _sequence(schema: SpaceSchema) -> Converter:
    if schema["stacked"]:
        return _rows(schema["space"])
    convert = compile_observation(schema["space"])

    def each(raw: Any) -> Any:
        return tuple(map(convert, raw))

    return each


def _rows(schema: SpaceSchema) -> Converter:
    """Any number of values of a space as one array."""
    shape, dtype = array_of(schema)
    return lambda raw: np.array(raw, dtype=dtype, order="C").reshape(-1, *shape)


def _graph(schema: SpaceSchema) -> Converter:
    nodes, edges = _rows(schema["node_space"]), _rows(schema["edge_space"] or {"type": "Discrete"})
    links = _rows({"type": "MultiDiscrete", "nvec": [0, 0]})

    def convert(raw: Any) -> Any:
        bare = raw.edges is None or raw.edge_links is None
        return {
            "nodes": nodes(raw.nodes),
            "edges": None if bare else edges(raw.edges),
            "edge_links": None if bare else links(raw.edge_links),
        }

    return convert


def _one_of(converters: list[Converter]) -> Converter:
    def convert(raw: Any) -> Any:
        index = int(raw[0])
        return index, converters[index](raw[1])

    return convert
