"""The comparison of accelerated environments with plain ones; also a program, for as many seeds as one has time for.

`python acceleration_checks.py --seeds 128 [ID …]` plays whole episodes of every accelerated environment, half of the
seeds with random actions and half with a competent driver, on an accelerated and a plain environment side by side, and
compares every bit of observation, reward, flags and info of every step, and of the state of the simulator. It says how
many steps were compared and the ratio of the times they took, and ends with code 1 at the first difference.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from acceleration_drivers import Driver, competent_driver, random_driver
from environment_checks import IDS, value_digest
from gymnasium.envs.box2d.car_racing import PLAYFIELD
from gymnasium.envs.classic_control.acrobot import AcrobotEnv

from evopolicy_common.catalogue import entries
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import Environment, make
from evopolicy_worker.environments.accelerations import table

ANEW = 8
DriverFactory = Callable[[Environment, int], Driver]


class DifferenceError(AssertionError):
    """An accelerated environment did not play as the plain one."""


@dataclass
class Comparison:
    """What was compared, and the processor time of all steps, seconds."""

    steps: int = 0
    episodes: int = 0
    plain_s: float = 0.0
    accelerated_s: float = 0.0
    returns: float = 0.0


def accelerated_ids() -> list[str]:
    """Suite ids of the environments that have accelerations, in catalogue order."""
    served = set(itertools.chain.from_iterable(one.gymnasium_ids for one in table.ACCELERATIONS))
    wanted = [entry for entry in entries().values() if entry.id in IDS or entry.adapter == "highway"]
    return [entry.id for entry in wanted if entry.gymnasium_id in served and not entry.world]


def compare(
    env_id: str, seeds: Iterable[int], factory: DriverFactory, *, steps: int | None = None
) -> Comparison:
    """Play the cases on an accelerated environment, reused from case to case, and on a plain one, made anew for
    every `ANEW`-th; DifferenceError at the first difference."""
    accelerated, plain = make(env_id, accelerations=True), make(env_id, accelerations=False)
    done = Comparison()
    try:
        for seed in seeds:
            if done.episodes and done.episodes % ANEW == 0:
                plain.close()
                plain = make(env_id, accelerations=False)
            obs = plain.reset(Case(seed=seed))
            if value_digest(accelerated.reset(Case(seed=seed))) != value_digest(obs):
                raise DifferenceError(f"{env_id}, seed {seed}: first observation")
            driver = factory(plain, seed)
            done.episodes += 1
            for index in range(steps or plain.description.max_episode_steps):
                action = driver(obs)
                started = time.process_time()
                expected = plain.step(action)
                between = time.process_time()
                found = accelerated.step(action)
                done.accelerated_s += time.process_time() - between
                done.plain_s += between - started
                done.steps += 1
                done.returns += expected.reward
                if value_digest(_state(accelerated)) != value_digest(_state(plain)):
                    raise DifferenceError(f"{env_id}, seed {seed}, step {index}: state of the simulator")
                if value_digest(tuple(found)) != value_digest(tuple(expected)):
                    raise DifferenceError(f"{env_id}, seed {seed}, step {index}: {_parts(found, expected)}")
                obs = expected.obs
                if expected.terminated or expected.truncated:
                    break
    finally:
        accelerated.close()
        plain.close()
    return done


def compare_car_pictures(seed: int, count: int) -> None:
    """Observations of a car that is put anywhere, at any angle, speed and moment; DifferenceError at a difference."""
    accelerated, plain = make("gym/racing", accelerations=True), make("gym/racing", accelerations=False)
    rng = np.random.default_rng(seed)
    accelerated.reset(Case(seed=seed))
    plain.reset(Case(seed=seed))
    simulators: list[Any] = [environment.bare.unwrapped for environment in (accelerated, plain)]  # type: ignore[attr-defined]
    for index in range(count):
        tile = simulators[1].track[rng.integers(len(simulators[1].track))]
        near = np.array(tile[2:4]) + rng.normal(0, 12, size=2)
        x, y = near if rng.random() < 0.7 else rng.uniform(-1.1 * PLAYFIELD, 1.1 * PLAYFIELD, size=2)
        angle = rng.uniform(-7, 7) if rng.random() < 0.8 else math.pi / 2 * rng.integers(-4, 5)
        moment = rng.uniform(0, 1.5) if rng.random() < 0.5 else 20.0
        velocity, spin = rng.normal(0, 60, size=2), rng.normal(0, 3)
        wheels, score = rng.normal(0, 150, size=4), rng.normal(0, 800)
        pictures = []
        for simulator in simulators:
            hull = simulator.car.hull
            hull.position, hull.angle = (float(x), float(y)), float(angle)
            hull.linearVelocity, hull.angularVelocity = tuple(velocity.tolist()), float(spin)
            for wheel, omega in zip(simulator.car.wheels, wheels.tolist(), strict=True):
                wheel.omega = omega
            simulator.t, simulator.reward = float(moment), float(score)
            pictures.append(np.ascontiguousarray(simulator._render("state_pixels")).tobytes())
        if pictures[0] != pictures[1]:
            raise DifferenceError(
                f"seed {seed}, picture {index}: car at ({x}, {y}), angle {angle}, {moment} s"
            )
    accelerated.close()
    plain.close()


def _state(environment: Any) -> list[Any]:
    """What moves in the simulator, in its own precision: observations are rounded."""
    simulator = environment.bare.unwrapped
    if hasattr(simulator, "road") and hasattr(simulator.road, "vehicles"):
        return [
            (vehicle.position, float(vehicle.heading), float(vehicle.speed), repr(vehicle.lane_index))
            for vehicle in simulator.road.vehicles
        ]
    if hasattr(simulator, "car"):
        hull = simulator.car.hull
        return [(*hull.position, hull.angle, *hull.linearVelocity, hull.angularVelocity), simulator.reward]
    if hasattr(simulator, "data"):
        data = simulator.data
        return [data.qpos, data.qvel, data.qacc, data.qacc_warmstart, data.xpos, data.ctrl, data.time]
    if isinstance(simulator, AcrobotEnv):
        return [float(value) for value in simulator.state]  # type: ignore[attr-defined]
    return [simulator.grid.encode(), [int(place) for place in simulator.agent_pos]]


def _parts(found: Any, expected: Any) -> str:
    names = [
        name
        for name in found._fields
        if value_digest(getattr(found, name)) != value_digest(getattr(expected, name))
    ]
    return ", ".join(names)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=accelerated_ids())
    parser.add_argument("--seeds", type=int, default=128, help="seeds per environment, half for each driver")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--pictures", type=int, default=0, help="pictures of a car put anywhere, per seed")
    parser.add_argument("--steps", type=int, help="at most so many steps of an episode")
    options = parser.parse_args()
    if options.pictures:
        for seed in range(options.first, options.first + options.seeds):
            compare_car_pictures(seed, options.pictures)
        print(f"same  {options.seeds * options.pictures} pictures of a car put anywhere")
        return 0
    for env_id in options.ids:
        half = options.seeds // 2
        for name, factory, first in (
            ("random", random_driver, options.first),
            ("competent", competent_driver, options.first + half),
        ):
            try:
                done = compare(env_id, range(first, first + half), factory, steps=options.steps)
            except DifferenceError as difference:
                print(f"DIFFERENT {name}: {difference}", flush=True)
                return 1
            print(
                f"same  {env_id:42} {name:9} {done.episodes:4} episodes {done.steps:7} steps, "
                f"mean return {done.returns / done.episodes:8.2f}, {done.plain_s / done.accelerated_s:5.2f} x",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
