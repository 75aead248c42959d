"""Environments that do what environments of others do: some honestly, some by mistake, and some to deceive."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class Plain(gymnasium.Env[Any, Any]):
    """Adds its actions up: the sum is the observation, and the action the reward."""

    observation_space: Any = spaces.Box(-100.0, 100.0, (1,), np.float32)
    action_space: Any = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32)
        return self.place, {}

    def step(self, action: Any) -> Any:
        self.place = self.place + action
        return self.place, float(action[0]), False, False, {}


class ChangesItsAction(Plain):
    """As many robots' environments do, which scale it in place."""

    def step(self, action: Any) -> Any:
        action *= 0.5
        return super().step(action)


class KeepsItsAction(Plain):
    """Changes it at the next step, when it has long been recorded."""

    kept: Any = None

    def step(self, action: Any) -> Any:
        if self.kept is not None:
            self.kept[:] = 0.0
        self.kept = action
        return super().step(action)


class ChangesPartsOfItsAction(Plain):
    action_space = spaces.Dict({"push": Plain.action_space, "turn": spaces.MultiDiscrete([4, 4])})

    def step(self, action: Any) -> Any:
        action["push"] *= 0.5
        action["turn"][:] = 0
        return super().step(action.pop("push"))


class ReusesWhatItReturns(Plain):
    """One array of observations, one dict of infos with a list and a dict in it, and one array as reward."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.reward = np.zeros((), np.float64)
        self.info: dict[str, Any] = {"n": np.zeros(2), "deep": {"n": 0}, "listed": [0]}
        return self.place, self.info

    def step(self, action: Any) -> Any:
        self.place += action
        self.reward += 1.0
        self.info["n"] += 1.0
        self.info["deep"]["n"] += 1
        self.info["listed"][0] += 1
        return self.place, self.reward, False, False, self.info


class ActionIsItsObservation(Plain):
    """Returns the action itself, and changes it afterwards."""

    last: Any = None

    def step(self, action: Any) -> Any:
        if self.last is not None:
            self.last[:] = 9.0
        self.last = action
        return action, 1.0, False, False, {"last": action}


class SaysOurMarks(Plain):
    """Has keys of its own in `info` that are marks of ours."""

    def step(self, action: Any) -> Any:
        marks = {"steps": 77, "policy_failed": True, "action_invalid": True, "fuel": 3}
        return (*super().step(action)[:4], marks)


class NeedsOptions(Plain):
    """Cannot be reset without options, and changes those that it gets."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        assert options is not None
        obs, info = super().reset(seed=seed)
        obs += np.float32(options["levels"].pop())
        return obs, info


class ChangesItsArguments(Plain):
    """Changes the arguments of its constructor."""

    def __init__(self, levels: list[int]) -> None:
        self.level = levels.pop()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        obs, info = super().reset(seed=seed)
        return obs + self.level, info


class Unseeded(Plain):
    """Draws from the generator of the whole process."""

    def step(self, action: Any) -> Any:
        obs, _, *rest = super().step(action)
        return obs, random.random(), *rest


class UnseededAtTheStart(Plain):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.place = np.random.uniform(-1.0, 1.0, 1).astype(np.float32)
        return self.place, {}


class TellsTheTime(Plain):
    """Repeats its episodes, but for a clock in `info`."""

    def step(self, action: Any) -> Any:
        return (*super().step(action)[:4], {"clock": time.time()})


class Noise(Plain):
    """Pictures that cannot be compressed."""

    observation_space = spaces.Box(0, 255, (512, 1024, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.picture(), {}

    def picture(self) -> Any:
        return np.frombuffer(self.np_random.bytes(512 * 1024 * 3), np.uint8).reshape(512, 1024, 3)

    def step(self, action: Any) -> Any:
        return self.picture(), 1.0, False, False, {}


class WaitsForAChild(Plain):
    """Waits at its end for a process that ignores SIGTERM, as all of a slot do."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.child = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
        return super().reset(seed=seed)

    def close(self) -> None:
        self.child.terminate()
        self.child.wait()


for _kind in list(vars().values()):
    if isinstance(_kind, type) and issubclass(_kind, Plain):
        gymnasium.register(f"{_kind.__name__}-v0", entry_point=_kind, max_episode_steps=12)
