"""Converts observations to feature vectors, and output vectors to actions, for any pair of spaces.

Features are a fixed function of the space alone, so that a weight means the same in every submit of a run. Outputs are
in units where 0 is the action nearest to zero and ±1 are the bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Schema = dict[str, Any]
Vector = NDArray[np.float64]

FEATURE_LIMIT = 10.0
"""Features are clipped to ± this value, so that one extreme component cannot dominate the others."""
IMAGE_CELLS = 4
"""A picture becomes this many by this many mean colours."""
MAX_ONE_HOT = 64
"""A Discrete space with more values than this becomes one number in [-1, 1]."""
GOALS = ("achieved_goal", "desired_goal")
MAX_CHOICES = 1024
"""An action of a Discrete space with more values than this is one output, on a scale on which low values have most
room."""


def bounds(schema: Schema) -> tuple[Vector, Vector]:
    """Lowest and highest value of every element of a Box, flat; infinite if unbounded."""
    size = math.prod(schema["shape"])
    low, high = (np.asarray(schema[end], dtype=float).reshape(-1) for end in ("low", "high"))
    return np.broadcast_to(low, size).copy(), np.broadcast_to(high, size).copy()


def goal_keys(schema: Schema) -> bool:
    """Whether the space follows the goal convention: a Dict with `observation`, `achieved_goal` and `desired_goal`."""
    return schema["type"] == "Dict" and set(schema["spaces"]) >= {"observation", *GOALS}


class Features:
    """Converts an observation to a float64 vector of `size` values, each of order one if the space is bounded."""

    def __init__(self, schema: Schema) -> None:
        self.size, self._convert = _features(schema)

    def vector(self, obs: Any) -> Vector:
        """Features of `obs`, float64 of shape (size,); NaN becomes 0."""
        return np.clip(np.nan_to_num(self._convert(obs)), -FEATURE_LIMIT, FEATURE_LIMIT)


def _features(schema: Schema) -> tuple[int, Callable[[Any], Vector]]:
    kind = schema["type"]
    if kind == "Box":
        low, high = bounds(schema)
        finite = np.isfinite(low) & np.isfinite(high) & (high > low)
        centre = np.where(finite, (np.where(finite, low, 0.0) + np.where(finite, high, 0.0)) / 2, 0.0)
        half = np.where(finite, (np.where(finite, high, 1.0) - np.where(finite, low, -1.0)) / 2, 1.0)
        return low.size, lambda obs: (np.asarray(obs, dtype=float).reshape(-1) - centre) / half
    if kind == "Image":
        height, width, channels = as_image(np.zeros(schema["shape"]), schema).shape
        n_cells = min(IMAGE_CELLS, height) * min(IMAGE_CELLS, width)
        return n_cells * channels, lambda obs: _cells(obs, schema)
    if kind == "Discrete":
        n, start = schema["n"], schema.get("start", 0)
        if n > MAX_ONE_HOT:
            return 1, lambda obs: np.array([2.0 * (int(obs) - start) / (n - 1) - 1.0])
        rows = np.eye(n)
        return n, lambda obs: rows[min(max(int(obs) - start, 0), n - 1)]
    if kind == "MultiDiscrete":
        # `nvec` may itself be an array of several dimensions.
        top = np.maximum(np.asarray(schema["nvec"], dtype=float).reshape(-1) - 1, 1.0)
        first = np.broadcast_to(np.asarray(schema.get("start", 0), dtype=float).reshape(-1), top.shape)
        return top.size, lambda obs: 2.0 * (np.asarray(obs, dtype=float).reshape(-1) - first) / top - 1.0
    if kind == "MultiBinary":
        size = int(np.prod(schema["n"]))
        return size, lambda obs: 2.0 * np.asarray(obs, dtype=float).reshape(-1) - 1.0
    if kind in ("Text", "Sequence", "Graph", "OneOf"):
        return 0, lambda obs: np.zeros(0)
    goal = goal_keys(schema)
    items = [(key, part) for key, part in _items(schema) if not (goal and key in GOALS)]
    parts = [(key, *_features(part)) for key, part in items]
    used = [(key, convert) for key, size, convert in parts if size]
    n_goal = math.prod(schema["spaces"]["desired_goal"]["shape"]) if goal else 0

    def join(obs: Any) -> Vector:
        missing = goal_error(obs) if goal else np.zeros(0)
        return np.concatenate([missing, *(convert(obs[key]) for key, convert in used)])

    return n_goal + sum(size for _, size, _ in parts), join


def _items(schema: Schema) -> list[tuple[Any, Schema]]:
    """The parts of a Dict or Tuple."""
    return list(schema["spaces"].items() if schema["type"] == "Dict" else enumerate(schema["spaces"]))


def goal_error(obs: Any) -> Vector:
    """Difference to the goal: desired minus achieved goal, flat."""
    achieved, desired = (np.asarray(obs[key], dtype=float).reshape(-1) for key in GOALS)
    missing: Vector = desired - achieved
    return missing


def _cells(obs: Any, schema: Schema) -> Vector:
    """The mean colours of a picture's cells."""
    image = as_image(obs, schema)
    rows = np.array_split(image, min(IMAGE_CELLS, image.shape[0]), axis=0)
    cells = [c for row in rows for c in np.array_split(row, min(IMAGE_CELLS, image.shape[1]), axis=1)]
    return np.concatenate([cell.mean(axis=(0, 1)) for cell in cells])


def as_image(obs: Any, schema: Schema) -> NDArray[np.float64]:
    """A picture as float64 of shape (height, width, channels), values in [-1, 1]."""
    image = np.asarray(obs, dtype=float)
    if image.ndim == 2:
        image = image[:, :, None]
    elif schema.get("layout") == "CHW":
        image = np.moveaxis(image, 0, -1)
    low, high = schema.get("value_range", (0, 255))
    scaled: NDArray[np.float64] = 2.0 * (image - low) / (high - low) - 1.0
    return scaled


class ActionHead:
    """Converts `size` outputs to an action of the space."""

    def __init__(self, schema: Schema) -> None:
        self.size, self._convert = _head(schema)

    def action(self, outputs: Vector) -> Any:
        """The action for `outputs`, float64 of shape (size,)."""
        return self._convert(outputs)


def _head(schema: Schema) -> tuple[int, Callable[[Vector], Any]]:
    kind = schema["type"]
    if kind == "Box":
        low, high = bounds(schema)
        neutral = np.clip(0.0, low, high)
        up = np.where(np.isfinite(high), high - neutral, 1.0)
        down = np.where(np.isfinite(low), neutral - low, 1.0)
        dtype = np.dtype(schema["dtype"])

        def scale(outputs: Vector) -> Any:
            bounded = np.clip(outputs, -1.0, 1.0)
            values = neutral + np.where(bounded > 0, bounded * up, bounded * down)
            values = np.rint(values) if dtype.kind in "iu" else values
            return np.clip(values, low, high).astype(dtype).reshape(schema["shape"])

        return low.size, scale
    if kind == "Discrete":
        n, start = schema["n"], schema.get("start", 0)
        if n > MAX_CHOICES:
            return 1, lambda outputs: int(n ** ((1.0 + np.clip(outputs[0], -1.0, 1.0)) / 2)) - 1 + start
        return n, lambda outputs: int(np.argmax(outputs)) + start
    if kind == "MultiDiscrete":
        shape = np.shape(schema["nvec"])
        counts = [int(n) for n in np.asarray(schema["nvec"]).reshape(-1)]
        first = np.broadcast_to(np.asarray(schema.get("start", 0)), shape)
        cuts = np.cumsum(counts)[:-1]

        def choose(outputs: Vector) -> Any:
            best = [int(np.argmax(part)) for part in np.split(outputs, cuts)]
            return np.array(best, dtype=np.int64).reshape(shape) + first

        return sum(counts), choose
    if kind == "MultiBinary":
        shape = tuple(np.atleast_1d(schema["n"]))
        return int(np.prod(shape)), lambda outputs: (outputs > 0).astype(np.int8).reshape(shape)
    if kind == "Text":
        return 0, lambda outputs: schema.get("characters", "a")[0] * schema["min_length"]
    if kind == "Sequence":
        return 0, lambda outputs: []
    if kind == "Graph":
        size, node = _head(schema["node_space"])
        return size, lambda outputs: {"nodes": [node(outputs)], "edges": None, "edge_links": None}
    if kind == "OneOf":
        size, convert = _head(schema["spaces"][0])
        return size, lambda outputs: (0, convert(outputs))
    heads = [(key, *_head(part)) for key, part in _items(schema)]
    cuts = np.cumsum([size for _, size, _ in heads])[:-1]

    def compose(outputs: Vector) -> Any:
        pieces = np.split(outputs, cuts)
        made = [(key, convert(piece)) for (key, _, convert), piece in zip(heads, pieces, strict=True)]
        return dict(made) if kind == "Dict" else tuple(value for _, value in made)

    return sum(size for _, size, _ in heads), compose


class Given(NamedTuple):
    """The parts of a controller besides its vector."""

    head: ActionHead
    obs_space: Schema
    settings: dict[str, Any]
    """Identified from feedback."""
    rng: np.random.Generator
