"""The rewards that the task texts describe in words are those that the environments give."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import Environment, Step

Warm = Callable[[str], Environment]
Formula = Callable[[Any, Any, Step], float]
"""Observation before the step, action, and what the step gave, to the reward."""


def acrobot(obs: Any, action: Any, step: Step) -> float:
    cos1, sin1, cos2, sin2 = step.obs[:4].tolist()
    return 0.0 if -cos1 - (cos1 * cos2 - sin1 * sin2) > 1 else -1.0


def mountain_car(obs: Any, action: Any, step: Step) -> float:
    x, v = obs.tolist()
    v = np.clip(v + 0.0015 * action[0] - 0.0025 * np.cos(3 * x), -0.07, 0.07)
    assert step.obs == pytest.approx([x + v, v], abs=1e-6)
    return float(-0.1 * action[0] ** 2)


def bipedal(obs: Any, action: Any, step: Step) -> float:
    # One step is 1/50 s, and component 2 is the velocity times 0.12: the way is only known to the integrator's error.
    way = step.obs[2] / 0.12 / 50
    turned = abs(step.obs[0]) - abs(obs[0])
    return -100.0 if step.terminated else float(4.3333 * way - 5 * turned - 0.028 * np.abs(action).sum())


def reacher(obs: Any, action: Any, step: Step) -> float:
    cosines, sines = step.obs[0:2], step.obs[2:4]
    both = np.arctan2(sines, cosines).sum()
    tip = 0.1 * np.array([cosines[0], sines[0]]) + 0.11 * np.array([np.cos(both), np.sin(both)])
    assert tip - step.obs[4:6] == pytest.approx(step.obs[8:10], abs=0.02)  # 0.01 s apart
    return float(-np.linalg.norm(step.obs[8:10]) - np.square(action).sum())


def half_cheetah(obs: Any, action: Any, step: Step) -> float:
    return float(step.info["x_velocity"] - 0.1 * np.square(action).sum())


def ant(obs: Any, action: Any, step: Step) -> float:
    contact = 0.0005 * np.square(step.obs[27:]).sum()
    return float(step.info["x_velocity"] + (not step.terminated) - 0.5 * np.square(action).sum() - contact)


def pusher(obs: Any, action: Any, step: Step) -> float:
    wrist, cylinder, goal = step.obs[14:17], step.obs[17:20], step.obs[20:23]
    near = np.linalg.norm(cylinder - wrist)
    return float(-np.linalg.norm(cylinder - goal) - 0.5 * near - 0.1 * np.square(action).sum())


def parking(obs: Any, action: Any, step: Step) -> float:
    distance = np.abs(step.obs["achieved_goal"] - step.obs["desired_goal"]) @ [1, 0.3, 0, 0, 0.02, 0.02]
    assert step.info["is_success"] == (distance < 0.0144)
    return float(-(distance**0.5) - 5 * step.info["crashed"])


def roundabout(obs: Any, action: Any, step: Step) -> float:
    info = step.info["rewards"]
    assert info["lane_change_reward"] == (action in (0, 2))
    terms = 1 - info["collision_reward"] + 0.2 * info["high_speed_reward"] - 0.05 * info["lane_change_reward"]
    return float(terms / 1.2 * info["on_road_reward"])


def fetch(obs: Any, action: Any, step: Step) -> float:
    distance = np.linalg.norm(step.obs["achieved_goal"] - step.obs["desired_goal"])
    assert step.info["is_success"] == (distance < 0.05)
    return -1.0 if distance > 0.05 else 0.0


def toy_line(obs: Any, action: Any, step: Step) -> float:
    v = 0.9 * obs[1] + 0.1 * action[0]
    assert step.obs[:2] == pytest.approx([obs[0] + v, v], abs=1e-5) or abs(obs[0] + v) > 2
    return float(-abs(step.obs[0] - step.obs[2]) - 0.01 * action[0] ** 2)


@pytest.mark.parametrize(
    ("env_id", "formula", "tolerance"),
    [
        ("gym/acrobot", acrobot, 0.0),
        ("gym/continuouscar", mountain_car, 1e-6),
        ("gym/bipedal", bipedal, 0.2),
        ("gym/reacher5", reacher, 1e-9),
        ("gym/halfcheetah5", half_cheetah, 1e-6),
        ("gym/ant5", ant, 1e-6),
        ("gym/pusher5", pusher, 1e-6),
        ("gymnasium/parking-v0", parking, 1e-9),
        ("gymnasium/roundabout-v0", roundabout, 1e-9),
        ("gymnasium/FetchPush-v4", fetch, 0.0),
        ("gymnasium/FetchPickAndPlace-v4", fetch, 0.0),
        ("toy/line", toy_line, 1e-5),
    ],
)
def test_reward_is_made_of_the_terms_that_the_text_names(
    env_id: str, formula: Formula, tolerance: float, warm: Warm
) -> None:
    environment = warm(env_id)
    rng = np.random.default_rng(0)
    obs = environment.reset(Case(seed=8))
    for _ in range(11 if env_id.startswith("gymnasium/") else 150):
        action = environment.action_codec.sample(rng)
        step = environment.step(action)
        assert step.reward == pytest.approx(formula(obs, action, step), abs=tolerance)
        obs = step.obs
        if step.terminated or step.truncated:
            break


def test_a_racing_step_costs_a_tenth_and_a_first_tile_pays(warm: Warm) -> None:
    environment = warm("gym/racing")
    environment.reset(Case(seed=8))
    still = np.zeros(3, dtype=np.float32)
    first, second = environment.step(still), environment.step(still)
    assert first.reward > 1000 / 400
    assert second.reward == pytest.approx(-0.1)


@pytest.mark.parametrize(
    "env_id", ["gymnasium/MiniGrid-DoorKey-16x16-v0", "gymnasium/MiniGrid-KeyCorridorS4R3-v0"]
)
def test_the_minigrid_view_lies_as_the_text_says(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    environment.reset(Case(seed=2))
    grid: Any = environment.bare.unwrapped  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(60):
        obs = environment.step(int(rng.integers(0, 6))).obs
        ahead = ((1, 0), (0, 1), (-1, 0), (0, -1))[obs["direction"]]
        right = (-ahead[1], ahead[0])
        for i, j in np.ndindex(7, 7):
            code = tuple(obs["image"][i, j].tolist())
            if code[0] == 0 or (i, j) == (3, 6):
                continue
            x, y = (grid.agent_pos[k] + (6 - j) * ahead[k] + (i - 3) * right[k] for k in (0, 1))
            cell = grid.grid.get(x, y) if 0 <= x < grid.width and 0 <= y < grid.height else None
            inside = 0 <= x < grid.width and 0 <= y < grid.height
            assert code == (cell.encode() if cell else (1, 0, 0) if inside else (2, 5, 0))
            compared += 1
    assert compared > 500
