"""The trajectory codec: what goes in comes out bit for bit, and damage is told."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records.episodes import trajectory
from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory, decode

Steps = list[tuple[Any, Any, float, bool, bool, dict[str, Any]]]


def packed(steps: Steps, **options: Any) -> bytes:
    recorder = Recorder(**options)
    for step in steps:
        recorder.append(*step)
    return recorder.finish()


def round_trip(steps: Steps, **options: Any) -> Trajectory:
    return decode(packed(steps, **options))


def same(a: Any, b: Any) -> bool:
    """Equal in value, type and bits; a tuple may come back as a list."""
    if isinstance(a, np.ndarray):
        return (
            isinstance(b, np.ndarray)
            and a.dtype == b.dtype
            and a.shape == b.shape
            and a.tobytes() == b.tobytes()
        )
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return isinstance(b, list | tuple) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    return type(a) is type(b) and a == b


arrays = hnp.arrays(
    st.sampled_from([np.float32, np.float64, np.uint8, np.int64, np.bool_]),
    hnp.array_shapes(min_dims=0, max_side=3),
)
leaves = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | arrays
    | hnp.arrays(np.float32, (0, 2))
)
values = st.recursive(
    leaves,
    lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=3), v, max_size=3),
    max_leaves=6,
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(values, values, st.floats(), st.booleans(), st.booleans()), max_size=6))
def test_whatever_is_appended_comes_back(steps: list[tuple[Any, Any, float, bool, bool]]) -> None:
    played = [(*step, {"k": step[2]}) for step in steps]
    rows = list(round_trip(played).rows())
    assert [row.t for row in rows] == list(range(len(steps)))
    for row, (obs, action, reward, terminated, truncated, info) in zip(rows, played, strict=True):
        assert same(obs, row.obs)
        assert same(action, row.action)
        assert same(reward, row.reward)
        assert (terminated, truncated) == (row.terminated, row.truncated)
        assert same(info, row.info)


@settings(max_examples=30, deadline=None)
@given(st.binary(max_size=40), st.integers(0, 200))
def test_damaged_bytes_are_reported_and_nothing_else_happens(noise: bytes, at: int) -> None:
    whole = packed([(np.zeros(3), 1, 0.5, False, False, {})] * 5)
    for damaged in (
        noise,
        trajectory.MAGIC + noise,
        trajectory.MAGIC + bytes(8),
        whole[:at] if at < len(whole) else b"",
        whole + b"x",
    ):
        with pytest.raises(ProtocolError):
            decode(damaged)


def dict_steps(n: int) -> Steps:
    return [
        (
            {
                "image": np.full((40, 40, 3), t % 256, np.uint8),
                "mission": "go",
                "n": t,
                "pair": (t, np.float32([t])),
            },
            np.array([t], np.float32),
            float(t),
            t == n - 1,
            False,
            {"x": 1.0},
        )
        for t in range(n)
    ]


def test_blocks_join_to_whole_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    one = round_trip(dict_steps(25))
    monkeypatch.setattr(trajectory, "BLOCK_BYTES", 20_000)
    many = round_trip(dict_steps(25))
    for episode in (one, many):
        assert episode.obs["image"].shape == (25, 40, 40, 3)
        assert episode.obs["mission"] == ["go"] * 25
        assert episode.obs["n"].tolist() == list(range(25))
        assert episode.obs["pair"][1].shape == (25, 1)
        assert isinstance(episode.actions, np.ndarray)
        assert episode.actions.shape == (25, 1)
        assert episode.terminated.tolist() == [False] * 24 + [True]
    assert all(same(a.obs, b.obs) for a, b in zip(one.rows(), many.rows(), strict=True))
    assert isinstance(next(many.rows()).obs["n"], int)


def test_blocks_of_different_kinds_of_action_join_to_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "BLOCK_ROWS", 2)
    actions: list[Any] = [1, 2, 2.5, 3.5, [1], None, (1,), (2,), {}, {}, {"a": 1}, {"b": 1}]
    episode = round_trip([(0, action, 0.0, False, False, {}) for action in actions])
    assert [row.action for row in episode.rows()] == actions


def test_the_same_rows_give_the_same_bytes() -> None:
    assert packed(dict_steps(7)) == packed(dict_steps(7))


def test_an_action_log_holds_actions_and_rewards_only() -> None:
    episode = round_trip(dict_steps(3), record="actions")
    assert (episode.obs, episode.infos, episode.record) == (None, [], "actions")
    assert [row.reward for row in episode.rows()] == [0.0, 1.0, 2.0]
    assert all(row.obs is None and row.info == {} for row in episode.rows())


def test_observations_given_as_lists_come_back_as_lists() -> None:
    first = next(round_trip(dict_steps(2), observations="lists").rows())
    assert first.obs["pair"] == [0, [0.0]]
    assert first.obs["image"][0][0] == [0, 0, 0]


def test_what_msgpack_cannot_say_is_kept_readable() -> None:
    rows = list(
        round_trip(
            [(0, "\ud800", 0.0, False, False, {}), (0, {"\ud800": 2**70}, 0.0, True, False, {})]
        ).rows()
    )
    assert rows[0].action == "\\ud800"
    assert rows[1].action == {"\\ud800": 2**70}
    assert [row.action for row in round_trip([(0, np.longdouble(0.5), 0.0, True, False, {})]).rows()] == [0.5]


def test_an_episode_without_a_step_is_an_episode() -> None:
    episode = round_trip([])
    assert (episode.n, episode.obs, list(episode.rows())) == (0, None, [])


def pictures(n: int, side: int = 40) -> Steps:
    return [(np.full((side, side, 3), t % 256, np.uint8), t, float(t), False, False, {}) for t in range(n)]


def test_pictures_are_packed_as_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder()
    for step in pictures(1000, side=96):
        recorder.append(*step)
        assert recorder._obs == []
    assert decode(recorder.finish()).obs.shape == (1000, 96, 96, 3)
    monkeypatch.setattr(trajectory, "PICTURES_BLOCK_BYTES", 50_000)
    episode = round_trip(pictures(45))
    assert all(same(step[0], row.obs) for step, row in zip(pictures(45), episode.rows(), strict=True))
    assert packed(pictures(45)) == packed(pictures(45))


def test_observations_that_change_their_form_are_kept_all_the_same() -> None:
    steps = pictures(3) + pictures(2, side=50) + dict_steps(2) + pictures(2)
    rows = list(round_trip(steps).rows())
    assert all(same(step[0], row.obs) for step, row in zip(steps, rows, strict=True))
