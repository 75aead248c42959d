"""The two toys: learnable, and clearly harder for a random policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import make

Policy = Callable[[Any], Any]


def mean_return(env_id: str, policy: Policy, cases: range = range(40)) -> float:
    environment = make(env_id)
    total = 0.0
    for seed in cases:
        obs = environment.reset(Case(seed=seed))
        while True:
            step = environment.step(environment.action_codec.repair(policy(obs))[0])
            total += step.reward
            obs = step.obs
            if step.terminated or step.truncated:
                break
    return total / len(cases)


def random_policy(env_id: str) -> Policy:
    codec = make(env_id).action_codec
    rng = np.random.default_rng(0)
    return lambda obs: codec.sample(rng)


def test_a_linear_policy_follows_the_line_far_better_than_random() -> None:
    linear = mean_return("toy/line", lambda obs: [4 * (obs[2] - obs[0]) - 6 * obs[1]])
    assert linear > -12
    assert mean_return("toy/line", random_policy("toy/line")) < -35


def test_a_policy_that_remembers_leaves_the_maze_far_sooner_than_random() -> None:
    environment = make("toy/maze")
    visits: dict[tuple[int, int], int] = {}

    def explore(obs: Any) -> int:
        if obs["steps"] == 0:
            visits.clear()
        here = tuple(obs["position"].tolist())
        visits[here] = visits.get(here, 0) + 1
        costs = []
        for action, (down, right) in enumerate(((-1, 0), (0, 1), (1, 0), (0, -1))):
            there = (here[0] + down, here[1] + right)
            away = ("north", "east", "south", "west")[action] not in obs["compass"]
            costs.append(1000 * int(obs["blocked"][action]) + 2 * visits.get(there, 0) + away)
        return int(np.argmin(costs))

    explored = mean_return("toy/maze", explore)
    assert explored > -25
    assert mean_return("toy/maze", random_policy("toy/maze")) < -50
    environment.close()


def test_every_step_in_the_maze_costs_one_and_the_exit_ends_it() -> None:
    environment = make("toy/maze")
    environment.reset(Case(seed=0))
    rng = np.random.default_rng(0)
    steps = 0
    while True:
        step = environment.step(environment.action_codec.sample(rng))
        steps += 1
        assert step.reward == -1.0
        assert step.obs["steps"] == steps
        assert (step.obs["compass"] == "here") == step.terminated
        assert (step.obs["view"][2, 2] == 2) == step.terminated
        if step.terminated or step.truncated:
            break
    assert steps <= 80


def test_the_walls_of_the_maze_stop_a_step() -> None:
    environment = make("toy/maze")
    for seed in range(30):
        obs = environment.reset(Case(seed=seed))
        for action in range(4):
            down, right = ((-1, 0), (0, 1), (1, 0), (0, -1))[action]
            assert (obs["view"][2 + down, 2 + right] == 1) == bool(obs["blocked"][action])
        before = obs["position"].tolist()
        action = seed % 4
        step = environment.step(action)
        assert step.info["bumped"] == bool(obs["blocked"][action])
        assert (step.obs["position"].tolist() == before) == step.info["bumped"]
