"""Where a step's time goes: `python tests/bench/step_profile.py [ENV…]`. Prints µs per step, asserts nothing.

`--limit ENV N` prints JSON, `{"limit_s": …}`: the time of N episodes of the bench with accelerations, adapter, the
slot's recording, a byte to another process and back at each step, and one fork and exit of a Python with numpy for each
episode. No slot that starts a process for each policy, and leaves the core to it at each step, takes less.

One episode of zero actions each way, accelerations off, pinned to one core, the best of three:
- bare: `env.step` alone.
- adapter: our adapter, which copies the observation and keeps the plain part of `info`.
- recorded: and the action checked, the row kept, the feedback packed at the end.
- switched: and a byte to another process and back, before every step: what leaving the core for a moment costs this
  simulator. Beside it the same round trip with nothing around it.
- slot: the whole, with a sandboxed policy; its start and end are in it.
"""

from __future__ import annotations

import asyncio
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from bare_loop import POLICY, make, seeds
from rich.console import Console
from rich.table import Table
from runtime_bench import ACCELERATIONS, jobs, pipe_round_trip_s

from evopolicy_common import catalogue
from evopolicy_common.messages.environment import Case
from evopolicy_common.records.episodes.rendered import Renderer
from evopolicy_worker import environments
from evopolicy_worker.environments.checks.costs import literal
from evopolicy_worker.environments.interface import settings
from evopolicy_worker.slots.slot import Slot

(SEED,) = seeds(1)
ENVIRONMENTS = ("gym/acrobot", "gym/halfcheetah5", "gym/ant5", "gymnasium/MiniGrid-FourRooms-v0")


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


def bare(env: Any, action: Any) -> tuple[int, float]:
    """Steps of one episode, and its seconds without the reset."""
    env.reset(seed=SEED)
    started, n = time.perf_counter(), 0
    while True:
        n += 1
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            return n, time.perf_counter() - started


def recorder_of(env: environments.Environment) -> Renderer:
    """As a slot makes it for a train episode."""
    return Renderer("arrays", env.description.obs_storage)


def adapted(
    env: environments.Environment,
    action: Any,
    recorder: Renderer | None,
    before: Callable[[], None],
    seed: int = SEED,
) -> float:
    """Seconds of one episode through the adapter, without the reset."""
    obs = env.reset(Case(seed=seed))
    repair = env.action_codec.repair
    started = time.perf_counter()
    while True:
        before()
        repaired, _ = repair(action)
        following, reward, terminated, truncated, info = env.step(repaired)
        if recorder is not None:
            recorder.append(obs, action, reward, terminated, truncated, info)
        obs = following
        if terminated or truncated:
            break
    if recorder is not None:
        recorder.finish()
    return time.perf_counter() - started


async def through_slot(env: str, folder: Path) -> float:
    """Seconds of one warm episode in a slot, its policy's start and end included."""
    bundle = folder / "bundle"
    bundle.mkdir()
    (bundle / "policy.py").write_text(POLICY)
    core = sorted(os.sched_getaffinity(0))[0]
    slot = Slot(core, "bwrap", folder / "slot")
    await slot.start()
    try:
        (job,) = jobs(env, 1)
        best = float("inf")
        # What the first one does is not done again: the slot makes its environment.
        for _ in range(4):
            started = time.perf_counter()
            await slot.play(job, bundle, lambda episodes, steps: None)
            best = min(best, time.perf_counter() - started)
        return best
    finally:
        await slot.close()


def profile(env_id: str, call: Callable[[], None]) -> list[float]:
    """µs per step: bare, adapter, recorded, switched, slot."""
    entry = catalogue.entry(env_id)
    assert entry.gymnasium_id is not None
    env, own = make(entry.gymnasium_id), environments.make(env_id)
    space = env.action_space
    discrete = not hasattr(space, "high")
    action: Any = 0 if discrete else np.zeros(space.shape, dtype=space.dtype)
    given: Any = 0 if discrete else [0.0] * space.shape[0]
    n = bare(env, action)[0]
    ways: list[Callable[[], float]] = [
        lambda: bare(env, action)[1],
        lambda: adapted(own, given, None, lambda: None),
        lambda: adapted(own, given, recorder_of(own), lambda: None),
        lambda: adapted(own, given, recorder_of(own), call),
    ]
    seconds = [min(way() for _ in range(3)) for way in ways]
    with tempfile.TemporaryDirectory(prefix="evopolicy-profile-") as folder:
        seconds.append(asyncio.run(through_slot(env_id, Path(folder))))
    return [one / n * 1e6 for one in seconds]


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
    adapted(env, action, recorder_of(env), call, seed=1)
    started = time.perf_counter()
    for seed in seeds(n):
        adapted(env, action, recorder_of(env), call, seed=seed)
    return time.perf_counter() - started + n * fork


def main() -> None:
    if sys.argv[1:2] == ["--limit"]:
        os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
        print(json.dumps({"limit_s": limit(sys.argv[2], int(sys.argv[3]))}))
        return
    os.environ[ACCELERATIONS] = "off"
    settings.apply()
    round_trip_us = pipe_round_trip_s() * 1e6
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
    call = echo()
    table = Table(title=f"µs per step; a pipe round trip with nothing around it: {round_trip_us:.1f}")
    for column in ("environment", "bare", "adapter", "recorded", "switched", "slot"):
        table.add_column(column, justify="left" if column == "environment" else "right")
    for env_id in sys.argv[1:] or ENVIRONMENTS:
        table.add_row(env_id, *(f"{value:.1f}" for value in profile(env_id, call)))
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
