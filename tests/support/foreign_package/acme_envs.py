"""Environments of somebody else's, as a package that Gymnasium imports by name: a good one, one with every space, and bad ones."""

from __future__ import annotations

import os
import sys
import threading
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class Glider(gymnasium.Env[Any, Any]):
    """A point is steered to the origin.

    The action pushes it; the nearer it is, the less it costs.
    """

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = spaces.Box(-10.0, 10.0, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, push: float = 0.2, render_mode: str | None = None) -> None:
        self.push = push
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1.0, 1.0, 2)
        return self.state.astype(np.float32), {}

    def step(self, action: Any) -> Any:
        x, v = self.state
        v = 0.8 * v + self.push * float(action[0])
        self.state = np.clip((x + v, v), -10.0, 10.0)
        near = abs(self.state[0]) < 0.1
        return self.state.astype(np.float32), -abs(float(self.state[0])), False, False, {"near": bool(near)}

    def render(self) -> Any:
        frame = np.full((48, 64, 3), 255, np.uint8)
        frame[20:28, int(np.clip(32 + 20 * self.state[0], 0, 60)) :][:, :4] = 0
        return frame


INNER = spaces.Dict({"place": spaces.Box(0, 9, (2,), np.int64), "name": spaces.Text(4, charset="ab")})
EVERYTHING = spaces.Dict(
    {
        "box16": spaces.Box(-1.0, 1.0, (2, 2), np.float16),
        "whole": spaces.Box(-5, 5, (3,), np.int32),
        "flags": spaces.Box(0, 1, (2,), np.bool_),
        "from_two": spaces.Discrete(3, start=2),
        "many": spaces.MultiDiscrete([2, 5], start=[1, -1]),
        "bits": spaces.MultiBinary([2, 2]),
        "both": spaces.Tuple([spaces.Discrete(2), spaces.Text(3)]),
        "items": spaces.Sequence(INNER),
        "stack": spaces.Sequence(spaces.Box(0.0, 1.0, (2,), np.float32), stack=True),
        "graph": spaces.Graph(spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Discrete(4)),
        "bare_graph": spaces.Graph(spaces.Discrete(3), None),
        "either": spaces.OneOf([spaces.Discrete(4), spaces.Box(0.0, 1.0, (2,), np.float64)]),
    }
)


class Everything(gymnasium.Env[Any, Any]):
    """Observes and takes values of every kind of space; tells whether an action was in its space."""

    observation_space = EVERYTHING
    action_space = EVERYTHING

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        inside = self.action_space.contains(action)
        return self.observation_space.sample(), float(inside), False, False, {"inside": inside}


class Treasure(Glider):
    """Rewards are a vector."""

    reward_space = spaces.Box(-100.0, 100.0, (2,), np.float32)

    def step(self, action: Any) -> Any:
        obs, reward, _, _, info = super().step(action)
        vector = np.array([reward, -abs(float(action[0]))], dtype=np.float32)
        return obs, vector, info["near"], False, {"is_success": info["near"]}


class Bad(Glider):
    """Misbehaves as it is told to."""

    def __init__(self, how: str, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.how = how
        if how == "custom space":
            self.observation_space = Opaque()  # type: ignore[assignment]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if self.how == "raise in reset":
            raise RuntimeError("no level of that seed")
        if self.how == "change spaces":
            self.observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
            return np.zeros(3, np.float32), {}
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        if self.how == "nan":
            reward = float("nan")
        elif self.how == "outside":
            obs = obs + 100.0
        elif self.how == "shape":
            obs = np.zeros(3, np.float32)
        elif self.how == "print":
            print("x" * 1000)
            sys.stdout.flush()
            os.write(1, b"y" * 1000)
        elif self.how == "threads":
            threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()
        elif self.how == "exit":
            os._exit(3)
        elif self.how == "hang":
            time.sleep(3600)
        return obs, reward, terminated, truncated, info


class Keeper(Glider):
    """Keeps how many episodes it has begun, in memory and in a file, and rewards each step by that."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        notes = os.path.join(os.environ["HOME"], "notes")
        with open(notes, "a") as file:
            file.write("x")
        COUNTED.append(1)
        self.kept = float(max(os.path.getsize(notes), len(COUNTED)))
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        obs, _, _, truncated, info = super().step(action)
        return obs, self.kept, True, truncated, info


COUNTED: list[int] = []


class Opaque(gymnasium.Space[Any]):
    """Of a kind that nobody knows."""

    def __init__(self) -> None:
        super().__init__((), None)


for name, cls, limit in (
    ("Glider", Glider, 20),
    ("Everything", Everything, 5),
    ("Treasure", Treasure, 20),
    ("Bad", Bad, 8),
    ("Keeper", Keeper, 8),
    ("Keeper", Keeper, 8),
):
    gymnasium.register(f"{name}-v0", entry_point=f"{__name__}:{cls.__name__}", max_episode_steps=limit)
gymnasium.register("Endless-v0", entry_point=f"{__name__}:Glider")
