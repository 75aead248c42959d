"""Timers against a dictionary, and the ring of stories."""

from __future__ import annotations

import hypothesis.strategies as st
from hypothesis import given

from evopolicy_coordinator.core.structures.timers import TimerKey, Timers

STEPS = st.lists(
    st.tuples(st.sampled_from(["arm", "once", "disarm", "due"]), st.integers(0, 8), st.integers(0, 50)),
    max_size=200,
)


@given(STEPS)
def test_timers_fire_like_a_sorted_dictionary(steps: list[tuple[str, int, int]]) -> None:
    timers, model = Timers(), dict[TimerKey, float]()
    for act, name, at in steps:
        key: TimerKey = ("t", name)
        if act == "arm":
            timers.arm(key, float(at))
            model[key] = float(at)
        elif act == "once":
            timers.arm_once(key, float(at))
            model.setdefault(key, float(at))
        elif act == "disarm":
            timers.disarm(key)
            model.pop(key, None)
        else:
            fired = timers.pop_due(float(at))
            due = [when for when in model.values() if when <= at]
            assert (fired is None) == (not due)
            if fired is not None:
                assert model.pop(fired) == min(due)
        assert timers.next() == min(model.values(), default=None)
        assert len(timers) == len(model)
        assert (key in timers) == (key in model)


def test_moving_one_deadline_for_ever_takes_no_memory() -> None:
    timers = Timers()
    for at in range(10_000):
        timers.arm(("t", 0), float(at))
    assert len(timers._heap) < 200
