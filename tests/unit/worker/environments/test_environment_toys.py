"""The rules of the toy maze."""

from __future__ import annotations

import numpy as np

from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import make


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
