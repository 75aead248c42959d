"""The shared part of both kinds of environments: an episode in a page of MiniWoB++, its clock, its reward, and a lost
browser.

Rules:
- Each episode has its own clock, which advances by `STEP_MS` per step, independent of the time that a policy or a page
  takes. The page's timeout and the decay of its reward follow it. With `clock="wall"`, time is the machine's, and
  episodes are not reproducible.
- A page is loaded once for many episodes (`load="once"`), or for each (`load="each"`), in a browser context of its own.
  The catalogue states which pages need the latter.
- A page that hangs, crashes, or fails is an infrastructure failure: the browser is restarted, and the episode is
  replayed up to that step, with the same result. If that fails too, the error is raised.
"""

from __future__ import annotations

import io
import json
from abc import abstractmethod
from importlib.resources import files
from typing import Any, Literal

import gymnasium
import numpy as np

from evopolicy_common.errors import ConfigError
from evopolicy_worker.environments.browser import miniwob_pages
from evopolicy_worker.environments.browser.devtools import BrowserLostError
from evopolicy_worker.environments.browser.page import Address, Page, shared
from evopolicy_worker.environments.interface.base import Frame

STEP_MS = 200
"""Of the episode's clock that pass at each step."""
Reward = Literal["decayed", "raw", "binary", "positive"]
"""`decayed`: as the page gives it, which is less the later it comes. `raw`: before that. `binary`: 1 for a raw reward
of 1, -1 for any other end. `positive`: 1 for a raw reward above 0, 0 for any other end."""
_CHOICES: dict[str, tuple[str, ...]] = {
    "reward": ("decayed", "raw", "binary", "positive"),
    "clock": ("steps", "wall"),
    "load": ("once", "each"),
}
FLIGHT = (600, 700, 375, 667)
USUAL = (500, 320, 160, 210)
"""Width and height of the window and of the task in its upper left corner, CSS pixels."""


class PageEnv(gymnasium.Env[Any, Any]):
    """One page of MiniWoB++, played through this process's browser."""

    _enter = "__evopolicy.begin"
    """Begins an episode in the page."""
    _open = _look = "__evopolicy.look"
    """The observation at the start of an episode, and after a step."""
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(
        self,
        page: str,
        *,
        reward: Reward,
        clock: Literal["steps", "wall"] = "steps",
        load: Literal["once", "each"] = "once",
        data_mode: str = "train",
        episode_ms: int = 0,
        screenshot: bool = False,
        render_mode: str | None = None,
        scripts: tuple[str, ...] = (),
        accessible: bool = False,
    ) -> None:
        """`page`: its name, such as `click-test`. `data_mode`: of pages whose tasks differ between training and test.
        `episode_ms`: when the page times out, on the episode's clock; 0: as it says itself. `screenshot`: whether
        observations have a picture. `scripts`: more that runs in the page once it has loaded. `accessible`: roles and
        names of elements are asked for at each step.

        Raises ConfigError for an argument that is none of the choices, and WorkerError when a program or package is
        missing.
        """
        for name, value in (("reward", reward), ("clock", clock), ("load", load)):
            if value not in _CHOICES[name]:
                raise ConfigError(f"{name} is {value!r}: {', '.join(_CHOICES[name])}")
        self.render_mode = render_mode
        self.name = page
        self._reward: Reward = reward
        self._fresh = load == "each" or clock == "wall"
        self._mode = data_mode
        self._limit_ms = episode_ms
        self._screenshot = screenshot
        self._size = FLIGHT if page.startswith("flight.") else USUAL
        self._address = Address(
            root=miniwob_pages.root(),
            path=miniwob_pages.document(page),
            width=self._size[0],
            height=self._size[1],
            virtual=clock == "steps",
            scripts=(script("miniwob.js"), *scripts),
            accessible=accessible,
        )
        self._begun: tuple[int, str] = (0, data_mode)
        self._actions: list[Any] = []

    @property
    def page(self) -> Page:
        """The page of this process's browser."""
        return shared()

    @property
    def task_size(self) -> tuple[int, int]:
        """Width and height of the task, CSS pixels."""
        return self._size[2:]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """`options`: `data_mode`, as for MiniWoB++."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        self._begun = seed, str((options or {}).get("data_mode", self._mode))
        self._actions = []
        try:
            return self._begin(*self._begun), {}
        except BrowserLostError:
            self.page.lose()
            return self._begin(*self._begun), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        try:
            outcome = self._step(action)
        except BrowserLostError:
            outcome = self._play_again(action)
        self._actions.append(action)
        return outcome

    def render(self) -> Any:
        """The window as it is."""
        return self.picture(*self._size[:2])

    def picture(self, width: int, height: int) -> Frame:
        """The window's upper left part, RGB."""
        import av

        data = self.page.picture(width=width, height=height)
        with av.open(io.BytesIO(data), format="png_pipe") as container:
            frame = next(container.decode(video=0)).to_ndarray(format="rgb24")
        return np.ascontiguousarray(frame)

    def close(self) -> None:
        """The browser stays for other environments of this process; it ends with the process."""

    def _play_again(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.page.lose()
        self._begin(*self._begun)
        for each in self._actions:
            _, _, terminated, truncated, _ = self._step(each)
            if terminated or truncated:
                raise BrowserLostError(
                    f"the page {self.name} was lost, and plays another episode when played again"
                )
        return self._step(action)

    def _begin(self, seed: int, mode: str) -> Any:
        page = self.page
        page.keep_small()
        if self._fresh or page.opened != self._address:
            page.open(self._address, str(seed) if self._fresh else "")
        page.rest()
        begin = f"{self._enter}({seed}, {json.dumps(mode)}, {self._limit_ms}, {STEP_MS})"
        return self._first(page.tell(f"{begin}.then({self._open})"))

    def _scored(self, found: dict[str, Any]) -> tuple[float, bool, dict[str, Any]]:
        """Reward, whether the episode has ended, and `info`, from the page's report."""
        done, raw = bool(found["done"]), float(found["raw"])
        if found["left"]:
            # MiniWoB++'s reward at the timeout. The page is loaded anew for the next episode: it may have grown too
            # large.
            self.page.opened = None
            done, raw, found = True, -1.0, {**found, "reward": -1.0, "reason": found["left"]}
        reward = {
            "decayed": float(found["reward"]),
            "raw": raw,
            "binary": 1.0 if raw == 1.0 else -1.0,
            "positive": float(raw > 0),
        }[self._reward]
        info: dict[str, Any] = {"elapsed_ms": found["now"]}
        if done:
            info |= {"raw_reward": raw, "reason": found["reason"], "success": raw > 0}
        return reward if done else 0.0, done, info

    def _pass(self) -> dict[str, Any]:
        """Lets a step's time pass; then what there is to see."""
        self.page.keys_ms += STEP_MS
        found: dict[str, Any] = self.page.tell(
            f"__evopolicy.pass({STEP_MS}, {list(self.page.mouse_at)}).then({self._look})"
        )
        return found

    @abstractmethod
    def _first(self, found: dict[str, Any]) -> Any:
        """The first observation of an episode. `found`: the page's report."""

    @abstractmethod
    def _step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step. Raises BrowserLostError."""


def script(name: str) -> str:
    """A script of this package."""
    return files(__package__).joinpath(name).read_text("utf-8")
