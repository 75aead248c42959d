"""Drivers for comparing accelerated environments with plain ones: random, and good enough to get somewhere.

Random actions see little of an environment: a random car leaves the road, a random walker never finds the key. The
competent drivers look into the plain simulator for what they want to know. Both draw from a generator of the case's
seed, and now and then the competent ones act at random too.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from evopolicy_worker.environments import Environment

Driver = Callable[[Any], Any]
"""From an observation to an action."""


_LEFT, _RIGHT, _FORWARD, _PICKUP, _DROP, _TOGGLE = range(6)
"""MiniGrid's actions."""
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Its directions."""


def random_driver(environment: Environment, seed: int) -> Driver:
    rng = np.random.default_rng(seed)
    return lambda obs: environment.action_codec.sample(rng)


def competent_driver(environment: Environment, seed: int) -> Driver:
    rng = np.random.default_rng(seed)
    simulator: Any = environment.bare.unwrapped  # type: ignore[attr-defined]
    env_id = environment.description.env
    if env_id == "gym/racing":
        return lambda obs: _race(simulator, rng)
    if "parking" in env_id:
        return _park
    if env_id == "gymnasium/roundabout-v0":
        return lambda obs: _give_way(obs, rng)
    if hasattr(simulator, "road"):
        return lambda obs: _cruise(environment.action_codec.sample(rng), rng)
    if "MiniGrid" in env_id:
        return lambda obs: _explore(simulator, rng)
    if env_id == "gym/acrobot":
        return lambda obs: _swing_up(obs, rng)
    if hasattr(simulator, "data"):
        return _rhythm(environment.action_codec.neutral(), rng)
    raise KeyError(f"no driver for {env_id}")


def _swing_up(obs: Any, rng: np.random.Generator) -> int:
    """Pushes the second link the way that the first one swings."""
    return int(rng.integers(3)) if rng.random() < 0.05 else 2 if obs[4] < 0 else 0


def _rhythm(rest: Any, rng: np.random.Generator) -> Driver:
    """Torques that swing, each joint at its own pace: a gait that gets somewhere, or falls over."""
    size, pace, phase = (rng.uniform(0, high, size=rest.shape) for high in (1.5, 1.0, 6.3))
    moments = itertools.count()
    return lambda obs: (size * np.sin(pace * next(moments) + phase)).astype(rest.dtype)


def _race(simulator: Any, rng: np.random.Generator) -> Any:
    """Towards a point of the track some tiles ahead, slower before bends."""
    hull = simulator.car.hull
    x, y = hull.position
    track = np.array([tile[2:4] for tile in simulator.track])
    nearest = int(np.argmin(((track - (x, y)) ** 2).sum(axis=1)))

    def bearing(ahead: int) -> float:
        goal_x, goal_y = track[(nearest + ahead) % len(track)]
        off = math.atan2(goal_y - y, goal_x - x) - (hull.angle + math.pi / 2)
        return (off + math.pi) % (2 * math.pi) - math.pi

    speed = math.hypot(*hull.linearVelocity)
    wanted = max(70.0 - 60.0 * abs(bearing(12)), 20.0)
    steer = float(np.clip(-1.6 * bearing(4) + rng.normal(0, 0.03), -1, 1))
    gas, brake = (0.6, 0.0) if speed < wanted else (0.0, 0.3 if speed > wanted + 10 else 0.0)
    return np.array([steer, gas, brake], dtype=np.float32)


def _park(obs: Any) -> Any:
    """Towards the goal, forwards or backwards, slower as it comes near."""
    scales = np.array([100, 100, 5, 5, 1, 1])
    x, y, vx, vy, cos, sin = obs["achieved_goal"] * scales
    goal_x, goal_y, *_ = obs["desired_goal"] * scales
    ahead = (goal_x - x) * cos + (goal_y - y) * sin
    aside = (goal_y - y) * cos - (goal_x - x) * sin
    distance = math.hypot(ahead, aside)
    way = 1.0 if ahead >= 0 else -1.0
    speed = vx * cos + vy * sin
    wanted = way * min(4.0, 0.5 * distance)
    steer = math.atan2(aside * way, abs(ahead)) / (math.pi / 4) * 1.5 * way
    return np.clip(np.array([(wanted - speed) / 2, steer]), -1, 1).astype(np.float32)


def _give_way(obs: Any, rng: np.random.Generator) -> int:
    """Fast, unless another vehicle is close in front; changes lanes now and then."""
    if rng.random() < 0.2:
        return int(rng.integers(5))
    x, y, vx, vy = obs[0, 1:] * (100, 100, 15, 15)
    for present, other_x, other_y, _, _ in obs[1:] * (1, 100, 100, 1, 1):
        dx, dy = other_x - x, other_y - y
        if present and math.hypot(dx, dy) < 20 and dx * vx + dy * vy > 0:
            return 4
    return 3


def _cruise(drawn: Any, rng: np.random.Generator) -> Any:
    """Straight on, mostly; continuous actions are small, so that the car stays on the road."""
    if isinstance(drawn, tuple):
        return tuple(_cruise(each, rng) for each in drawn)
    if isinstance(drawn, int | np.integer):
        return drawn if rng.random() < 0.3 else 1
    return (0.2 * drawn).astype(drawn.dtype)


def _explore(simulator: Any, rng: np.random.Generator) -> int:
    """To the nearest thing that can be used and is reachable, balls last; uses it."""
    if rng.random() < 0.05:
        return int(rng.integers(7))
    carrying = simulator.carrying
    locked = {
        cell.color
        for cell in simulator.grid.grid
        if cell is not None and cell.type == "door" and cell.is_locked
    }
    if carrying is not None and not (carrying.type == "key" and carrying.color in locked):
        return _DROP if rng.random() < 0.2 else int(rng.integers(3))
    if _blocked(simulator.grid):
        locked = set() if carrying is None else locked
    for balls in (carrying is None and not locked, True):
        action = _towards(simulator, locked, balls)
        if action is not None:
            return action
    return _DROP if carrying is not None and rng.random() < 0.1 else int(rng.integers(3))


def _blocked(grid: Any) -> bool:
    """Whether a ball lies before a locked door: it must be carried away before the key is of use."""
    for place, cell in enumerate(grid.grid):
        if cell is not None and cell.type == "door" and cell.is_locked:
            for offset in (1, -1, grid.width, -grid.width):
                beside = grid.grid[place + offset]
                if beside is not None and beside.type == "ball":
                    return True
    return False


def _towards(simulator: Any, locked: set[str], balls: bool) -> int | None:
    """The next action on the shortest way to something of use; None when there is no such way."""
    start = (int(simulator.agent_pos[0]), int(simulator.agent_pos[1]))
    before: dict[tuple[int, int], tuple[int, int]] = {start: start}
    queue = deque([start])
    while queue:
        here = queue.popleft()
        for dx, dy in _SIDES:
            there = (here[0] + dx, here[1] + dy)
            if there in before:
                continue
            cell = simulator.grid.get(*there)
            use = _use(cell, simulator.carrying, locked, balls) if cell is not None else None
            if use is None:
                if cell is None or cell.can_overlap():
                    before[there] = here
                    queue.append(there)
                continue
            before[there] = here
            step = there
            while before[step] != start:
                step = before[step]
            facing = _SIDES.index((step[0] - start[0], step[1] - start[1]))
            if facing != simulator.agent_dir:
                return _LEFT if (simulator.agent_dir - facing) % 4 == 1 else _RIGHT
            return use if step == there else _FORWARD
    return None


def _use(cell: Any, carrying: Any, locked: set[str], balls: bool) -> int | None:
    """The action that uses the thing in front, if there is one."""
    if cell.type == "goal":
        return _FORWARD
    if cell.type == "box":
        return _TOGGLE
    if carrying is None and (
        (cell.type == "key" and cell.color in locked) or (cell.type == "ball" and balls)
    ):
        return _PICKUP
    if cell.type == "door" and not cell.is_open:
        unlocks = carrying is not None and carrying.type == "key" and carrying.color == cell.color
        return _TOGGLE if unlocks or not cell.is_locked else None
    return None
