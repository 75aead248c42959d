"""Comparisons of `evopolicy verify`: bits of trajectories, and feedback files against them."""

from __future__ import annotations

import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.records.episodes.compare import (
    Rows,
    actions_of,
    files_difference,
    first_difference,
    reads_as,
    same,
)
from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory, decode


def episode(**changes: Any) -> Trajectory:
    """Three steps; `changes` name what is other in the last one."""
    recorder = Recorder("full")
    for t in range(3):
        row = {
            "obs": np.array([t, 0.1], dtype=np.float32),
            "action": np.array([0.1 * t], dtype=np.float32),
            "reward": 0.1 * t,
            "terminated": t == 2,
            "truncated": False,
            "info": {"x": 1.5},
        }
        if t == 2:
            row |= changes
        recorder.append(**row)
    return decode(recorder.finish())


def write_files(folder: Path, rows: list[dict[str, Any]]) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "trajectory.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def rows_of(trajectory: Trajectory) -> list[dict[str, Any]]:
    """Rows as feedback files have them: the shortest text of each number's own dtype."""

    def short(array: np.ndarray) -> list[float]:
        return [float(str(value)) for value in array]

    return [
        {
            "t": row.t,
            "obs": short(row.obs),
            "action": short(row.action),
            "reward": row.reward,
            "terminated": row.terminated,
            "truncated": row.truncated,
            "info": row.info,
        }
        for row in trajectory.rows()
    ]


def test_equal_trajectories_have_no_difference() -> None:
    assert first_difference(episode(), episode()) is None


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"reward": math.nextafter(0.2, 1.0)}, "step 2: reward"),
        ({"terminated": False}, "step 2: terminated"),
        ({"truncated": True}, "step 2: truncated"),
        ({"obs": np.nextafter(np.array([2, 0.1], dtype=np.float32), np.float32(9))}, "observations differ"),
        ({"info": {"x": 1.25}}, "infos differ"),
    ],
)
def test_one_bit_in_one_step_is_a_difference(change: dict[str, Any], named: str) -> None:
    assert named in (first_difference(episode(), episode(**change)) or "")


def test_a_failed_policys_mark_is_no_difference_of_the_environment() -> None:
    assert first_difference(episode(info={"x": 1.5, "policy_failed": True}), episode()) is None


def test_infos_from_before_steps_were_recorded_are_read_in_their_own_form() -> None:
    old = episode(info={"x": 1.5, "speed": 2.0})
    assert first_difference(old, episode(info={"x": 1.5, "steps": 3, "rewards": {"speed": 2.0}})) is None
    assert first_difference(old, episode(info={"x": 1.5, "steps": 3, "rewards": {"speed": 2.5}})) is not None
    assert (
        first_difference(episode(info={"x": 1.5, "steps": 3}), episode(info={"x": 1.5, "steps": 4}))
        is not None
    )


def test_zeros_of_both_signs_and_other_dtypes_are_not_the_same() -> None:
    assert not same(0.0, -0.0)
    assert not same(np.zeros(2, np.float32), np.zeros(2, np.float64))
    assert same({"a": np.float64("nan")}, {"a": np.float64("nan")})


@given(st.floats(width=32))
def test_a_float32_reads_back_from_its_shortest_text(value: float) -> None:
    number = np.float32(value)
    text: Any = float(str(number))
    if not np.isfinite(number):
        text = "NaN" if np.isnan(number) else ("Inf" if number > 0 else "-Inf")
    assert reads_as(text, number)
    assert reads_as([text], np.array([number]))


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_the_next_float_is_another_one(value: float) -> None:
    assert reads_as(json.loads(json.dumps(value)), value)
    assert not reads_as(math.nextafter(value, math.inf if value < 0 else -math.inf), value)


def test_files_that_tell_the_episode_have_no_difference(tmp_path: Path) -> None:
    write_files(tmp_path / "ep", rows_of(episode()))
    rows = Rows(tmp_path / "ep")
    assert files_difference(tmp_path / "ep", rows, episode(), actions=True) is None
    assert actions_of(rows)[1] == [0.1]


@pytest.mark.parametrize("field", ["obs", "action", "reward", "terminated", "info"])
def test_a_tampered_field_of_a_file_is_found(tmp_path: Path, field: str) -> None:
    rows = rows_of(episode())
    rows[1][field] = {"obs": [1.0, 0.2], "action": [0.3], "reward": 7.0, "terminated": True, "info": {}}[
        field
    ]
    write_files(tmp_path / "ep", rows)
    difference = files_difference(tmp_path / "ep", Rows(tmp_path / "ep"), episode(), actions=True)
    assert difference.startswith(f"step 1: {field}")


def test_a_row_that_was_taken_out_is_found(tmp_path: Path) -> None:
    write_files(tmp_path / "ep", rows_of(episode())[:2])
    rows = Rows(tmp_path / "ep")
    assert files_difference(tmp_path / "ep", rows, episode(), actions=True) == "2 and 3 steps"


def test_a_file_that_holds_no_rows_of_a_trajectory_is_refused(tmp_path: Path) -> None:
    write_files(tmp_path / "ep", [{"reward": 1.0}])
    with pytest.raises(ValueError, match="not one of a trajectory"):
        Rows(tmp_path / "ep")


@pytest.mark.parametrize("row", ['{"action": ' + "[" * 100_000, '{"action": ' + "9" * 5000 + "}", "[]"])
def test_a_row_of_any_wrong_shape_is_refused_as_unreadable(tmp_path: Path, row: str) -> None:
    (tmp_path / "trajectory.jsonl").write_text(row + "\n")
    with pytest.raises(ValueError):  # noqa: PT011
        Rows(tmp_path)


def test_a_number_without_measure_reads_as_no_float() -> None:
    assert not reads_as(10**400, 1.0)
    assert not reads_as(10**400, np.float32(1.0))


@pytest.mark.system
def test_rows_of_many_values_are_not_all_in_memory_at_once(tmp_path: Path) -> None:
    line = '{"t":0,"action":0,"reward":0.0,"info":{"x":[%s[]]}}\n' % ("[]," * 30_000)
    (tmp_path / "trajectory.jsonl").write_text(line * 30)
    size = 30 * len(line)
    tracemalloc.start()
    try:
        assert actions_of(Rows(tmp_path)) == [0] * 30
        assert tracemalloc.get_traced_memory()[1] < 6 * size
    finally:
        tracemalloc.stop()
