"""Whether what a policy returned is an action, and the repair when it is not; also the uniform random action.

Works from the schema of the action space alone, compiled once: `repair` runs on every step. Its rules:
- Any reasonable form of a valid action is taken as it is meant and is not marked: Python and numpy numbers, 0-d arrays,
  lists, tuples, arrays of any number type; axes of length one more or fewer; a bool counts as 0 or 1; a float without
  fraction counts as an integer; a Box action is cast to the dtype of the space, and may stick out of its bounds by the
  rounding of a float32.
- A Sequence is any list, an action of OneOf a pair of index and value, a Graph a dict of `nodes`, `edges` and
  `edge_links`.
- Everything else is marked `invalid` and repaired: a number out of bounds is clipped; a wrong shape is broadcast where
  that is possible; NaN becomes the neutral value of its element; a missing part of a Dict or Tuple, the neutral value
  of that part; and anything that is no number at all (None, strings, ragged lists, objects) the neutral value of the
  space.
- The neutral value of a Box is zero, or the bound nearest to it; that of the discrete spaces is the lowest one.
- In the published profiles, actions are read as the published software reads them: a choice is the integer part of a
  number, or of a text that is an integer, and a list or array of one is none; texts that are numbers count in a Box.
- What is returned is fresh, of exactly the dtype and shape of the space, and finite.
"""

from __future__ import annotations

import contextlib
import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments.interface.spaces import USUAL_CHARACTERS, bounds

_FAST_ELEMENTS = 32
"""Up to this many elements a loop over Python floats is faster than numpy's comparisons."""
_MAX_UNWRAP = 8
MAX_ITEMS = 256
"""Of an action that is a Sequence or a Graph; what is beyond is cut off."""


class ActionCodec(ABC):
    @abstractmethod
    def repair(self, raw: object) -> tuple[Any, bool]:
        """A valid action for what the policy returned, and whether that changed its meaning. Never raises."""

    @abstractmethod
    def sample(self, rng: np.random.Generator) -> Any:
        """A random action, distributed as Gymnasium's `space.sample()`, and of the same bits for the leaf spaces.

        Bounded elements are uniform; unbounded ones normal; those with one bound shifted exponential.
        """

    def neutral(self) -> Any:
        """The replacement for an action that cannot be read."""
        return self.repair(None)[0]


def compile_actions(schema: SpaceSchema, *, published: bool = False) -> ActionCodec:
    """The codec of an action space. `published`: reads actions as the published software does. TypeError for an unknown
    kind of space."""
    codec = (_CODECS | _PUBLISHED if published else _CODECS).get(schema["type"])
    if codec is None:
        raise TypeError(f"no actions for a space of type {schema['type']!r}")
    return codec(schema)


class _Discrete(ActionCodec):
    def __init__(self, schema: SpaceSchema) -> None:
        self._n: int = schema["n"]
        self._low: int = schema.get("start", 0)
        self._high = self._low + self._n - 1

    def repair(self, raw: object) -> tuple[int, bool]:
        value = raw if type(raw) is int else _integer(raw)
        if value is None:
            return self._low, True
        kept = min(max(value, self._low), self._high)
        return kept, kept != value

    def sample(self, rng: np.random.Generator) -> int:
        return self._low + int(rng.integers(self._n))


class _PublishedDiscrete(_Discrete):
    def repair(self, raw: object) -> tuple[int, bool]:
        if isinstance(raw, np.ndarray | np.generic):
            raw = raw.tolist()
        try:
            return super().repair(int(raw)) if isinstance(raw, int | float | str) else (self._low, True)
        except (ValueError, OverflowError):
            return self._low, True


class _Box(ActionCodec):
    def __init__(self, schema: SpaceSchema) -> None:
        self._dtype = np.dtype(schema["dtype"])
        self._shape = tuple(schema["shape"])
        self._low, self._high = bounds(schema)
        self._is_float = self._dtype.kind == "f"
        self._uniform = self._is_float and bool(np.isfinite((self._low, self._high)).all())
        whole = np.uint8 if self._dtype.kind == "b" else self._dtype
        limits: Any = np.finfo(self._dtype) if self._is_float else np.iinfo(whole)
        # An infinite element becomes the largest finite one: simulators do not survive infinities.
        self._clip_low = np.maximum(self._low, _inside(limits.min))
        self._clip_high = np.minimum(self._high, _inside(limits.max))
        self._rounded_low = self._clip_low - _float32_spacing(self._clip_low)
        self._rounded_high = self._clip_high + _float32_spacing(self._clip_high)
        self._neutral: NDArray[np.float64] = np.clip(np.zeros(self._shape), self._low, self._high)
        self._limits = list(
            zip(self._clip_low.ravel().tolist(), self._clip_high.ravel().tolist(), strict=True)
        )
        self._fast = self._is_float and len(self._shape) == 1 and len(self._limits) <= _FAST_ELEMENTS

    def repair(self, raw: object) -> tuple[NDArray[Any], bool]:
        if self._fast:
            # Nearly every action of nearly every policy: right shape, within bounds.
            if type(raw) is np.ndarray and raw.dtype.kind == "f" and raw.shape == self._shape:
                for value, (low, high) in zip(raw.tolist(), self._limits, strict=True):
                    if not low <= value <= high:
                        break
                else:
                    return raw.astype(self._dtype), False
            elif type(raw) is list and len(raw) == len(self._limits):
                for value, (low, high) in zip(raw, self._limits, strict=True):
                    if type(value) is not float or not low <= value <= high:
                        break
                else:
                    return np.array(raw, dtype=self._dtype), False
        with np.errstate(all="ignore"):
            return self._repair_any(raw)

    def _repair_any(self, raw: object) -> tuple[NDArray[Any], bool]:
        shaped, invalid = _shaped(self._read(raw), self._shape)
        if shaped is None:
            return self._cast(self._neutral), True
        values = shaped.astype(np.float64)
        lost = np.isnan(values)
        if lost.any():
            values = np.where(lost, self._neutral, values)
            invalid = True
        if bool((values < self._rounded_low).any() or (values > self._rounded_high).any()):
            invalid = True
        if not self._is_float:
            whole = np.trunc(values)
            invalid = invalid or bool((whole != values).any())
            values = whole
        return self._cast(np.minimum(np.maximum(values, self._clip_low), self._clip_high)), invalid

    def sample(self, rng: np.random.Generator) -> NDArray[Any]:
        low, high = self._low, self._high if self._is_float else self._high + 1
        if self._uniform:
            return self._cast(rng.uniform(low, high))
        below, above = np.isfinite(low), np.isfinite(high)
        values = np.empty(self._shape)
        # Gymnasium's order of drawing, so that the same generator gives the same action.
        free, only_high, only_low, both = ~below & ~above, ~below & above, below & ~above, below & above
        values[free] = rng.normal(size=int(free.sum()))
        values[only_low] = rng.exponential(size=int(only_low.sum())) + low[only_low]
        values[only_high] = -rng.exponential(size=int(only_high.sum())) + high[only_high]
        values[both] = rng.uniform(low=low[both], high=high[both], size=int(both.sum()))
        if not self._is_float:
            values = np.minimum(np.maximum(np.floor(values), self._clip_low), self._clip_high)
        return self._cast(values)

    def _read(self, raw: object) -> NDArray[Any] | None:
        return _numbers(raw)

    def _cast(self, values: Any) -> NDArray[Any]:
        """A fresh array of the space's dtype; numpy makes scalars of arrays without axes."""
        return np.asarray(values).astype(self._dtype)


class _PublishedBox(_Box):
    def _read(self, raw: object) -> NDArray[Any] | None:
        found = _numbers(raw)
        if found is None and isinstance(raw, str | list | tuple | np.ndarray):
            with contextlib.suppress(ValueError, TypeError, OverflowError, RecursionError):
                return np.asarray(raw, dtype=np.float64)
        return found


class _MultiDiscrete(ActionCodec):
    def __init__(self, schema: SpaceSchema) -> None:
        self._dtype = np.dtype(schema.get("dtype", "int64"))
        self._n = np.array(schema["nvec"], dtype=np.int64)
        self._low = np.broadcast_to(np.array(schema.get("start", 0), dtype=np.int64), self._n.shape)
        self._high = self._low + self._n - 1

    def repair(self, raw: object) -> tuple[NDArray[Any], bool]:
        shaped, invalid = _shaped(_numbers(raw), self._n.shape)
        if shaped is None:
            return self._low.astype(self._dtype), True
        if shaped.dtype.kind == "f":
            with np.errstate(all="ignore"):
                whole = shaped == np.trunc(shaped)  # False for NaN, True for infinities, which are clipped
            invalid = invalid or not bool(whole.all())
            shaped = np.where(whole, shaped, self._low)
        clipped = np.minimum(np.maximum(shaped, self._low), self._high)
        return clipped.astype(self._dtype), invalid or bool((clipped != shaped).any())

    def sample(self, rng: np.random.Generator) -> NDArray[Any]:
        drawn = (rng.random(self._n.shape) * self._n).astype(np.int64) + self._low
        return drawn.astype(self._dtype, copy=False)


class _MultiBinary(_MultiDiscrete):
    def __init__(self, schema: SpaceSchema) -> None:
        super().__init__({"nvec": np.full(schema["n"], 2), "dtype": "int8"})

    def sample(self, rng: np.random.Generator) -> NDArray[np.int8]:
        return rng.integers(low=0, high=2, size=self._n.shape, dtype=np.int8)


class _Text(ActionCodec):
    """Made of the schema's `characters`; without them of any, and random ones are of Gymnasium's usual set."""

    def __init__(self, schema: SpaceSchema) -> None:
        self._min, self._max = schema["min_length"], schema["max_length"]
        self._allowed = frozenset(schema["characters"]) if "characters" in schema else None
        self._characters = schema.get("characters") or USUAL_CHARACTERS

    def repair(self, raw: object) -> tuple[str, bool]:
        text = raw if isinstance(raw, str) else ""
        kept = text if self._allowed is None else "".join(each for each in text if each in self._allowed)
        invalid = text is not raw or len(kept) != len(text) or not self._min <= len(kept) <= self._max
        return kept[: self._max].ljust(self._min, self._characters[0]), invalid

    def sample(self, rng: np.random.Generator) -> str:
        length = int(rng.integers(self._min, self._max + 1))
        return "".join(self._characters[k] for k in rng.integers(len(self._characters), size=length).tolist())


class _Dict(ActionCodec):
    def __init__(self, schema: SpaceSchema) -> None:
        self._parts = {key: compile_actions(part) for key, part in schema["spaces"].items()}

    def repair(self, raw: object) -> tuple[Any, bool]:
        given: dict[Any, Any] = raw if isinstance(raw, dict) else {}
        invalid = given is not raw or given.keys() != self._parts.keys()
        action = {}
        for key, part in self._parts.items():
            action[key], changed = part.repair(given.get(key))
            invalid = invalid or changed
        return action, invalid

    def sample(self, rng: np.random.Generator) -> Any:
        return {key: part.sample(rng) for key, part in self._parts.items()}


class _Tuple(_Dict):
    def __init__(self, schema: SpaceSchema) -> None:
        super().__init__({"spaces": dict(enumerate(schema["spaces"]))})

    def repair(self, raw: object) -> tuple[Any, bool]:
        listed = _listed(raw)
        action, invalid = super().repair(
            None if listed is None else dict(enumerate(listed[: len(self._parts) + 1]))
        )
        return tuple(action.values()), invalid

    def sample(self, rng: np.random.Generator) -> Any:
        return tuple(super().sample(rng).values())


class _Sequence(ActionCodec):
    """Items of one space, at most `MAX_ITEMS`; as an array where the space stacks them."""

    def __init__(self, schema: SpaceSchema) -> None:
        self.item = compile_actions(schema["space"])
        self._stacked = schema["stacked"]

    def repair(self, raw: object) -> tuple[Any, bool]:
        listed = _listed(raw)
        invalid = listed is None or len(listed) > MAX_ITEMS
        items = []
        for value in () if listed is None else listed[:MAX_ITEMS]:
            repaired, changed = self.item.repair(value)
            items.append(repaired)
            invalid = invalid or changed
        return self._made(items), invalid

    def sample(self, rng: np.random.Generator) -> Any:
        # As many as Gymnasium draws.
        return self.drawn(rng, min(int(rng.geometric(0.25)), MAX_ITEMS))

    def drawn(self, rng: np.random.Generator, n: int) -> Any:
        return self._made([self.item.sample(rng) for _ in range(n)])

    def _made(self, items: list[Any]) -> Any:
        if not self._stacked:
            return tuple(items)
        one = np.asarray(self.item.neutral())
        return np.array(items, dtype=one.dtype).reshape(-1, *one.shape)


class _OneOf(ActionCodec):
    """A pair: which of the spaces, and a value of it."""

    def __init__(self, schema: SpaceSchema) -> None:
        self._choices = list(map(compile_actions, schema["spaces"]))

    def repair(self, raw: object) -> tuple[tuple[int, Any], bool]:
        index = _integer(raw[0]) if isinstance(raw, list | tuple) and len(raw) == 2 else None
        if index is None or not 0 <= index < len(self._choices):
            return (0, self._choices[0].neutral()), True
        assert isinstance(raw, list | tuple)
        value, changed = self._choices[index].repair(raw[1])
        return (index, value), changed

    def sample(self, rng: np.random.Generator) -> tuple[int, Any]:
        index = int(rng.integers(len(self._choices)))
        return index, self._choices[index].sample(rng)


class _Graph(ActionCodec):
    """Nodes, and edges between them where the space has any: Gymnasium's `GraphInstance` from a dict of its three
    fields."""

    def __init__(self, schema: SpaceSchema) -> None:
        self._nodes = _Sequence({"space": schema["node_space"], "stacked": True})
        edge = schema["edge_space"]
        self._edges = None if edge is None else _Sequence({"space": edge, "stacked": True})

    def repair(self, raw: object) -> tuple[Any, bool]:
        if isinstance(raw, list | tuple) and len(raw) == 3:  # as a recording has it
            raw = dict(zip(("nodes", "edges", "edge_links"), raw, strict=True))
        given: dict[str, Any] = raw if isinstance(raw, dict) else {}
        nodes, invalid = self._nodes.repair(given.get("nodes"))
        if not len(nodes):
            return self._made(self._nodes.repair([self._nodes.item.neutral()])[0]), True
        edges, links = given.get("edges"), given.get("edge_links")
        numbers = None if links is None else _numbers(links)
        if self._edges is None or edges is None or numbers is None:
            return self._made(nodes), invalid or edges is not None or links is not None
        edges, changed = self._edges.repair(edges)
        fits = numbers.shape == (len(edges), 2) and numbers.dtype.kind in "iu"
        if not fits or not ((numbers >= 0) & (numbers < len(nodes))).all():
            return self._made(nodes), True
        return self._made(nodes, edges, numbers.astype(np.int32)), invalid or changed

    def sample(self, rng: np.random.Generator) -> Any:
        nodes = self._nodes.drawn(rng, 1 + int(rng.integers(10)))
        n = int(rng.integers(len(nodes) + 1)) if self._edges is not None else 0
        if self._edges is None or not n:
            return self._made(nodes)
        edges = self._edges.drawn(rng, n)
        return self._made(nodes, edges, rng.integers(len(nodes), size=(n, 2)).astype(np.int32))

    @staticmethod
    def _made(nodes: Any, edges: Any = None, links: Any = None) -> Any:
        from gymnasium.spaces import GraphInstance

        return GraphInstance(nodes, edges, links)


def copied(action: Any) -> Any:
    """The same valid action for the simulator alone: some change theirs in place, and what was sent is recorded."""
    return action.copy() if type(action) is np.ndarray else copy.deepcopy(action)


_CODECS: dict[str, Callable[[SpaceSchema], ActionCodec]] = {
    "Discrete": _Discrete,
    "Box": _Box,
    "Image": _Box,
    "MultiDiscrete": _MultiDiscrete,
    "MultiBinary": _MultiBinary,
    "Text": _Text,
    "Dict": _Dict,
    "Tuple": _Tuple,
    "Sequence": _Sequence,
    "OneOf": _OneOf,
    "Graph": _Graph,
}
_PUBLISHED: dict[str, Callable[[SpaceSchema], ActionCodec]] = {
    "Discrete": _PublishedDiscrete,
    "Box": _PublishedBox,
    "Image": _PublishedBox,
}
"""Those of the published profiles that differ."""


def _listed(raw: object) -> Any:
    """`raw` if it is a list, a tuple, or an array with axes; otherwise None."""
    return raw if isinstance(raw, list | tuple) or (isinstance(raw, np.ndarray) and raw.ndim) else None


def _integer(raw: object) -> int | None:
    """The integer that `raw` stands for; None when it stands for none."""
    for _ in range(_MAX_UNWRAP):
        if isinstance(raw, int | np.integer | np.bool_):  # bool is an int
            return int(raw)
        if isinstance(raw, float | np.floating):
            return int(raw) if np.isfinite(raw) and raw == np.trunc(raw) else None
        if isinstance(raw, np.ndarray):
            if raw.size != 1 or raw.dtype.kind not in "biuf":
                return None
            raw = raw.reshape(()).item()
        elif isinstance(raw, list | tuple) and len(raw) == 1:
            raw = raw[0]
        else:
            return None
    return None


def _numbers(raw: object) -> NDArray[Any] | None:
    """`raw` as an array of numbers; None when it is not made of numbers alone."""
    if not isinstance(raw, int | float | list | tuple | np.ndarray | np.number | np.bool_):
        return None
    try:
        array = np.asarray(raw)
    except (ValueError, TypeError, OverflowError, RecursionError):
        return None
    if array.dtype.kind == "b":
        return array.astype(np.int64)
    return array if array.dtype.kind in "iuf" else None


def _shaped(array: NDArray[Any] | None, shape: tuple[int, ...]) -> tuple[NDArray[Any] | None, bool]:
    """`array` in that shape and whether its meaning changed; None when it cannot be brought there."""
    if array is None or array.shape == shape:
        return array, False
    if [n for n in array.shape if n != 1] == [n for n in shape if n != 1]:
        return array.reshape(shape), False
    try:
        return np.broadcast_to(array, shape), True
    except ValueError:
        return None, True


def _inside(limit: Any) -> float:
    """`limit` of a dtype as a float that casts back: the upper ones of 64-bit integers round to beyond them."""
    near = float(limit)
    return near if near not in (2.0**63, 2.0**64) else float(np.nextafter(near, 0.0))


def _float32_spacing(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far a float32 near each value may be from it: bounds are often computed in single precision."""
    with np.errstate(all="ignore"):
        spacing = np.spacing(np.abs(values).astype(np.float32)).astype(np.float64)
    return np.where(np.isfinite(spacing), spacing, 0.0)
