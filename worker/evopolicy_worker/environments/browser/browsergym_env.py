"""MiniWoB++ as in BrowserGym: `browsergym/miniwob.click-test` and the like.

Observation and action are those of BrowserGym's `BrowserEnv` with the action sets `miniwob_all` and `bid`, its zoom,
and its hidden instruction. The differences: objects are JSON texts, since no space has a form for them; an observation
has a `screenshot` and a `dom_object` only on request; time is the episode's clock.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces

from evopolicy_worker.environments.browser import keys
from evopolicy_worker.environments.browser.browsergym_calls import calls
from evopolicy_worker.environments.browser.page import CLICK, DOUBLE_CLICK, ORIGIN
from evopolicy_worker.environments.browser.page_env import PageEnv, Stepped, script

MAX_ACTION = 4096
"""Characters of an action."""
MAX_TEXT = 4096
MAX_JSON = 1 << 22
"""Characters of an object as JSON."""
MAX_WAIT_MS = 10_000
"""Of the episode's clock that one `noop` lets pass."""
_EPISODE_MS = 1_000_000
Place = tuple[float, float]
_GREETING = "Hi! I am your UI assistant, I can perform web tasks for you. What can I help you with?"


class BrowserGymEnv(PageEnv):
    """A page of MiniWoB++ with BrowserGym's spaces."""

    def __init__(self, page: str, *, dom_object: bool = False, **options: Any) -> None:
        """`dom_object`: whether observations have a snapshot of the page's documents; the page is then loaded for each
        episode, since the order of an element's attributes outlasts an episode. `options`: those of `PageEnv`."""
        if dom_object:
            options["load"] = "each"
        self._dom = dom_object
        usual = {"reward": "positive", "episode_ms": _EPISODE_MS, "accessible": True}
        super().__init__(page, **{**usual, "scripts": (script("browsergym.js"),), **options})
        self.observation_space = spaces.Dict(self._spaces())
        self.action_space = spaces.Text(MAX_ACTION, min_length=0)

    _enter = "__evopolicy.gym.begin"
    _open = "__evopolicy.gym.first"
    _look = "__evopolicy.gym.look"

    def _first(self, report: dict[str, Any]) -> Any:
        self._goal = str(report["goal"])[:MAX_TEXT]
        self._messages = [_message("assistant", _GREETING, 0.0), _message("user", self._goal, 0.0)]
        self._over, self._held, self._last = False, 0, ("", "")
        return self._observation(report)

    def _step(self, action: Any) -> Stepped:
        error = ""
        self._over = False
        try:
            for name, arguments in calls(action):
                _ACTIONS[name](self, **arguments)
        except ValueError as wrong:
            error = f"{type(wrong).__name__}: {wrong}"[:MAX_TEXT]
        self._last = action, error
        report = self._pass()
        reward, done, info = self._scored(report)
        observed = self._observation(report)
        if self._over and not done:
            done, reward = True, 0.0
            info |= {"raw_reward": 0.0, "reason": "the agent reported the task infeasible", "success": False}
        if error:
            info["last_action_error"] = error
        return observed, reward, done, False, info

    def _observation(self, report: dict[str, Any]) -> dict[str, Any]:
        url = f"{ORIGIN}/{self._address.path}"
        observed: dict[str, Any] = {
            "chat_messages": tuple(dict(each) for each in self._messages),
            "goal": self._goal,
            "goal_object": ({"type": "text", "text": self._goal},),
            "open_pages_urls": (url,),
            "open_pages_titles": (report.get("title", ""),),
            "active_page_index": np.array((0,), dtype=np.int64),
            "url": url,
            "axtree_object": _json(report.get("tree", {"nodes": []})),
            "extra_element_properties": _json(report.get("properties", {})),
            "focused_element_bid": report.get("focused", ""),
            "last_action": self._last[0],
            "last_action_error": self._last[1],
            "elapsed_time": np.array((report["now"] / 1000,), dtype=np.float64),
        }
        if self._dom:
            empty: dict[str, Any] = {"documents": [], "strings": []}
            observed["dom_object"] = _json(empty if report["left"] else self.page.snapshot())
        if self._screenshot:
            observed["screenshot"] = self.picture(*self._size[:2])
        return observed

    # Parts of actions. They raise ValueError with a text for what is not possible.

    def _say(self, role: str, text: str) -> None:
        self._messages.append(_message(role, text, float(self.page.run("__evopolicy.clock.now")) / 1000))
        self._over = self._over or role == "infeasible"

    def _fill(self, bid: str, value: str) -> None:
        if self._do("fill", bid, value)["filled"]:
            return
        if value:
            self.page.insert(value)
        else:
            self.page.press(keys.NAMED["Delete"])

    def _set_checked(self, bid: str, wanted: bool) -> None:
        if self._do("checked", bid)["checked"] != wanted:
            self._mouse(self._place(bid), *CLICK, modifiers=0)
            if self._do("checked", bid)["checked"] != wanted:
                raise ValueError("Clicking the checkbox did not change its state")

    def _place(self, bid: str) -> Place:
        place = self._do("place", bid)
        return place["x"], place["y"]

    def _mouse(
        self, at: Place, *events: tuple[str, int], button: Any = "left", modifiers: int | None = None
    ) -> None:
        """`modifiers`: by default the keys that are held."""
        if button not in ("left", "middle", "right"):
            raise ValueError(f"button is {button!r}: left, middle or right")
        held = self._held if modifiers is None else modifiers
        self.page.point(*at, *events, button=button, modifiers=held)

    def _key(self, kind: Any, name: str) -> None:
        key, modifiers = _key(name)
        bit = keys.MODIFIERS.get(key.key, 0)
        self._held = self._held | bit if kind == "down" else self._held & ~bit
        self.page.keys((kind, key, modifiers | self._held))

    def _press(self, name: str) -> None:
        self.page.press(*_key(name), self._held)

    def _do(self, what: str, *arguments: Any) -> dict[str, Any]:
        """What a function of the page's script returns. Raises ValueError with the error that it reports."""
        given = ", ".join(map(json.dumps, arguments))
        outcome: dict[str, Any] = self.page.run(f"__evopolicy.gym.{what}({given})")
        if "error" in outcome:
            raise ValueError(outcome["error"])
        return outcome

    def _spaces(self) -> dict[str, Any]:
        """Of the parts of an observation."""
        text, plain = spaces.Text(MAX_TEXT, min_length=0), spaces.Text(MAX_JSON, min_length=0)
        seconds, urls = spaces.Box(0.0, np.inf, (1,), np.float64), spaces.Sequence(text)
        message = {"role": text, "timestamp": seconds, "message": text}
        parts: dict[str, Any] = {
            **dict.fromkeys(("goal", "url", "focused_element_bid", "last_action", "last_action_error"), text),
            **dict.fromkeys(("axtree_object", "extra_element_properties"), plain),
            "chat_messages": spaces.Sequence(spaces.Dict(message)),
            "goal_object": spaces.Sequence(spaces.Dict({"type": text, "text": text})),
            **dict.fromkeys(("open_pages_urls", "open_pages_titles"), urls),
            "active_page_index": spaces.Box(0, 255, (1,), np.int64),
            "elapsed_time": seconds,
        }
        if self._dom:
            parts["dom_object"] = plain
        if self._screenshot:
            width, height = self._size[:2]
            parts["screenshot"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
        return parts


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def _message(role: str, text: str, at_s: float) -> dict[str, Any]:
    return {"role": role, "timestamp": np.array((at_s,), dtype=np.float64), "message": text}


def _clicked(env: BrowserGymEnv, bid: str, button: Any, names: list[Any], *events: tuple[str, int]) -> None:
    modifiers = 0
    for name in names:
        key = "Control" if name == "ControlOrMeta" else name
        if key not in keys.MODIFIERS:
            raise ValueError(f"modifiers has {name!r}: {', '.join(keys.MODIFIERS)}, ControlOrMeta")
        modifiers |= keys.MODIFIERS[key]
    env._mouse(env._place(bid), *events, button=button, modifiers=modifiers)


def _dragged(env: BrowserGymEnv, start: Callable[[], Place], end: Callable[[], Place]) -> None:
    env._mouse(start(), CLICK[0])
    env._mouse(end(), CLICK[1])


def _wait(env: BrowserGymEnv, wait_ms: float) -> None:
    env.page.run(f"__evopolicy.pass({min(max(0.0, float(wait_ms)), MAX_WAIT_MS)})")


def _choose(env: BrowserGymEnv, bid: str, options: str | list[Any]) -> None:
    env._do("choose", bid, [options] if isinstance(options, str) else [str(each) for each in options])


def _focus_and_press(env: BrowserGymEnv, bid: str, key_comb: str) -> None:
    env._do("focus", bid)
    env._press(key_comb)


_ACTIONS: Mapping[str, Callable[..., object]] = {
    "noop": _wait,
    "send_msg_to_user": lambda env, text: env._say("assistant", text),
    "report_infeasible": lambda env, reason: env._say("infeasible", reason),
    "scroll": lambda env, delta_x, delta_y: env.page.wheel(*env.page.mouse_at, delta_x, delta_y),
    "fill": BrowserGymEnv._fill,
    "clear": lambda env, bid: env._fill(bid, ""),
    "select_option": _choose,
    "check": lambda env, bid: env._set_checked(bid, True),
    "uncheck": lambda env, bid: env._set_checked(bid, False),
    "click": lambda env, bid, button, modifiers: _clicked(env, bid, button, modifiers, *CLICK),
    "dblclick": lambda env, bid, button, modifiers: _clicked(env, bid, button, modifiers, *DOUBLE_CLICK),
    "hover": lambda env, bid: env._mouse(env._place(bid)),
    "press": _focus_and_press,
    "focus": lambda env, bid: env._do("focus", bid),
    "drag_and_drop": lambda env, from_bid, to_bid: _dragged(
        env, lambda: env._place(from_bid), lambda: env._place(to_bid)
    ),
    "mouse_move": lambda env, x, y: env._mouse((x, y)),
    "mouse_down": lambda env, x, y, button: env._mouse((x, y), CLICK[0], button=button),
    "mouse_up": lambda env, x, y, button: env._mouse((x, y), CLICK[1], button=button),
    "mouse_click": lambda env, x, y, button: env._mouse((x, y), *CLICK, button=button),
    "mouse_dblclick": lambda env, x, y, button: env._mouse((x, y), *DOUBLE_CLICK, button=button),
    "mouse_drag_and_drop": lambda env, from_x, from_y, to_x, to_y: _dragged(
        env, lambda: (from_x, from_y), lambda: (to_x, to_y)
    ),
    "keyboard_down": lambda env, key: env._key("down", key),
    "keyboard_up": lambda env, key: env._key("up", key),
    "keyboard_press": lambda env, key: env._press(key),
    "keyboard_type": lambda env, text: env.page.type(text),
    "keyboard_insert_text": lambda env, text: env.page.insert(text),
}
"""By the name of an action."""


def _key(name: str) -> tuple[keys.Key, int]:
    key = keys.combined(name)
    if key is None:
        raise ValueError(f'Unknown key: "{name[:40]}"')
    return key
