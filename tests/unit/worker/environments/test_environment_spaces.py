"""Gymnasium spaces as plain dicts, and plain observations of them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from evopolicy_worker.environments.interface.observations import compile_observation
from evopolicy_worker.environments.interface.spaces import bounds, obs_storage, parts, to_schema


def test_each_kind_of_space_has_its_form() -> None:
    assert to_schema(spaces.Discrete(3)) == {"type": "Discrete", "n": 3}
    assert to_schema(spaces.Discrete(3, start=2)) == {"type": "Discrete", "n": 3, "start": 2}
    assert to_schema(spaces.MultiDiscrete(np.array([[2, 3], [4, 5]]))) == {
        "type": "MultiDiscrete",
        "nvec": [[2, 3], [4, 5]],
    }
    assert to_schema(spaces.MultiDiscrete([2, 3], start=[1, 0]))["start"] == [1, 0]
    assert to_schema(spaces.MultiBinary(4)) == {"type": "MultiBinary", "n": 4}
    assert to_schema(spaces.MultiBinary([2, 2])) == {"type": "MultiBinary", "n": [2, 2]}
    assert to_schema(spaces.Text(7, min_length=2)) == {"type": "Text", "min_length": 2, "max_length": 7}
    assert to_schema(spaces.Tuple([spaces.Discrete(2)])) == {
        "type": "Tuple",
        "spaces": [{"type": "Discrete", "n": 2}],
    }


def test_bounds_are_nested_lists_by_shape_with_infinities_spelled() -> None:
    box = spaces.Box(np.array([[-np.inf, -0.0]], "f"), np.array([[1.5, np.inf]], "f"))
    assert to_schema(box) == {
        "type": "Box",
        "shape": [1, 2],
        "dtype": "float32",
        "low": [["-inf", 0.0]],
        "high": [[1.5, "inf"]],
    }
    assert "-0.0" not in json.dumps(to_schema(box))


def test_bound_that_more_than_32_values_share_is_one_number() -> None:
    assert to_schema(spaces.Box(-1, 1, (32,)))["low"] == [-1.0] * 32
    assert to_schema(spaces.Box(-np.inf, 1, (33,))) == {
        "type": "Box",
        "shape": [33],
        "dtype": "float32",
        "low": "-inf",
        "high": 1.0,
    }
    symbolic = to_schema(spaces.Box(0, 255, (7, 7, 3), np.uint8))
    assert symbolic == {"type": "Box", "shape": [7, 7, 3], "dtype": "uint8", "low": 0, "high": 255}
    assert type(symbolic["high"]) is int


@pytest.mark.parametrize("shape", [(96, 96, 3), (16, 16, 1), (210, 160, 3)])
def test_a_picture_is_an_image_stored_beside_the_rows(shape: tuple[int, ...]) -> None:
    schema = to_schema(spaces.Box(0, 255, shape, np.uint8))
    assert schema == {
        "type": "Image",
        "shape": list(shape),
        "dtype": "uint8",
        "layout": "height_width_channels",
        "value_range": [0, 255],
        "storage": "external",
    }
    assert obs_storage(schema) == "npz"
    low, high = bounds(schema)
    assert (low.min(), high.max(), low.shape) == (0.0, 255.0, shape)


@pytest.mark.parametrize(
    ("shape", "storage"),
    [
        ((7, 7, 3), "inline"),
        ((15, 15), "inline"),
        ((15, 80, 3), "inline"),
        ((15, 96, 3), "npz"),
    ],
)
def test_other_bytes_are_a_box_in_the_rows_unless_many(shape: tuple[int, ...], storage: str) -> None:
    schema = to_schema(spaces.Box(0, 255, shape, np.uint8))
    assert schema["type"] == "Box"
    assert obs_storage(schema) == storage


@pytest.mark.parametrize(
    "shape", [(16, 16), (84, 84), (3, 96, 96), (4, 20, 20), (20, 20, 4), (20, 20, 12), (2, 20, 20, 3)]
)
def test_a_picture_of_any_layout_is_stored_beside_the_rows(shape: tuple[int, ...]) -> None:
    schema = to_schema(spaces.Box(0, 255, shape, np.uint8))
    assert schema["type"] == "Box"
    assert obs_storage(schema) == "npz"
    assert obs_storage(to_schema(spaces.Box(0, 100, (20, 20), np.int8))) == "inline"


def test_large_observations_of_several_parts_are_stored_in_an_archive() -> None:
    half = spaces.Box(-1, 1, (300,), np.float64)
    assert obs_storage(to_schema(spaces.Dict({"a": half}))) == "inline"
    assert obs_storage(to_schema(spaces.Tuple([half, half]))) == "npz"
    assert obs_storage(to_schema(spaces.MultiDiscrete([2] * 513))) == "npz"
    assert obs_storage(to_schema(spaces.MultiBinary(4096))) == "inline"


def test_bounds_of_a_schema_of_an_older_version_are_read() -> None:
    low, high = bounds({"type": "Box", "shape": [40], "dtype": "float64", "min": "-inf", "max": 1.0})
    assert (low.shape, low.max(), high.min()) == ((40,), -np.inf, 1.0)


def test_large_box_with_different_bounds_lists_them_all() -> None:
    schema = to_schema(spaces.Box(np.arange(40.0) - 50, np.full(40, np.inf), dtype=np.float64))
    assert schema["low"] == [float(k) - 50 for k in range(40)]
    assert schema["high"] == "inf"


def test_a_picture_inside_a_dict_is_stored_in_an_archive() -> None:
    schema = to_schema(
        spaces.Dict({"eye": spaces.Box(0, 255, (64, 64, 3), np.uint8), "dir": spaces.Discrete(4)})
    )
    assert schema["spaces"]["eye"]["storage"] == "external"
    assert obs_storage(schema) == "npz"
    assert [part["type"] for part in parts(schema)] == ["Discrete", "Image"]


def test_a_space_without_a_form_is_refused() -> None:
    class Quaternion(spaces.Space[Any]):
        pass

    with pytest.raises(
        TypeError, match=r"a space of type Quaternion .* put a wrapper around the environment"
    ):
        to_schema(Quaternion())


@pytest.mark.parametrize(
    "inner", [spaces.Dict({"a": spaces.Discrete(2)}), spaces.Tuple([spaces.Discrete(2)])]
)
def test_a_stacked_sequence_of_several_parts_is_refused(inner: spaces.Space[Any]) -> None:
    with pytest.raises(
        TypeError, match=r"a stacked Sequence of (Dict|Tuple) has no form here; give it without stack"
    ):
        to_schema(spaces.Sequence(inner, stack=True))


def test_a_key_that_is_no_text_is_refused() -> None:
    with pytest.raises(TypeError, match="key 1 of a Dict has no form here; its keys have to be texts"):
        to_schema(spaces.Tuple([spaces.Dict({1: spaces.Discrete(2)})]))  # type: ignore[dict-item]


def test_observations_become_plain_in_the_order_and_dtypes_of_the_space() -> None:
    space = spaces.Dict(
        {
            "z": spaces.Box(-1, 1, (2,), np.float32),
            "a": spaces.Discrete(5),
            "m": spaces.Text(9),
            "t": spaces.Tuple([spaces.MultiBinary(2), spaces.MultiDiscrete([3, 3])]),
        }
    )
    convert = compile_observation(to_schema(space))
    raw: dict[str, Any] = {
        "t": (np.ones(2, "int32"), [1, 2]),
        "m": np.str_("go"),
        "a": np.int64(3),
        "z": np.array([0.5, 1.0], dtype=np.float64),
    }
    obs = convert(raw)
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


def test_an_unknown_kind_of_observation_is_refused() -> None:
    with pytest.raises(TypeError, match="Quaternion"):
        compile_observation({"type": "Quaternion"})
