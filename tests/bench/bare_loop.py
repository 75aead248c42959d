"""The limit that everything is held against: the library's own environment and the policy in one process, no sandbox.

Run as a program, since a simulator's state must not be shared with what is measured beside it:
`python bare_loop.py ID SECONDS MAX_EPISODES` prints JSON `{"episodes": …, "steps": …, "seconds": …}`.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import statistics
import sys
import time
from typing import Any

PLAYERS = {
    "gymnasium_robotics": ("Fetch",),
    "highway_env": ("parking", "roundabout"),
    "minigrid": ("MiniGrid",),
}

POLICY = '''"""Costs next to nothing: what is measured is everything else."""


def constant(space):
    kind = space["type"]
    if kind == "Dict":
        return {name: constant(each) for name, each in space["spaces"].items()}
    if kind == "Text":
        return "noop()"  # BrowserGym's
    if kind == "Discrete":
        return 0
    return [0] * space["n"] if kind == "MultiBinary" else [0.0] * space["shape"][0]


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.action = constant(action_space)

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return self.action
'''


WEB_PAGES = ("miniwob/", "browsergym/")
PACED, PACED_STEPS = 21, 10
"""Episodes, and steps of each, by which a web page's step and reset are timed."""


def seeds(n: int) -> list[int]:
    """The cases that every row of the bench plays."""
    return [7_000_000 + index for index in range(n)]


def make(gymnasium_id: str) -> Any:
    import gymnasium

    for module, prefixes in PLAYERS.items():
        if gymnasium_id.startswith(prefixes):
            package = importlib.import_module(module)
            if module == "gymnasium_robotics":
                gymnasium.register_envs(package)
    return gymnasium.make(gymnasium_id)


def make_of(env_id: str) -> Any:
    """The environment of an id of the catalogue. Outside Core16 its family makes it, which knows its arguments."""
    from evopolicy_common import catalogue
    from evopolicy_worker.environments import registry
    from evopolicy_worker.environments.interface import settings

    entry = catalogue.entry(env_id)
    if env_id in catalogue.suites()["core16"].environments:
        return make(str(entry.gymnasium_id))
    settings.apply()
    family = registry.family_of(entry)
    family.load()
    return family.make(entry, render=False)


def constant(space: Any) -> Any:
    """The action of `POLICY`."""
    import numpy as np

    if hasattr(space, "spaces"):
        return {name: constant(each) for name, each in space.spaces.items()}
    if hasattr(space, "characters"):
        return "noop()"
    return 0 if space.shape == () else np.zeros(space.shape, dtype=space.dtype)


def pace(env: Any) -> dict[str, float]:
    """Median seconds of a step and of a reset, over a few episodes."""
    action = constant(env.action_space)
    resets, steps = [], []
    for seed in seeds(PACED):
        began = time.perf_counter()
        env.reset(seed=seed)
        resets.append(time.perf_counter() - began)
        ended = False
        while not ended:
            began = time.perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            steps.append(time.perf_counter() - began)
            ended = terminated or truncated or len(steps) % PACED_STEPS == 0
    return {"step_median_s": statistics.median(steps), "reset_median_s": statistics.median(resets)}


def play(env: Any, seed: int, most: float = math.inf) -> int:
    """One episode with the constant policy of `POLICY`, of `most` steps at most; its number of steps."""
    action = constant(env.action_space)
    env.reset(seed=seed)
    steps = 0
    while True:
        _, _, terminated, truncated, _ = env.step(action)
        steps += 1
        if terminated or truncated or steps >= most:
            return steps


def main(env_id: str, seconds: float, most: int) -> dict[str, float]:
    """Plays episodes until `seconds` have gone by, at least two and at most `most`."""
    from evopolicy_common import catalogue

    env = make_of(env_id)
    # Of a page, which alone may go on for long, a slot plays no more either.
    limit = catalogue.entry(env_id).max_episode_steps if env_id.startswith(WEB_PAGES) else math.inf
    play(env, 1, limit)
    started = time.perf_counter()
    steps = episodes = 0
    for seed in seeds(most):
        steps += play(env, seed, limit)
        episodes += 1
        if time.perf_counter() - started > seconds and episodes >= 2:
            break
    found = {"episodes": episodes, "steps": steps, "seconds": time.perf_counter() - started}
    return found | (pace(env) if env_id.startswith(WEB_PAGES) else {})


if __name__ == "__main__":
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
    print(json.dumps(main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))))
