"""Replays of published results: rounding that another processor explains."""

from __future__ import annotations

import math

import pytest

from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory, decode
from evopolicy_results.publish.replay import LAST_PLACES, rounded


def episode(*rewards: float, ends: int | None = None) -> Trajectory:
    recorder = Recorder("actions")
    for t, reward in enumerate(rewards):
        recorder.append(None, 0, reward, t == (len(rewards) - 1 if ends is None else ends), False, {})
    return decode(recorder.finish())


def up(places: int, value: float = 0.3) -> float:
    for _ in range(places):
        value = math.nextafter(value, math.inf)
    return value


SINGLE = 0.10000000149011612  # 0.1 in single precision, and the number after it
AFTER = 0.10000000894069672


@pytest.mark.parametrize(
    ("recorded", "again", "is_rounding"),
    [
        (episode(1.0, 0.3), episode(1.0, up(LAST_PLACES)), True),
        (episode(1.0, 0.3), episode(1.0, up(LAST_PLACES + 1)), False),
        (episode(SINGLE), episode(AFTER), True),
        (episode(0.1), episode(AFTER), False),
        (episode(up(1), 5.0), episode(0.3, 7.0), True),
        (episode(0.0), episode(-0.0), True),
        (episode(5.0, up(1)), episode(7.0, 0.3), False),
        (episode(up(1), ends=0), episode(0.3, ends=1), False),
        (episode(1.0, 1.0), episode(1.0), False),
        (episode(1.0), episode(math.nan), False),
        (episode(1e300), episode(math.inf), False),
        (episode(1.0), episode(1.0), False),
    ],
)
def test_another_processor_explains_a_few_units_in_the_last_place(
    recorded: Trajectory, again: Trajectory, is_rounding: bool
) -> None:
    assert rounded(recorded, again) is is_rounding
