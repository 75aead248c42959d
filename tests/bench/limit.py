"""The least time of N episodes of the bench in any slot that gives each policy a process: `python limit.py ENV N`.

Prints JSON, `{"limit_s": …}`: the time of the episodes with accelerations, adapter, the slot's recording, a byte to
another process on this core and back at each step, and one fork and exit of a Python with numpy for each episode.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

from bare_loop import seeds

from evopolicy_common.messages.environment import Case
from evopolicy_common.records.episodes.rendered import Renderer
from evopolicy_worker import environments
from evopolicy_worker.check_env import literal


def echo() -> Callable[[], None]:
    """A call that wakes another process on this core and waits for its answer."""
    to_child, from_parent = os.pipe()
    to_parent, from_child = os.pipe()
    if os.fork() == 0:
        os.close(from_parent)
        while byte := os.read(to_child, 1):
            os.write(from_child, byte)
        os._exit(0)
    os.close(to_child)

    def call() -> None:
        os.write(from_parent, b"x")
        os.read(to_parent, 1)

    return call


def adapted(env: environments.Environment, action: Any, call: Callable[[], None], seed: int) -> None:
    """One episode through the adapter, recorded as a slot does it for a train episode."""
    recorder = Renderer("arrays", env.description.obs_storage)
    obs = env.reset(Case(seed=seed))
    terminated = truncated = False
    while not (terminated or truncated):
        call()
        repaired, _ = env.action_codec.repair(action)
        following, reward, terminated, truncated, info = env.step(repaired)
        recorder.append(obs, action, reward, terminated, truncated, info)
        obs = following
    recorder.finish()


def fork_s(n: int = 100) -> float:
    """Median seconds for the fork of this process and its child's exit."""
    times = []
    for _ in range(n):
        started = time.perf_counter()
        if (pid := os.fork()) == 0:
            os._exit(0)
        os.waitpid(pid, 0)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def limit(env_id: str, n: int) -> float:
    """Seconds of `n` episodes; see above."""
    # Before a simulator is loaded: a policy's process has none.
    fork = fork_s()
    env = environments.make(env_id, accelerations=True)
    action, call = literal(env.action_codec.neutral()), echo()
    # The first episode makes what later ones find.
    adapted(env, action, call, seed=1)
    started = time.perf_counter()
    for seed in seeds(n):
        adapted(env, action, call, seed=seed)
    return time.perf_counter() - started + n * fork


if __name__ == "__main__":
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
    print(json.dumps({"limit_s": limit(sys.argv[1], int(sys.argv[2]))}))
