"""Repair and sampling of actions, from the schema alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments import compile_actions

FOUR = {"type": "Discrete", "n": 4}
SHIFTED = {"type": "Discrete", "n": 3, "start": -1}
BOX = {"type": "Box", "shape": [3], "dtype": "float32", "low": [-1.0, 0.0, 0.0], "high": [1.0, 1.0, 1.0]}
MATRIX = {"type": "Box", "shape": [2, 3], "dtype": "float64"}
MATRIX |= {"low": [[-1.0] * 3] * 2, "high": [[1.0] * 3] * 2}
OPEN = {"type": "Box", "shape": [4], "dtype": "float32"}
OPEN |= {"low": ["-inf", 0.5, "-inf", -2.0], "high": ["inf", "inf", -3.0, 2.0]}
WIDE = {"type": "Box", "shape": [40], "dtype": "float32", "low": -2.0, "high": 2.0}
BYTES = {"type": "Box", "shape": [2], "dtype": "uint8", "low": [0, 10], "high": [255, 20]}
LONGS = {"type": "Box", "shape": [1], "dtype": "int64", "low": [-(2**63)], "high": [2**63 - 1]}
MULTI = {"type": "MultiDiscrete", "nvec": [2, 5], "start": [0, 1]}
FLAGS = {"type": "MultiBinary", "n": 3}
TEXT = {"type": "Text", "min_length": 2, "max_length": 5}
DICT = {"type": "Dict", "spaces": {"steer": BOX, "gear": FOUR}}
TUPLE = {"type": "Tuple", "spaces": [FOUR, FLAGS]}
ALL: list[SpaceSchema] = [
    *(FOUR, SHIFTED, BOX, MATRIX, OPEN, WIDE, BYTES),
    *(LONGS, MULTI, FLAGS, TEXT, DICT, TUPLE),
]


def same(left: Any, right: Any) -> bool:
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, tuple):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, np.ndarray):
        return left.dtype == right.dtype and np.array_equal(left, right)
    return type(left) is type(right) and bool(left == right)


NARROW = {"type": "Box", "shape": [1], "dtype": "float64", "low": [-0.1], "high": [0.1]}
NONSENSE: list[Any] = [
    *(None, "2", b"2", float("nan"), float("inf"), 1.5, 1j, {}, {"a": 1}, [], [1, 2], [[]], [None], object()),
    *(np.array(["2"]), np.array([1, 2]), np.array(None), [[[[[[[[[[2]]]]]]]]]]),
]
VECTOR, ZERO = [0.5, 0.25, 1.0], [0.0, 0.0, 0.0]
VECTORS: list[Any] = [
    *(np.array(VECTOR, dtype=np.float32), np.array(VECTOR), np.array([VECTOR]), VECTOR, (0.5, 0.25, 1)),
    *(np.array([[0.5], [0.25], [1.0]], dtype=np.float16), [np.float64(0.5), np.array(0.25), True], [VECTOR]),
]
"""All of them are meant as the first."""
NO_VECTORS: list[Any] = [
    *([0.1, 0.2], [0.1, 0.2, 0.3, 0.4], [10**400, 0, 0], [[0.1, 0.2], [0.3]], ["0.1", "0.2", "0.3"]),
    *([None, 0.0, 0.0], np.array([1j, 0, 0]), "abc", {}),
]
REPAIRED: list[tuple[SpaceSchema, Any, Any, bool]] = [
    # Any form of a choice is taken as it is meant; a bool counts as a number.
    *((FOUR, raw, 2, False) for raw in (2, 2.0, np.int64(2), np.uint8(2), np.float32(2.0), [2], (2,), [[2]])),
    *((FOUR, raw, 2, False) for raw in (np.array(2), np.array([2]), np.array([[2.0]]))),
    *((FOUR, raw, int(raw), False) for raw in (True, False, np.bool_(True))),
    # Beyond the bounds it is clipped; what is none becomes the lowest.
    *((FOUR, raw, 3, True) for raw in (4, 10**400, np.int64(9), 7.0, [12])),
    *((FOUR, raw, 0, True) for raw in (-1, -(10**400), *NONSENSE)),
    *((SHIFTED, raw, -1, True) for raw in (-2, *NONSENSE)),
    *((SHIFTED, raw, raw, False) for raw in (-1, 0, 1)),
    (SHIFTED, 2, 1, True),
    *((BOX, raw, VECTOR, False) for raw in VECTORS),
    *((BOX, raw, ZERO, True) for raw in NO_VECTORS),
    (BOX, [2.0, -1.0, 0.5], [1.0, 0.0, 0.5], True),
    (BOX, np.array([np.inf, -np.inf, 0.0]), [1.0, 0.0, 0.0], True),
    (BOX, np.array([1e300, 0.0, 0.0]), [1.0, 0.0, 0.0], True),
    (BOX, [float("nan"), 0.5, float("nan")], [0.0, 0.5, 0.0], True),
    (BOX, 0.5, [0.5, 0.5, 0.5], True),
    (BOX, [-7], [-1.0, 0.0, 0.0], True),
    # A row is broadcast to a matrix; a transposed one was not meant.
    (MATRIX, [0.1, 0.2, 0.3], [[0.1, 0.2, 0.3]] * 2, True),
    (MATRIX, [[0.1] * 2] * 3, [ZERO] * 2, True),
    # Rounding beyond a bound is not marked but clipped.
    (NARROW, [float(np.float32(0.1))], [0.1], False),
    (NARROW, [0.1001], [0.1], True),
    (OPEN, None, [0.0, 0.5, -3.0, 0.0], True),
    (OPEN, [12345.0, 99.0, -1e6, 0.0], [12345.0, 99.0, -1e6, 0.0], False),
    (BYTES, [3.7, 12], [3, 12], True),
    (BYTES, [300, 0], [255, 10], True),
    *((MULTI, raw, [1, 3], False) for raw in ([1, 3], np.array([1.0, 3.0]), [True, 3])),
    *((MULTI, raw, [0, 1], True) for raw in (None, [1, 2, 3])),
    *((MULTI, [raw, 2], [0, 2], True) for raw in (0.5, float("nan"))),
    *((MULTI, [raw, 2], [1, 2], True) for raw in (np.inf, 2**63)),
    *((MULTI, raw, [1, 1], True) for raw in ([5, 0], 1)),
    (FLAGS, [1, 0, 7], [1, 0, 1], True),
    (TEXT, "abc", "abc", False),
    (TEXT, "abcdefg", "abcde", True),
    *((TEXT, raw, "aa", True) for raw in ("a", 3)),
]


PUBLISHED: list[tuple[SpaceSchema, Any, Any, bool]] = [
    *((FOUR, raw, 3, False) for raw in (3, 3.7, np.float32(3.7), np.int64(3), np.array(3), "3")),
    *((FOUR, raw, 0, False) for raw in (0.6, -0.4, False)),
    *(
        (FOUR, raw, 0, True)
        for raw in ([3], [[3]], (3,), np.array([3]), np.array([[3]]), None, "x", "3.7", {})
    ),
    *((FOUR, raw, 0, True) for raw in (float("nan"), float("inf"), np.float32("nan"), -1.0)),
    (FOUR, 4.2, 3, True),
    (NARROW, "0.05", [0.05], False),
    (NARROW, ["0.05"], [0.05], False),
    (NARROW, "1", [0.1], True),
    (BOX, ["0.5", 0.25, "1"], VECTOR, False),
    *((BOX, raw, ZERO, True) for raw in ("x", ["x", 0, 0], {}, None, [0.1, 0.2])),
    *((BOX, raw, VECTOR, False) for raw in VECTORS),
]


@pytest.mark.parametrize(("space", "raw", "expected", "marked"), PUBLISHED)
def test_the_published_profiles_read_actions_as_the_published_software(
    space: SpaceSchema, raw: object, expected: Any, marked: bool
) -> None:
    codec = compile_actions(space, published=True)
    action, invalid = codec.repair(raw)
    assert invalid == marked
    np.testing.assert_array_equal(action, np.array(expected, dtype=space.get("dtype")))
    same_as_ours = compile_actions(space).sample(np.random.default_rng(1))
    np.testing.assert_array_equal(codec.sample(np.random.default_rng(1)), same_as_ours)


@pytest.mark.parametrize(("space", "raw", "expected", "marked"), REPAIRED)
def test_an_action_is_taken_as_it_is_meant_or_repaired_and_marked(
    space: SpaceSchema, raw: object, expected: Any, marked: bool
) -> None:
    action, invalid = compile_actions(space).repair(raw)
    assert invalid == marked
    if isinstance(action, np.ndarray):
        kinds = {"MultiDiscrete": "int64", "MultiBinary": "int8"}
        assert action.dtype == kinds.get(space["type"], space.get("dtype"))
        np.testing.assert_allclose(action, expected, rtol=1e-6)
    else:
        assert (action, type(action)) == (expected, type(expected))


def test_a_repaired_array_is_never_the_one_that_came_in() -> None:
    raw = np.array([0.5, 0.25, 1.0], dtype=np.float32)
    action, _ = compile_actions(BOX).repair(raw)
    raw[:] = 0
    assert action.tolist() == [0.5, 0.25, 1.0]


def test_repaired_elements_without_bounds_stay_finite() -> None:
    action, invalid = compile_actions(OPEN).repair([np.inf, np.inf, -np.inf, 0.0])
    assert invalid
    assert bool(np.isfinite(action).all())
    action, invalid = compile_actions(LONGS).repair([1e30])
    assert invalid
    assert action.dtype == np.int64
    assert action[0] > 2**62


def test_dicts_and_tuples_are_repaired_by_part() -> None:
    whole, invalid = compile_actions(DICT).repair({"steer": [0.0, 0.0, 0.0], "gear": 2})
    assert not invalid
    assert whole["gear"] == 2
    for broken in ({"steer": [0.0, 0.0, 0.0]}, {"steer": [0.0] * 3, "gear": 2, "extra": 1}, None, [1, 2]):
        whole, invalid = compile_actions(DICT).repair(broken)
        assert invalid
        assert list(whole) == ["steer", "gear"]
    pair, invalid = compile_actions(TUPLE).repair([2, [0, 1, 1]])
    assert (pair[0], pair[1].tolist(), invalid) == (2, [0, 1, 1], False)
    for bad in ([2], [2, [0, 1, 1], 3], None, 2):
        pair, invalid = compile_actions(TUPLE).repair(bad)
        assert invalid
        assert len(pair) == 2


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=True, allow_infinity=True)
    | st.text(max_size=8)
    | st.binary(max_size=8)
    | st.floats(width=32).map(np.float32)
    | st.integers(-(2**63), 2**63 - 1).map(np.int64)
    | st.lists(st.floats(width=16), max_size=6).map(lambda items: np.array(items, dtype=np.float16)),
    lambda inner: (
        st.lists(inner, max_size=5)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.sampled_from(["steer", "gear", "x"]), inner, max_size=3)
    ),
    max_leaves=12,
)


@pytest.mark.parametrize("schema", ALL, ids=lambda schema: schema["type"])
@settings(deadline=None)
@given(raw=values)
def test_repair_never_raises_and_its_result_needs_no_repair(schema: SpaceSchema, raw: object) -> None:
    codec = compile_actions(schema)
    action, _ = codec.repair(raw)
    again, invalid = codec.repair(action)
    assert not invalid
    assert same(again, action)


@pytest.mark.parametrize("schema", ALL, ids=lambda schema: schema["type"])
def test_a_random_action_is_valid_and_repeats_with_its_generator(schema: SpaceSchema) -> None:
    codec = compile_actions(schema)
    rng, twin = np.random.default_rng(3), np.random.default_rng(3)
    for _ in range(50):
        action = codec.sample(rng)
        assert same(action, codec.sample(twin))
        repaired, invalid = codec.repair(action)
        assert not invalid
        assert same(repaired, action)


def test_random_actions_of_leaf_spaces_are_gymnasiums_own() -> None:
    from gymnasium import spaces

    pairs: list[tuple[Any, SpaceSchema]] = [
        (spaces.Discrete(4), FOUR),
        (spaces.Discrete(3, start=-1), SHIFTED),
        (spaces.Box(np.array([-1, 0, 0], "f"), np.ones(3, "f")), BOX),
        (
            spaces.Box(np.array([-np.inf, 0.5, -np.inf, -2], "f"), np.array([np.inf, np.inf, -3, 2], "f")),
            OPEN,
        ),
        (spaces.Box(np.array([0, 10], "uint8"), np.array([255, 20], "uint8"), dtype=np.uint8), BYTES),
        (spaces.MultiDiscrete([2, 5], start=[0, 1]), MULTI),
        (spaces.MultiBinary(3), FLAGS),
    ]
    for space, schema in pairs:
        space.seed(11)
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(11)))
        codec = compile_actions(schema)
        for _ in range(30):
            assert np.array_equal(space.sample(), codec.sample(rng))


def test_a_space_of_unknown_kind_is_refused() -> None:
    with pytest.raises(TypeError, match="Quaternion"):
        compile_actions({"type": "Quaternion"})
