"""Crafter's worlds are made faster here, and are the same; a frame for people changes no episode, also at night."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import make, missing, process_environment

ENV = "crafter/CrafterReward-v1"
SEED = 20_011
UNCHANGED = f"""
import sys
import crafter
env = crafter.Env(seed={SEED})
sys.stdout.buffer.write(env.reset().tobytes() + env._world._mat_map.tobytes() + env._world._obj_map.tobytes())
"""

pytestmark = [
    pytest.mark.families,
    pytest.mark.skipif(bool(missing(ENV)), reason=f"{ENV} needs {missing(ENV)}"),
]


def test_a_world_is_the_one_that_the_package_makes() -> None:
    variables = process_environment() | {"PATH": "/usr/bin:/bin"}
    program = [sys.executable, "-P", "-c", UNCHANGED]
    theirs = subprocess.run(program, capture_output=True, check=True, env=variables).stdout
    environment = make(ENV)
    obs = environment.reset(Case(seed=SEED))
    world = environment.bare._world  # type: ignore[attr-defined]
    assert theirs == obs.tobytes() + world._mat_map.tobytes() + world._obj_map.tobytes()


def test_frames_leave_the_random_numbers_of_an_episode_alone() -> None:
    environment = make(ENV, render=True)
    states = []
    for drawn in (False, True):
        environment.reset(Case(seed=SEED))
        world = environment.bare._world  # type: ignore[attr-defined]
        # At night the picture is made of the world's random numbers.
        environment.bare._game._step = 205  # type: ignore[attr-defined]
        for _ in range(4):
            environment.step(0)
            if drawn:
                assert environment.render().any()
        assert world.daylight < 0.5
        states.append(world.random.get_state()[1].copy())
    assert np.array_equal(*states)
