"""Environments of somebody else's, as a package that Gymnasium imports by name: a good one, one with every space, and
bad ones."""

from __future__ import annotations

import contextlib
import ctypes
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
        "number": spaces.Box(-1.0, 1.0, (), np.float32),
        "from_two": spaces.Discrete(3, start=2),
        "below_zero": spaces.Discrete(3, start=-2),
        "many": spaces.MultiDiscrete([2, 5], start=[1, -1]),
        "small": spaces.MultiDiscrete([2, 5], dtype=np.uint8),
        "bits": spaces.MultiBinary([2, 2]),
        "both": spaces.Tuple([spaces.Discrete(2), spaces.Text(3)]),
        "items": spaces.Sequence(INNER),
        "stack": spaces.Sequence(spaces.Box(0.0, 1.0, (2,), np.float32), stack=True),
        "numbers": spaces.Sequence(spaces.Box(-1.0, 1.0, (), np.float64), stack=True),
        "graph": spaces.Graph(spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Discrete(4)),
        "weighted_graph": spaces.Graph(spaces.Discrete(2), spaces.Box(0.0, 1.0, (), np.float32)),
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
    """Misbehaves as it is told to, in episodes of seeds from `seeds_from` on."""

    def __init__(self, how: str, seeds_from: int = 0, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.how = how
        self.seeds_from = seeds_from
        self.sound = False
        if how == "custom space":
            self.observation_space = Opaque()  # type: ignore[assignment]
        elif how == "no bounds":
            self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
            self.action_space.low[:] = 2.0
        elif how == "hang in make":
            time.sleep(3600)

    def _does(self, how: str) -> bool:
        return self.how == how and not self.sound

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.sound = seed is not None and seed < self.seeds_from
        if self._does("raise in reset"):
            raise RuntimeError("no level of that seed")
        if self._does("hang in reset"):
            time.sleep(3600)
        if self._does("change spaces"):
            self.observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
            return np.zeros(3, np.float32), {}
        if self._does("bare reset"):
            return super().reset(seed=seed)[0]
        return super().reset(seed=seed)

    def close(self) -> None:
        if self._does("hang in close"):
            time.sleep(3600)
        if self._does("raise in close"):
            raise RuntimeError("nothing is left to close")
        if self._does("leave when pushed"):
            sys.exit("nothing is left to close")

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        if self.sound:
            return obs, reward, terminated, truncated, info
        pushed = abs(float(action[0]) - 0.9) < 1e-3
        if self.how == "nan":
            reward = float("nan")
        elif self.how == "outside":
            obs = obs + 100.0
        elif self.how == "shape":
            obs = np.zeros(3, np.float32)
        elif self.how == "leak":
            LEAKED.append(np.ones(8 << 20, np.float64))
        elif self.how == "gorge":
            LEAKED.append(np.ones(1 << 34, np.uint8))
        elif self.how == "fork":
            os.fork()
        elif self.how == "fork and wait":
            if os.fork() == 0:
                time.sleep(3600)
        elif self.how == "hold" or (self.how == "hold when pushed" and pushed):
            # Holds the interpreter, as an extension module that never returns does.
            ctypes.PyDLL(None).sleep(3600)
        elif self.how == "error":
            raise FileNotFoundError("levels.dat")
        elif self.how == "print":
            print("x" * 1000)
            sys.stdout.flush()
            os.write(1, b"y" * 1000)
        elif self.how == "threads":
            threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()
        elif self.how == "raise in close" and pushed:
            raise ValueError("too strong")
        elif self.how == "leave when pushed" and pushed:
            sys.exit("too strong")
        elif self.how == "exit":
            os._exit(3)
        elif self.how == "leave":
            sys.exit("no more levels")
        elif self.how == "interrupt":
            raise KeyboardInterrupt
        elif self.how == "huge":
            reward = 1e200
        elif self.how == "component":
            info = {"fuel": float("nan")}
        elif self.how == "success in words":
            info = {"near": "no"}
        elif self.how == "success in an array":
            info = {"near": np.zeros(1)}
        elif self.how == "change spaces in step":
            self.action_space = spaces.Discrete(2)  # type: ignore[assignment]
        elif self.how == "close stdout":
            sys.stdout.close()
            with contextlib.suppress(OSError):
                os.close(1)
        elif self.how == "close files":
            os.closerange(3, 1024)
        elif self.how == "four values":
            return obs, reward, terminated, info
        elif self.how == "object reward":
            reward = object()
        elif self.how == "reward of several":
            reward = np.ones(3)
        elif self.how == "ends of several":
            terminated = np.array([True, False])
        elif self.how == "an end in a list":
            truncated = [False]
        elif self.how == "info of several":
            info = [info]
        elif self.how == "text observation":
            obs = "a hill\nto the left"
        elif self.how == "no observation":
            obs = None
        elif self.how == "hang" or (self.how == "hang when pushed" and pushed):
            time.sleep(3600)
        return obs, reward, terminated, truncated, info


GIVEN: dict[str, tuple[Any, Any]] = {
    "byte": (spaces.Box(0, 255, (2,), np.uint8), np.array([2, 300])),
    "picture": (spaces.Box(0, 255, (20, 20, 3), np.uint8), np.full((20, 20, 3), 0.5)),
    "fraction": (spaces.Discrete(5), 1.7),
    "parts": (spaces.Dict({"a": spaces.Tuple([spaces.MultiDiscrete([3, 3])])}), {"a": ([0.5, 1.0],)}),
    "number": (spaces.Text(5), 12),
    "letters": (spaces.Text(5, charset="ab"), "abc"),
}
"""Spaces, and observations that are in none of them though a value of the space can be made of each."""


class Misread(Glider):
    """Gives observations that are not in its space."""

    def __init__(self, what: str) -> None:
        super().__init__()
        self.observation_space, self.given = GIVEN[what]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.given, {}


class Grumbles(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that raises."""

    def step(self, action: Any) -> Any:
        raise LookupError("no such tile")


class Keeper(Glider):
    """Keeps how many episodes it has begun, in memory and in a file, and rewards each step by that. Ends its process on
    an action above `dies_of`."""

    def __init__(self, dies_of: float = 1.0, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.dies_of = dies_of

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        notes = os.path.join(os.environ["HOME"], "notes")
        with open(notes, "a") as file:
            file.write("x")
        COUNTED.append(1)
        self.kept = float(max(os.path.getsize(notes), len(COUNTED)))
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        if action[0] > self.dies_of:
            os._exit(3)
        obs, _, _, truncated, info = super().step(action)
        return obs, self.kept, True, truncated, info


COUNTED: list[int] = []
LEAKED: list[Any] = []


class Opaque(gymnasium.Space[Any]):
    """Of a kind that nobody knows."""

    def __init__(self) -> None:
        super().__init__((), None)


class Page:
    """An observation as of a browser or a game: an object."""

    def __init__(self, title: str, links: tuple[str, ...]) -> None:
        self.title = title
        self.links = links


class Pages(gymnasium.Space[Page]):
    """A space that tells itself how its values are encoded."""

    encoded_space = spaces.Dict({"title": spaces.Text(20), "links": spaces.Sequence(spaces.Text(20))})

    def __init__(self) -> None:
        super().__init__(None, None)

    def encode(self, page: Page) -> dict[str, Any]:
        return {"title": page.title, "links": page.links}

    def decode(self, value: dict[str, Any]) -> Page:
        return Page(value["title"], value["links"])


class Browser(gymnasium.Env[Any, Any]):
    """Shows pages, and takes the page that is wanted next beside a number."""

    observation_space = spaces.Dict({"page": Pages(), "n": spaces.Discrete(100)})
    action_space = spaces.Tuple([Pages(), spaces.Discrete(2)])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.n = 0
        return self._seen("start"), {}

    def step(self, action: Any) -> Any:
        wanted, _ = action
        assert isinstance(wanted, Page)
        self.n += 1
        return self._seen(wanted.title), float(wanted.title == "goal"), False, False, {}

    def _seen(self, title: str) -> dict[str, Any]:
        return {"page": Page(title, ("goal", "start")), "n": self.n}


for name, cls, limit in (
    ("Glider", Glider, 20),
    ("Everything", Everything, 5),
    ("Treasure", Treasure, 20),
    ("Bad", Bad, 8),
    ("Misread", Misread, 8),
    ("Keeper", Keeper, 8),
    ("Browser", Browser, 5),
):
    gymnasium.register(f"{name}-v0", entry_point=f"{__name__}:{cls.__name__}", max_episode_steps=limit)
gymnasium.register("Endless-v0", entry_point=f"{__name__}:Glider")
