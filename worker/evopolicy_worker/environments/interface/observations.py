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
from evopolicy_worker.environments.interface.spaces import array_of, parts

Converter = Callable[[Any], Any]


def compile_observation(schema: SpaceSchema) -> Converter:
    """A function from the simulator's observation to the plain one of this space. TypeError for an unknown space."""
    kind = schema["type"]
    if kind in ("Box", "Image", "MultiDiscrete", "MultiBinary"):
        array, dtype = np.array, array_of(schema)[1]
        # A transposed image keeps its layout by default, and would be sent with swapped axes.
        return lambda raw: array(raw, dtype=dtype, order="C")
    if kind in ("Discrete", "Text"):
        return int if kind == "Discrete" else str
    if kind == "Sequence":
        if schema["stacked"]:
            return _rows(schema["space"])
        item = compile_observation(schema["space"])
        return lambda raw: tuple(map(item, raw))
    if kind == "Graph":
        return _graph(schema)
    inner = list(map(compile_observation, parts(schema)))
    if kind == "Dict":
        items = tuple(zip(schema["spaces"], inner, strict=True))
        return lambda raw: {key: part(raw[key]) for key, part in items}
    if kind == "Tuple":
        return lambda raw: tuple(part(value) for part, value in zip(inner, raw, strict=True))
    if kind == "OneOf":
        return lambda raw: (int(raw[0]), inner[int(raw[0])](raw[1]))
    raise TypeError(f"no observations for a space of type {kind!r}")


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
