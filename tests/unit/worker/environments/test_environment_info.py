"""What of `info` is kept."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from evopolicy_worker.environments.interface.info import plain_info


def test_scalars_of_numpy_become_plain() -> None:
    plain = plain_info(
        {"a": np.float32(0.5), "b": np.int64(3), "c": np.bool_(True), "d": 1.5, "e": False, "f": "go"}
    )
    assert plain == {"a": 0.5, "b": 3, "c": True, "d": 1.5, "e": False, "f": "go"}
    assert [type(value) for value in plain.values()] == [float, int, bool, float, bool, str]


def test_short_arrays_lists_and_flat_dicts_are_kept_and_longer_ones_dropped() -> None:
    kept = plain_info({"a": np.zeros(16), "b": np.zeros(17), "c": (1, 2), "d": [0] * 17})
    assert kept == {"a": [0.0] * 16, "c": [1, 2]}
    kept = plain_info({"r": {"x": np.True_, "y": 2.0}, "nested": {"x": {"y": 1}}})
    assert kept == {"r": {"x": True, "y": 2.0}}
    assert plain_info({"text": "x" * 257, "big": 2**64, "object": object(), "none": None}) == {}
    odd = {"long": np.zeros(2, np.longdouble), "\ud800": 1.0, "pairs": {"\ud800": 1.0}}
    assert plain_info({"strings": np.array(["a"]), "objects": np.array([None]), **odd}) == {"pairs": {}}
    assert plain_info({"bytes": "a\udcff"}) == {"bytes": "a\ufffd"}


def test_nothing_that_names_a_seed_passes() -> None:
    assert plain_info({"seed": 3, "episode_Seed": 4, "rewards": {"seed": 1, "x": 2}, 7: 1}) == {
        "rewards": {"x": 2}
    }


anything: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=300)
    | st.binary(max_size=3)
    | st.complex_numbers()
    | st.floats(width=32, allow_nan=False, allow_infinity=False).map(np.float32),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=6), inner, max_size=20),
    max_leaves=20,
)


@settings(deadline=None)
@given(st.dictionaries(st.text(max_size=8) | st.integers(), anything, max_size=6))
def test_what_is_kept_is_json_and_msgpack_as_it_is(info: dict[Any, Any]) -> None:
    plain = plain_info(info)
    assert json.loads(json.dumps(plain)) == plain
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(plain)) == plain
