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
from typing import Any, Literal, get_args

import gymnasium
import numpy as np

from evopolicy_common.errors import ConfigError
from evopolicy_worker.environments.browser import miniwob_pages
from evopolicy_worker.environments.browser.devtools import BrowserLostError
from evopolicy_worker.environments.browser.page import Page, PageSource, shared
from evopolicy_worker.environments.interface.base import Frame

STEP_MS = 200
"""Of the episode's clock that pass at each step."""
Reward = Literal["decayed", "raw", "binary", "positive"]
"""`decayed`: as the page gives it, which is less the later it comes. `raw`: before that. `binary`: 1 for a raw reward
of 1, -1 for any other end. `positive`: 1 for a raw reward above 0, 0 for any other end."""
Clock = Literal["steps", "wall"]
Load = Literal["once", "each"]
Stepped = tuple[Any, float, bool, bool, dict[str, Any]]
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
        clock: Clock = "steps",
        load: Load = "once",
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
        choices = (("reward", reward, Reward), ("clock", clock, Clock), ("load", load, Load))
        for name, value, choice in choices:
            if value not in get_args(choice):
                raise ConfigError(f"{name} is {value!r}: {', '.join(get_args(choice))}")
        self.render_mode, self.name, self._mode = render_mode, page, data_mode
        self._reward: Reward = reward
        self._fresh = load == "each" or clock == "wall"
        self._limit_ms, self._screenshot = episode_ms, screenshot
        self._size = FLIGHT if page.startswith("flight.") else USUAL
        self._address = PageSource(
            root=miniwob_pages.folder() / "html",
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
        return shared()

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

    def step(self, action: Any) -> Stepped:
        try:
            outcome = self._step(action)
        except BrowserLostError:
            outcome = self._play_again(action)
        self._actions.append(action)
        return outcome

    def render(self) -> Any:
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

    def _play_again(self, action: Any) -> Stepped:
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

    def _scored(self, report: dict[str, Any]) -> tuple[float, bool, dict[str, Any]]:
        """Reward, whether the episode has ended, and `info`, from the page's report."""
        done, raw, reason = bool(report["done"]), float(report["raw"]), report["reason"]
        decayed = float(report["reward"])
        if report["left"]:
            # MiniWoB++'s reward at the timeout. The page is loaded anew for the next episode: it may have grown too
            # large.
            self.page.opened = None
            done, raw, decayed, reason = True, -1.0, -1.0, report["left"]
        info: dict[str, Any] = {"elapsed_ms": report["now"]}
        if not done:
            return 0.0, done, info
        binary, positive = 1.0 if raw == 1.0 else -1.0, float(raw > 0)
        rewards = {"decayed": decayed, "raw": raw, "binary": binary, "positive": positive}
        info |= {"raw_reward": raw, "reason": reason, "success": raw > 0}
        return rewards[self._reward], done, info

    def _pass(self) -> dict[str, Any]:
        """Lets a step's time pass; the page's report after it."""
        self.page.keys_ms += STEP_MS
        report: dict[str, Any] = self.page.tell(
            f"__evopolicy.pass({STEP_MS}, {list(self.page.mouse_at)}).then({self._look})"
        )
        return report

    @abstractmethod
    def _first(self, report: dict[str, Any]) -> Any:
        """The first observation of an episode, from the page's report."""

    @abstractmethod
    def _step(self, action: Any) -> Stepped:
        """One step. Raises BrowserLostError."""


def script(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")
