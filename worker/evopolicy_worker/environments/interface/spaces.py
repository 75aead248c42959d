"""Spaces as plain dicts: from a Gymnasium space to the schema that policies, `/info` and the codecs read.

Forms (as in the published protocol): `Discrete {n, start?}`, `Box {shape, dtype, low, high}`, `Image {shape, dtype,
layout, value_range, storage}`, `MultiDiscrete {nvec, start?, dtype?}` (`dtype`: that of actions, unless int64),
`MultiBinary {n}`, `Tuple {spaces}`, `Dict {spaces}`, `Text {min_length, max_length, characters?}`, and beyond it
`Sequence {space, stacked}`, `Graph {node_space, edge_space}`, `OneOf {spaces}`. Infinities are `"inf"` and `"-inf"`.
`low` and `high` are nested lists, or one number for all values where a Box has more than 32 and they are equal. A
schema is JSON and msgpack by construction.
"""

from __future__ import annotations

import itertools
import math
import string
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.messages.environment import ObsStorage, SpaceSchema
from evopolicy_common.records.episodes.rendered import MIN_PICTURE_SIDE, is_picture

if TYPE_CHECKING:
    import gymnasium

MAX_LISTED_BOUNDS = 32
"""A Box with more values than this states a bound that all of them share as one number."""
MAX_INLINE_BYTES = 4096
"""Observations of more bytes a step are stored outside the rows, as the published protocol does."""
VARYING = ("Sequence", "Graph", "OneOf")
"""Spaces whose values differ in form."""
USUAL_CHARACTERS = string.ascii_letters + string.digits
"""Gymnasium's default, of which Text is made unless it tells `characters`."""


def to_schema(space: gymnasium.Space[Any]) -> SpaceSchema:
    """`space` as a plain dict. TypeError for a kind of space that the protocol has no form for, ValueError for
    bounds that leave no value."""
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n)} | ({"start": int(space.start)} if space.start else {})
    if isinstance(space, spaces.Box):
        return _box(space.shape, space.dtype, space.low, space.high)
    if isinstance(space, spaces.MultiDiscrete):
        schema: SpaceSchema = {"type": "MultiDiscrete", "nvec": space.nvec.tolist()}
        if np.any(space.start):
            schema["start"] = space.start.tolist()
        return schema if space.dtype == np.int64 else {**schema, "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": np.asarray(space.n).tolist()}
    if isinstance(space, spaces.Tuple | spaces.OneOf):
        kind = "Tuple" if isinstance(space, spaces.Tuple) else "OneOf"
        return {"type": kind, "spaces": [to_schema(part) for part in space.spaces]}
    if isinstance(space, spaces.Dict):
        for key in space.spaces:
            if not isinstance(key, str):
                raise TypeError(f"key {key!r:.80} of a Dict has no form here; its keys have to be texts")
        return {"type": "Dict", "spaces": {key: to_schema(part) for key, part in space.spaces.items()}}
    if isinstance(space, spaces.Text):
        schema = {"type": "Text", "min_length": int(space.min_length), "max_length": int(space.max_length)}
        if (characters := frozenset(space.characters)) != frozenset(USUAL_CHARACTERS):
            schema["characters"] = "".join(sorted(characters))
        return schema
    if isinstance(space, spaces.Sequence):
        inner = to_schema(space.feature_space)
        if space.stack and inner["type"] in ("Dict", "Tuple"):
            raise TypeError(
                f"a stacked Sequence of {inner['type']} has no form here; give it without stack=True, or stack within"
                f" the {inner['type']}"
            )
        stacked = bool(space.stack) and inner["type"] in ("Box", "Image")
        return {"type": "Sequence", "space": inner, "stacked": stacked}
    if isinstance(space, spaces.Graph):
        edges = None if space.edge_space is None else to_schema(space.edge_space)
        return {"type": "Graph", "node_space": to_schema(space.node_space), "edge_space": edges}
    if hasattr(space, "mission_func"):
        # MiniGrid's sentence of a fixed pattern: as short and as long as its placeholders make it.
        mission: Any = space
        choices = mission.ordered_placeholders or []
        lengths = [len(mission.mission_func(*words)) for words in itertools.product(*choices)]
        return {"type": "Text", "min_length": min(lengths), "max_length": max(lengths)}
    raise TypeError(
        f"a space of type {type(space).__name__} ({str(space)[:200]}) has no form here: known are Box, Discrete,"
        " MultiDiscrete, MultiBinary, Text, Dict, Tuple, Sequence, Graph and OneOf; put a wrapper around the"
        " environment that encodes it"
    )


def obs_storage(schema: SpaceSchema) -> ObsStorage:
    """Storage of observations of this space in feedback: in the rows, or beside them if they are large or contain an
    image."""
    if varies(schema) or not (_has_image(schema) or _bytes(schema) > MAX_INLINE_BYTES):
        return "inline"
    return "npz"


def varies(schema: SpaceSchema) -> bool:
    """Whether the values of a space differ in form: how many there are, or of which kind."""
    return schema["type"] in VARYING or any(map(varies, parts(schema)))


def parts(schema: SpaceSchema) -> list[SpaceSchema]:
    """The spaces that a Dict or Tuple is made of, in order; of any other, none."""
    inner = schema.get("spaces", ())
    return list(inner.values()) if isinstance(inner, dict) else list(inner)


def array_of(schema: SpaceSchema) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype of a value of a space without parts, as an array; () and int64 for Discrete."""
    if schema["type"] in ("Box", "Image"):
        return tuple(schema["shape"]), np.dtype(schema["dtype"])
    if schema["type"] == "MultiBinary":
        return tuple(np.atleast_1d(schema["n"]).tolist()), np.dtype(np.int8)
    return np.shape(schema.get("nvec", 0)), np.dtype(np.int64)


def bounds(schema: SpaceSchema) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest value of every element of a Box or Image, float64 arrays of its shape.

    The schemas that agents get have `min` and `max` in place of `low` and `high` where these would be long.
    """
    shape = tuple(schema["shape"])
    if schema["type"] == "Image":
        low, high = schema["value_range"]
    else:
        low, high = (schema[name] for name in (("low", "high") if "low" in schema else ("min", "max")))
    return _filled(low, shape), _filled(high, shape)


Checker = Callable[[Any], str]
"""How a plain observation is not in its space, in words; empty where it is in it."""


def compile_checker(schema: SpaceSchema) -> Checker:
    kind = schema["type"]
    if kind in ("Dict", "Tuple"):
        keys = schema["spaces"] if kind == "Dict" else range(len(schema["spaces"]))
        inner = list(zip(keys, map(compile_checker, parts(schema)), strict=True))
        return lambda value: next(
            (f"[{key!r}] {why}" for key, check in inner if (why := check(value[key]))), ""
        )
    if kind == "Discrete":
        low, end = schema.get("start", 0), schema.get("start", 0) + schema["n"]
        return lambda value: "" if low <= value < end else f"it is {value}, not {low} to {end - 1}"
    if kind == "Text":
        return _text_checker(schema)
    if kind == "Sequence":
        item = compile_checker(schema["space"])
        return lambda value: next((f"[{k}] {why}" for k, each in enumerate(value) if (why := item(each))), "")
    if kind == "OneOf":
        choices = list(map(compile_checker, schema["spaces"]))
        return lambda value: (
            choices[value[0]](value[1])
            if 0 <= value[0] < len(choices)
            else f"choice {value[0]}, not 0 to {len(choices) - 1}"
        )
    return _array_checker(schema) if kind != "Graph" else lambda value: ""


def _text_checker(schema: SpaceSchema) -> Checker:
    low, high = schema["min_length"], schema["max_length"]
    allowed = frozenset(schema["characters"]) if "characters" in schema else None

    def check(value: str) -> str:
        if not low <= len(value) <= high:
            return f"a text of {len(value)} characters, not {low} to {high}"
        strange = "" if allowed is None else next((each for each in value if each not in allowed), "")
        return f"a text with {strange!r}, which is not one of its characters" if strange else ""

    return check


def _array_checker(schema: SpaceSchema) -> Checker:
    kind = schema["type"]
    if kind in ("Box", "Image"):
        low, high = bounds(schema)
    else:
        low = np.broadcast_to(schema.get("start", 0), array_of(schema)[0])
        high = low + np.array(schema.get("nvec", 2)) - 1
    whole_byte = schema.get("dtype") == "uint8" and not low.any() and bool((high == 255).all())

    def check(value: NDArray[Any]) -> str:
        if value.shape != low.shape:
            return f"an array of shape {value.shape}, not {low.shape}"
        if whole_byte:
            return ""
        inside = (value >= low) & (value <= high)  # false for NaN too
        if inside.all():
            return ""
        where = tuple(int(k) for k in np.argwhere(~inside)[0])
        return f"element {where} is {value[where]}, not {low[where]} to {high[where]}"

    return check


def _has_image(schema: SpaceSchema) -> bool:
    if schema["type"] in ("Box", "Image"):
        return schema["type"] == "Image" or is_picture(tuple(schema["shape"]), schema["dtype"])
    return any(_has_image(part) for part in parts(schema))


def _bytes(schema: SpaceSchema) -> int:
    """Size of the arrays of one observation, bytes."""
    if schema["type"] in ("Box", "Image", "MultiDiscrete", "MultiBinary"):
        shape, dtype = array_of(schema)
        return math.prod(shape) * dtype.itemsize
    return sum(map(_bytes, parts(schema)))


def _box(shape: tuple[int, ...], dtype: Any, low: NDArray[Any], high: NDArray[Any]) -> SpaceSchema:
    name = np.dtype(dtype).name
    if not (low <= high).all():  # of NaN neither is true
        where = tuple(int(k) for k in np.argwhere(~(low <= high))[0])
        raise ValueError(
            f"element {where} goes from {low[where]} to {high[where]}; correct the bounds of the Box"
        )
    if name == "uint8" and len(shape) == 3 and min(shape[:2]) >= MIN_PICTURE_SIDE and shape[2] in (1, 3):
        return {
            "type": "Image",
            "shape": list(shape),
            "dtype": name,
            "layout": "height_width_channels",
            "value_range": [0, 255],
            "storage": "external",
        }
    return {"type": "Box", "shape": list(shape), "dtype": name, "low": _bound(low), "high": _bound(high)}


def _bound(values: NDArray[Any]) -> Any:
    shared = values.size > MAX_LISTED_BOUNDS and bool((values == values.flat[0]).all())
    return _plain(values.flat[0].item() if shared else values.tolist())


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return value + 0  # no negative zero


def _filled(value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """The numbers of a schema, one for all or nested lists, with "inf" among them."""
    if 0 in shape:  # of which nested lists do not tell all lengths
        return np.zeros(shape)
    return np.array(np.broadcast_to(np.array(value, dtype=np.float64), shape))


def as_text(value: object) -> str:
    """The value as text. Half a surrogate pair, as undecoded bytes give, becomes U+FFFD: no file can hold it."""
    text = str(value)
    return text if text.isascii() else text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


Converter = Callable[[Any], Any]


def compile_observation(schema: SpaceSchema) -> Converter:
    """A function from the simulator's observation to the plain one of this space. TypeError for an unknown space.
    It is compiled once because it runs on every step.

    The result holds numpy arrays that are fresh, C-contiguous and of exactly the dtype of the space; ints for Discrete;
    strings for Text; dicts in the order of the schema; tuples, of any length for Sequence (one array where it is
    stacked); an index and a value for OneOf; for Graph a dict of `nodes`, `edges` and `edge_links`, the last two None
    where there are none.
    """
    kind = schema["type"]
    if kind in ("Box", "Image", "MultiDiscrete", "MultiBinary"):
        array, dtype = np.array, array_of(schema)[1]
        # A transposed image keeps its layout by default, and would be sent with swapped axes.
        return lambda raw: array(raw, dtype=dtype, order="C")
    if kind in ("Discrete", "Text"):
        return int if kind == "Discrete" else as_text
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
        choices = dict(enumerate(inner))  # a list has negative places too
        return lambda raw: (int(raw[0]), choices[int(raw[0])](raw[1]))
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
