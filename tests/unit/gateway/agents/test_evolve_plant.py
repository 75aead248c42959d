"""What can be learned of a plant from a few episodes: which action moves which part."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

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
            steps.append(Step(obs=plain, action=action.tolist(), reward=-1.0))
            hand = hand + 0.03 * action[DRIVERS]
            action = np.clip(0.8 * action + 0.4 * rng.normal(size=4), -1, 1)
        made.append(steps)
    return made


@pytest.mark.parametrize("moved", [True, False])
def test_effector_and_the_outputs_that_move_it_are_found(moved: bool) -> None:
    plant = find_plant(goal_space(3), box(4), episodes(moved=moved))
    assert plant is not None
    assert (plant["effector"], plant["outputs"], plant["lift_axis"]) == (HAND, DRIVERS, 2)
    np.testing.assert_allclose(plant["slopes"], [0.03] * 3, rtol=0.1)


STILL = [[step._replace(action=[0.0] * 4) for step in steps] for steps in episodes()]


@pytest.mark.parametrize(
    ("obs_space", "action_space", "played"),
    [
        (goal_space(6), box(4), episodes()),  # no positions in space
        (box(3), box(4), episodes()),
        (goal_space(3), {"type": "Discrete", "n": 4}, episodes()),
        (goal_space(3), box(4), episodes(n_steps=5)),
        (goal_space(3), box(4), []),
        (goal_space(3), box(4), STILL),
    ],
)
def test_other_spaces_and_too_little_play_give_no_plant(
    obs_space: Any, action_space: Any, played: Any
) -> None:
    assert find_plant(obs_space, action_space, played) is None
