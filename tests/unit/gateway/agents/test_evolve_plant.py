"""What can be learned of a plant from a few episodes: which action moves which part."""

from __future__ import annotations

from typing import Any

import numpy as np

from evopolicy_gateway.agents.evolve.feedback import Step
from evopolicy_gateway.agents.evolve.plant import find_plant

N_OBS = 7
HAND = [5, 2, 4]
"""Where in the observation the hand's coordinates are."""
DRIVERS = [1, 3, 0]
"""The action that moves each of them."""


def box(n: int) -> dict[str, Any]:
    return {"type": "Box", "shape": [n], "dtype": "float64", "low": [-1.0] * n, "high": [1.0] * n}


def goal_space(n_axes: int) -> dict[str, Any]:
    return {
        "type": "Dict",
        "spaces": {"observation": box(N_OBS), "achieved_goal": box(n_axes), "desired_goal": box(n_axes)},
    }


def episodes(*, moved: bool = True, n_steps: int = 40) -> list[list[Step]]:
    """A hand moved by three of four outputs, a thing that slides on the floor when `moved`; the rest is noise."""
    made = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        hand, thing = np.array([1.3, 0.7, 0.5]), np.array([1.2, 0.8, 0.4])
        action = rng.uniform(-1, 1, 4)
        steps = []
        for _ in range(n_steps):
            obs = rng.normal(size=N_OBS)
            obs[HAND] = hand
            thing = thing + np.array([*rng.normal(0, 0.02, 2), 0.0]) * moved
            whole = {"observation": obs, "achieved_goal": thing, "desired_goal": np.array([1.4, 0.6, 0.6])}
            plain = {key: value.tolist() for key, value in whole.items()}
            steps.append(Step(obs=plain, action=action.tolist(), reward=-1.0, terminated=False))
            hand = hand + 0.03 * action[DRIVERS]
            action = np.clip(0.8 * action + 0.4 * rng.normal(size=4), -1, 1)
        made.append(steps)
    return made


def test_effector_and_the_outputs_that_move_it_are_found() -> None:
    plant = find_plant(goal_space(3), box(4), episodes())
    assert plant is not None
    assert plant["effector"] == HAND
    assert plant["outputs"] == DRIVERS
    np.testing.assert_allclose(plant["slopes"], [0.03] * 3, rtol=0.1)
    assert plant["lift_axis"] == 2


def test_last_axis_is_up_when_nothing_was_moved() -> None:
    plant = find_plant(goal_space(3), box(4), episodes(moved=False))
    assert plant is not None
    assert plant["lift_axis"] == 2


def test_goals_that_are_not_positions_in_space_give_no_plant() -> None:
    assert find_plant(goal_space(6), box(4), episodes()) is None
    assert find_plant(box(3), box(4), episodes()) is None
    assert find_plant(goal_space(3), {"type": "Discrete", "n": 4}, episodes()) is None


def test_too_few_steps_give_no_plant() -> None:
    assert find_plant(goal_space(3), box(4), episodes(n_steps=5)) is None
    assert find_plant(goal_space(3), box(4), []) is None


def test_actions_without_effect_give_no_plant() -> None:
    still = [[Step(obs=s.obs, action=[0.0] * 4, reward=0.0, terminated=False) for s in e] for e in episodes()]
    assert find_plant(goal_space(3), box(4), still) is None
