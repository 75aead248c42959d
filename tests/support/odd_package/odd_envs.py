"""Environments that do odd things, each once it has been made or stepped, as a package that Gymnasium imports by
name."""

from __future__ import annotations

import ctypes
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

KEPT: list[Any] = []


class Odd(gymnasium.Env[Any, Any]):
    """Does one odd thing in each step, or in `reset`; otherwise it is sound."""

    observation_space = spaces.Box(0.0, 1.0, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, does: str = "nothing", size: int = 1) -> None:
        self.does = does
        self.size = size
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        if self.does == "hang in reset":
            time.sleep(3600)
        if self.does == "legacy":
            return np.zeros(1)
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        obs = DOES[self.does](self)
        reward: Any = "1.0" if self.does == "text reward" else 1.0
        return np.zeros(1) if obs is None else obs, reward, False, False, {}


def crash_in_step_12(env: Odd) -> None:
    if env.steps == 12:
        raise ValueError("fell off the table")


def connect(env: Odd) -> None:
    socket.create_connection(("203.0.113.1", 80), timeout=5).close()


DOES: dict[str, Callable[[Odd], Any]] = {
    "nothing": lambda env: None,
    "hang in reset": lambda env: None,
    "legacy": lambda env: None,
    "text reward": lambda env: None,
    "hang in step": lambda env: time.sleep(3600),
    "grow": lambda env: KEPT.append(np.ones(16 << 20)),
    "threads": lambda env: threading.Thread(target=time.sleep, args=(3600,), daemon=True).start(),
    "write a file": lambda env: Path("notes.txt").write_text("x") and None,
    "read a file": lambda env: Path(__file__).with_name("levels.dat").read_text(),
    "connect": connect,
    "rounding": lambda env: np.full(1, 1.0000000000000002),
    "beyond": lambda env: np.full(1, 1.1),
    "segfault": lambda env: ctypes.string_at(0),
    "crash": crash_in_step_12,
}


class Grumbles(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that raises."""

    def step(self, action: Any) -> Any:
        raise LookupError("no such tile")


class Vectors(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Comes as a vector of environments only."""


gymnasium.register("Odd-v0", entry_point=f"{__name__}:Odd", max_episode_steps=20)
gymnasium.register("CartPole-v1", entry_point=f"{__name__}:Odd", max_episode_steps=20)
gymnasium.register("Vectors-v0", vector_entry_point=f"{__name__}:Vectors")
