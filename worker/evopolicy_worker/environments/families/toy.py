"""Two environments without a simulator, a few microseconds a step: for tests, demos and for measuring the cluster.

`toy/line` is continuous with a shaped reward, which a linear policy solves; `toy/maze` has a mixed observation, and
every step costs, so that ending early would pay if it were allowed to.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import Case, EnvironmentDescription, SpaceSchema
from evopolicy_worker.environments.interface.actions import compile_actions
from evopolicy_worker.environments.interface.base import Environment, Frame, Observation, Step
from evopolicy_worker.environments.interface.fingerprint import adapter, versions
from evopolicy_worker.environments.tasks import written


class _Toy(Environment):
    """The shared part of both environments: their description, and images only on request."""

    components: Mapping[str, str] = {}
    """Parts of the reward, with what each stands for."""

    def __init__(self, entry: Entry, *, render: bool) -> None:
        obs_space, action_space = self.spaces(entry)
        self.description = EnvironmentDescription(
            env=entry.id,
            env_version=f"{entry.id} (evopolicy, version 1)",
            obs_space=obs_space,
            action_space=action_space,
            max_episode_steps=entry.max_episode_steps,
            reward_components=tuple(self.components),
            reward_texts=dict(self.components),
            task_text=written(entry.id) or "",
            renders=True,
            adapter=adapter(type(self), 1, ""),
            packages=versions(("numpy",)),
        )
        self.action_codec = compile_actions(action_space)
        self._limit = entry.max_episode_steps
        self._steps = 0
        self._renders = render

    def render(self) -> Frame:
        return self._draw() if self._renders else super().render()

    @abstractmethod
    def spaces(self, entry: Entry) -> tuple[SpaceSchema, SpaceSchema]:
        """Of observations and of actions."""

    @abstractmethod
    def _draw(self) -> Frame:
        """The present state as a picture."""

    def close(self) -> None:
        pass


class MassOnLine(_Toy):
    """A mass on a line is pushed to a target that moves slowly back and forth.

    State: position x, velocity v, target g = centre + 0.3 sin(phase + 0.1 t), t in steps. One step with push a:
    v ← 0.9 v + 0.1 a; x ← x + v, held within ±2 (then v = 0).
    """

    PUSH_GAIN = 0.1
    DRAG = 0.9
    WALL = 2.0
    TARGET_SWING = 0.3
    TARGET_RATE = 0.1
    EFFORT_COST = 0.01

    components = {
        "reward_distance": "cost of the distance from the target",
        "reward_effort": "cost of pushing",
    }

    def spaces(self, entry: Entry) -> tuple[SpaceSchema, SpaceSchema]:
        high, box = [2.0, 1.0, 1.5], {"type": "Box", "dtype": "float32"}
        seen = {**box, "shape": [3], "low": [-each for each in high], "high": high}
        return seen, {**box, "shape": [1], "low": [-1.0], "high": [1.0]}

    def reset(self, case: Case) -> Observation:
        rng = np.random.default_rng(case.seed)
        self._x = float(rng.uniform(-1.0, 1.0))
        self._centre = float(rng.uniform(-1.0, 1.0))
        self._phase = float(rng.uniform(0.0, 2.0 * np.pi))
        self._v = 0.0
        self._steps = 0
        return self._observe()

    def step(self, action: Any) -> Step:
        push = float(action[0])
        self._v = self.DRAG * self._v + self.PUSH_GAIN * push
        self._x += self._v
        if not -self.WALL <= self._x <= self.WALL:
            self._x = max(-self.WALL, min(self.WALL, self._x))
            self._v = 0.0
        self._steps += 1
        distance = -abs(self._x - self._target())
        effort = -self.EFFORT_COST * push * push
        info = {"reward_distance": distance, "reward_effort": effort, "steps": self._steps}
        return Step(self._observe(), distance + effort, False, self._steps >= self._limit, info)

    def _target(self) -> float:
        return self._centre + self.TARGET_SWING * math.sin(self._phase + self.TARGET_RATE * self._steps)

    def _observe(self) -> Observation:
        return np.array((self._x, self._v, self._target()), dtype=np.float32)

    def _draw(self) -> Frame:
        frame = np.full((32, 256, 3), 255, dtype=np.uint8)
        for value, colour in ((self._target(), (40, 160, 40)), (self._x, (200, 30, 30))):
            column = round((value + self.WALL) / (2 * self.WALL) * 247)
            frame[8:24, column : column + 8] = colour
        return frame


class Maze(_Toy):
    """A walker in a 9 × 9 grid with random walls searches the exit; each step costs one."""

    SIZE = 9
    WALL_SHARE = 0.25
    FREE, WALL, EXIT = 0, 1, 2
    MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
    """Row and column steps of north, east, south, west: the four actions."""
    MIN_PATH = 4
    """Shortest way from start to exit, in steps, at least."""

    def spaces(self, entry: Entry) -> tuple[SpaceSchema, SpaceSchema]:
        bounds = {"low": [[0] * 5] * 5, "high": [[2] * 5] * 5}
        parts: SpaceSchema = {
            "blocked": {"type": "MultiBinary", "n": 4},
            "compass": {"type": "Text", "min_length": 4, "max_length": 9},
            "position": {"type": "MultiDiscrete", "nvec": [self.SIZE, self.SIZE]},
            "steps": {"type": "Discrete", "n": entry.max_episode_steps + 1},
            "view": {"type": "Box", "shape": [5, 5], "dtype": "uint8", **bounds},
        }
        return {"type": "Dict", "spaces": parts}, {"type": "Discrete", "n": 4}

    def reset(self, case: Case) -> Observation:
        rng, inner = np.random.default_rng(case.seed), self.SIZE - 2
        while True:
            # A border two cells wide, so that the 5 × 5 view never leaves the array.
            grid = np.full((self.SIZE + 2, self.SIZE + 2), self.WALL, dtype=np.uint8)
            grid[2:-2, 2:-2] = rng.random((inner, inner)) < self.WALL_SHARE
            row, column, *ends = (int(k) + 2 for k in rng.integers(inner, size=4))
            grid[row, column], grid[tuple(ends)] = self.FREE, self.EXIT
            if self._path(grid, (row, column), (ends[0], ends[1])) >= self.MIN_PATH:
                break
        self._grid, self._row, self._column = grid, row, column
        self._exit, self._steps = (ends[0], ends[1]), 0
        return self._observe()

    def step(self, action: Any) -> Step:
        down, right = self.MOVES[action]
        bumped = self._grid[self._row + down, self._column + right] == self.WALL
        if not bumped:
            self._row += down
            self._column += right
        self._steps += 1
        reached = (self._row, self._column) == self._exit
        info = {"bumped": bool(bumped), "steps": self._steps}
        return Step(self._observe(), -1.0, reached, self._steps >= self._limit, info)

    @classmethod
    def _path(cls, grid: np.ndarray[Any, Any], start: tuple[int, int], end: tuple[int, int]) -> int:
        """Steps of the shortest way, −1 when there is none."""
        lengths = {start: 0}
        queue = deque([start])
        while queue:
            row, column = here = queue.popleft()
            if here == end:
                return lengths[here]
            for down, right in cls.MOVES:
                there = (row + down, column + right)
                if there not in lengths and grid[there] != cls.WALL:
                    lengths[there] = lengths[here] + 1
                    queue.append(there)
        return -1

    def _observe(self) -> Observation:
        row, column = self._row, self._column
        down, right = self._exit[0] - row, self._exit[1] - column
        vertical = "north" if down < 0 else "south" if down > 0 else ""
        horizontal = "west" if right < 0 else "east" if right > 0 else ""
        grid = self._grid
        around = [grid[row + step_down, column + step_right] for step_down, step_right in self.MOVES]
        return {
            "blocked": np.array([each == self.WALL for each in around], dtype=np.int8),
            "compass": vertical + horizontal or "here",
            "position": np.array((row - 1, column - 1), dtype=np.int64),
            "steps": self._steps,
            "view": grid[row - 2 : row + 3, column - 2 : column + 3].copy(),
        }

    def _draw(self) -> Frame:
        colours = np.array([(255, 255, 255), (60, 60, 60), (40, 160, 40)], dtype=np.uint8)
        cells = colours[self._grid[1:-1, 1:-1]]
        cells[self._row - 1, self._column - 1] = (200, 30, 30)
        return np.ascontiguousarray(cells.repeat(16, axis=0).repeat(16, axis=1))
