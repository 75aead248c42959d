"""Gymnasium spaces as plain dicts, and plain observations of them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments.interface.spaces import bounds, compile_observation, obs_storage, to_schema

FLOATS: dict[str, Any] = {"type": "Box", "dtype": "float32"}
DOUBLES = FLOATS | {"dtype": "float64"}
IMAGE = {"type": "Image", "dtype": "uint8", "layout": "height_width_channels"}
IMAGE |= {"value_range": [0, 255], "storage": "external"}


def pixels(*shape: int) -> spaces.Space[Any]:
    return spaces.Box(0, 255, shape, np.uint8)


@pytest.mark.parametrize(
    ("space", "schema"),
    [
        (spaces.Discrete(3), {"type": "Discrete", "n": 3}),
        (spaces.Discrete(3, start=2), {"type": "Discrete", "n": 3, "start": 2}),
        (spaces.MultiDiscrete([[2, 3], [4, 5]]), {"type": "MultiDiscrete", "nvec": [[2, 3], [4, 5]]}),
        (
            spaces.MultiDiscrete([2, 3], start=[1, 0]),
            {"type": "MultiDiscrete", "nvec": [2, 3], "start": [1, 0]},
        ),
        (spaces.MultiBinary(4), {"type": "MultiBinary", "n": 4}),
        (spaces.MultiBinary([2, 2]), {"type": "MultiBinary", "n": [2, 2]}),
        (spaces.Text(7, min_length=2), {"type": "Text", "min_length": 2, "max_length": 7}),
        (spaces.Tuple([spaces.Discrete(2)]), {"type": "Tuple", "spaces": [{"type": "Discrete", "n": 2}]}),
        # Bounds are nested lists, with infinities spelled, and one number where more than 32 values share it.
        (
            spaces.Box(np.array([[-np.inf, -0.0]], "f"), np.array([[1.5, np.inf]], "f")),
            {**FLOATS, "shape": [1, 2], "low": [["-inf", 0.0]], "high": [[1.5, "inf"]]},
        ),
        (spaces.Box(-1, 1, (32,)), {**FLOATS, "shape": [32], "low": [-1.0] * 32, "high": [1.0] * 32}),
        (spaces.Box(-np.inf, 1, (33,)), {**FLOATS, "shape": [33], "low": "-inf", "high": 1.0}),
        (
            spaces.Box(np.arange(40.0) - 50, np.full(40, np.inf), dtype=np.float64),
            DOUBLES | {"shape": [40], "low": [k - 50.0 for k in range(40)], "high": "inf"},
        ),
        (pixels(7, 7, 3), {"type": "Box", "shape": [7, 7, 3], "dtype": "uint8", "low": 0, "high": 255}),
        *((pixels(*shape), {**IMAGE, "shape": list(shape)}) for shape in ((96, 96, 3), (16, 16, 1))),
    ],
)
def test_each_space_has_its_form(space: spaces.Space[Any], schema: SpaceSchema) -> None:
    # As JSON, in which 0 is not -0.0, nor 255 255.0.
    assert json.dumps(to_schema(space), sort_keys=True) == json.dumps(schema, sort_keys=True)


HALF = spaces.Box(-1, 1, (300,), np.float64)


@pytest.mark.parametrize(
    ("space", "kind", "storage"),
    [
        *((pixels(*shape), "Image", "npz") for shape in ((96, 96, 3), (16, 16, 1), (210, 160, 3))),
        *((pixels(*shape), "Box", "inline") for shape in ((7, 7, 3), (15, 15), (15, 80, 3))),
        (pixels(15, 96, 3), "Box", "npz"),
        # Pictures of other layouts, stacked or with other channels.
        *((pixels(*shape), "Box", "npz") for shape in ((16, 16), (84, 84), (3, 96, 96), (4, 20, 20))),
        *((pixels(*shape), "Box", "npz") for shape in ((20, 20, 4), (20, 20, 12), (2, 20, 20, 3))),
        (spaces.Box(0, 100, (20, 20), np.int8), "Box", "inline"),
        # Large ones of several parts.
        (spaces.Dict({"a": HALF}), "Dict", "inline"),
        (spaces.Tuple([HALF, HALF]), "Tuple", "npz"),
        (spaces.MultiDiscrete([2] * 513), "MultiDiscrete", "npz"),
        (spaces.MultiBinary(4096), "MultiBinary", "inline"),
        (spaces.Dict({"eye": pixels(64, 64, 3), "dir": spaces.Discrete(4)}), "Dict", "npz"),
    ],
)
def test_pictures_and_large_observations_are_stored_beside_the_rows(
    space: spaces.Space[Any], kind: str, storage: str
) -> None:
    schema = to_schema(space)
    assert (schema["type"], obs_storage(schema)) == (kind, storage)


def test_bounds_of_a_picture_are_those_of_its_bytes() -> None:
    low, high = bounds(to_schema(pixels(16, 16, 1)))
    assert (low.min(), high.max(), low.shape) == (0.0, 255.0, (16, 16, 1))


def test_bounds_of_a_schema_of_an_older_version_are_read() -> None:
    low, high = bounds({"type": "Box", "shape": [40], "dtype": "float64", "low": "-inf", "high": 1.0})
    assert (low.shape, low.max(), high.min()) == ((40,), -np.inf, 1.0)
    assert bounds(to_schema(spaces.Box(0, 1, (3, 0, 2))))[0].shape == (3, 0, 2)


class Quaternion(spaces.Space[Any]):
    pass


@pytest.mark.parametrize(
    ("space", "why"),
    [
        (Quaternion(), r"a space of type Quaternion .* put a wrapper around the environment"),
        *(
            (
                spaces.Sequence(inner, stack=True),
                r"a stacked Sequence of (Dict|Tuple) has no form here; give it",
            )
            for inner in (spaces.Dict({"a": spaces.Discrete(2)}), spaces.Tuple([spaces.Discrete(2)]))
        ),
        (
            spaces.Tuple([spaces.Dict({1: spaces.Discrete(2)})]),  # type: ignore[dict-item]
            "key 1 of a Dict has no form here; its keys have to be texts",
        ),
    ],
)
def test_a_space_without_a_form_is_refused(space: spaces.Space[Any], why: str) -> None:
    with pytest.raises(TypeError, match=why):
        to_schema(space)


def test_observations_become_plain_in_the_order_and_dtypes_of_the_space() -> None:
    parts = {"z": spaces.Box(-1, 1, (2,), np.float32), "a": spaces.Discrete(5), "m": spaces.Text(9)}
    parts["t"] = spaces.Tuple([spaces.MultiBinary(2), spaces.MultiDiscrete([3, 3])])
    convert = compile_observation(to_schema(spaces.Dict(parts)))
    raw: dict[str, Any] = {"t": (np.ones(2, "int32"), [1, 2]), "m": np.str_("go"), "a": np.int64(3)}
    obs = convert(raw | {"z": np.array([0.5, 1.0], dtype=np.float64)})
    assert list(obs) == ["a", "m", "t", "z"]
    assert (type(obs["a"]), type(obs["m"]), type(obs["t"])) == (int, str, tuple)
    assert (obs["z"].dtype, obs["t"][0].dtype, obs["t"][1].dtype) == (np.float32, np.int8, np.int64)


def test_a_transposed_picture_becomes_contiguous_and_its_own() -> None:
    picture = np.arange(16 * 20 * 3, dtype=np.uint8).reshape(20, 16, 3)
    convert = compile_observation(to_schema(spaces.Box(0, 255, (16, 20, 3), np.uint8)))
    obs = convert(picture.transpose(1, 0, 2))
    assert obs.flags.c_contiguous
    assert obs.tobytes() == picture.transpose(1, 0, 2).tobytes()
    assert not np.shares_memory(obs, picture)


def test_a_text_that_no_file_can_hold_becomes_another() -> None:
    observe = compile_observation({"type": "Text", "min_length": 0, "max_length": 9})
    assert [observe(each) for each in ("a", "é\U0001f600", "a\udcff")] == ["a", "é\U0001f600", "a\ufffd"]


def test_a_choice_before_the_first_is_refused() -> None:
    with pytest.raises(LookupError):
        compile_observation({"type": "OneOf", "spaces": [{"type": "Discrete", "n": 2}]})((-1, 0))


def test_an_unknown_kind_of_observation_is_refused() -> None:
    with pytest.raises(TypeError, match="Quaternion"):
        compile_observation({"type": "Quaternion"})
