"""MiniWoB++ as in BrowserGym: `browsergym/miniwob.click-test` and the like.

Observation and action are those of BrowserGym's `BrowserEnv` with the action sets `miniwob_all` and `bid`, its zoom,
and its hidden instruction. The differences: objects are JSON texts, since no space has a form for them; an observation
has a `screenshot` and a `dom_object` only on request; time is the episode's clock.
"""

from __future__ import annotations

import json
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces

from evopolicy_worker.environments.browser import keys
from evopolicy_worker.environments.browser.browsergym_calls import calls
from evopolicy_worker.environments.browser.page import ORIGIN
from evopolicy_worker.environments.browser.page_env import PageEnv, script

MAX_ACTION = 4096
"""Characters of an action."""
MAX_TEXT = 4096
MAX_JSON = 1 << 22
"""Characters of an object as JSON."""
MAX_WAIT_MS = 10_000
"""Of the episode's clock that one `noop` lets pass."""
_EPISODE_MS = 1_000_000
_MOVE, _PRESS, _RELEASE = "mouseMoved", "mousePressed", "mouseReleased"
_GREETING = "Hi! I am your UI assistant, I can perform web tasks for you. What can I help you with?"


class BrowserGymEnv(PageEnv):
    """A page of MiniWoB++ with BrowserGym's spaces."""

    def __init__(self, page: str, *, dom_object: bool = False, **options: Any) -> None:
        """`dom_object`: whether observations have a snapshot of the page's documents; the page is then loaded for each
        episode, since the order of an element's attributes outlasts an episode. `options`: those of `PageEnv`."""
        if dom_object:
            options["load"] = "each"
        self._dom = dom_object
        usual = {
            "reward": "positive",
            "episode_ms": _EPISODE_MS,
            "scripts": (script("browsergym.js"),),
            "accessible": True,
        }
        super().__init__(page, **{**usual, **options})
        width, height = self._size[:2]
        self.observation_space = spaces.Dict(
            _observed(width, height, screenshot=self._screenshot, dom_object=dom_object)
        )
        self.action_space = spaces.Text(MAX_ACTION, min_length=0)
        self._messages: list[dict[str, Any]] = []
        self._goal = ""
        self._over = False
        self._held = 0
        self._last = ("", "")

    _enter = "__evopolicy.gym.begin"
    _open = "__evopolicy.gym.first"
    _look = "__evopolicy.gym.look"

    def _first(self, found: dict[str, Any]) -> Any:
        self._goal = str(found["goal"])[:MAX_TEXT]
        self._messages = [_message("assistant", _GREETING, 0.0), _message("user", self._goal, 0.0)]
        self._over, self._held, self._last = False, 0, ("", "")
        return self._observation(found)

    def _step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        error = ""
        self._over = False
        try:
            for name, arguments in calls(action):
                getattr(self, f"_{name}")(**arguments)
        except ValueError as wrong:
            error = f"{type(wrong).__name__}: {wrong}"[:MAX_TEXT]
        self._last = action, error
        outcome = self._pass()
        reward, done, info = self._scored(outcome)
        observed = self._observation(outcome)
        if self._over and not done:
            done, reward = True, 0.0
            info |= {"raw_reward": 0.0, "reason": "the agent reported the task infeasible", "success": False}
        if error:
            info["last_action_error"] = error
        return observed, reward, done, False, info

    def _observation(self, found: dict[str, Any]) -> dict[str, Any]:
        url = f"{ORIGIN}/{self._address.path}"
        observed: dict[str, Any] = {
            "chat_messages": tuple(dict(each) for each in self._messages),
            "goal": self._goal,
            "goal_object": ({"type": "text", "text": self._goal},),
            "open_pages_urls": (url,),
            "open_pages_titles": (found.get("title", ""),),
            "active_page_index": np.array((0,), dtype=np.int64),
            "url": url,
            "axtree_object": _json(found.get("tree", {"nodes": []})),
            "extra_element_properties": _json(found.get("properties", {})),
            "focused_element_bid": found.get("focused", ""),
            "last_action": self._last[0],
            "last_action_error": self._last[1],
            "elapsed_time": np.array((found["now"] / 1000,), dtype=np.float64),
        }
        if self._dom:
            empty: dict[str, Any] = {"documents": [], "strings": []}
            observed["dom_object"] = _json(empty if found["left"] else self.page.snapshot())
        if self._screenshot:
            observed["screenshot"] = self.picture(*self._size[:2])
        return observed

    # The actions, by their names. Raises ValueError with a text for an action that is not possible.

    def _noop(self, wait_ms: float) -> None:
        self.page.run(f"__evopolicy.pass({min(max(0.0, float(wait_ms)), MAX_WAIT_MS)})")

    def _send_msg_to_user(self, text: str) -> None:
        self._messages.append(_message("assistant", text, self._now()))

    def _report_infeasible(self, reason: str) -> None:
        self._messages.append(_message("infeasible", reason, self._now()))
        self._over = True

    def _scroll(self, delta_x: float, delta_y: float) -> None:
        x, y = self.page.mouse_at
        self.page.wheel(x, y, delta_x, delta_y)

    def _fill(self, bid: str, value: str) -> None:
        if self._do("fill", bid, value)["filled"]:
            return
        if value:
            self.page.insert(value)
        else:
            self.page.press(keys.NAMED["Delete"])

    def _clear(self, bid: str) -> None:
        self._fill(bid, "")

    def _select_option(self, bid: str, options: str | list[str]) -> None:
        self._do("choose", bid, [options] if isinstance(options, str) else [str(each) for each in options])

    def _check(self, bid: str) -> None:
        self._set_checked(bid, True)

    def _uncheck(self, bid: str) -> None:
        self._set_checked(bid, False)

    def _set_checked(self, bid: str, wanted: bool) -> None:
        if self._do("checked", bid)["checked"] != wanted:
            self._click(bid, "left", [])
            if self._do("checked", bid)["checked"] != wanted:
                raise ValueError("Clicking the checkbox did not change its state")

    def _click(self, bid: str, button: Any, modifiers: list[Any], times: int = 1) -> None:
        place = self._do("place", bid)
        self._presses(place["x"], place["y"], button, times, modifiers=_modifiers(modifiers))

    def _dblclick(self, bid: str, button: Any, modifiers: list[Any]) -> None:
        self._click(bid, button, modifiers, 2)

    def _hover(self, bid: str) -> None:
        place = self._do("place", bid)
        self._mouse((_MOVE, place["x"], place["y"], "left", 0))

    def _press(self, bid: str, key_comb: str) -> None:
        self._do("focus", bid)
        self._keyboard_press(key_comb)

    def _focus(self, bid: str) -> None:
        self._do("focus", bid)

    def _drag_and_drop(self, from_bid: str, to_bid: str) -> None:
        start = self._do("place", from_bid)
        self._mouse_down(start["x"], start["y"], "left")
        end = self._do("place", to_bid)
        self._mouse_up(end["x"], end["y"], "left")

    def _mouse_move(self, x: float, y: float) -> None:
        self._mouse((_MOVE, x, y, "left", 0))

    def _mouse_down(self, x: float, y: float, button: Any) -> None:
        self._mouse((_MOVE, x, y, "left", 0), (_PRESS, x, y, _button(button), 1))

    def _mouse_up(self, x: float, y: float, button: Any) -> None:
        self._mouse((_MOVE, x, y, "left", 0), (_RELEASE, x, y, _button(button), 1))

    def _mouse_click(self, x: float, y: float, button: Any) -> None:
        self._presses(x, y, button, 1, modifiers=self._held)

    def _mouse_dblclick(self, x: float, y: float, button: Any) -> None:
        self._presses(x, y, button, 2, modifiers=self._held)

    def _mouse_drag_and_drop(self, from_x: float, from_y: float, to_x: float, to_y: float) -> None:
        self._mouse_down(from_x, from_y, "left")
        self._mouse_up(to_x, to_y, "left")

    def _mouse(self, *events: tuple[str, float, float, Any, int]) -> None:
        self.page.mouse(*events, modifiers=self._held)

    def _presses(self, x: float, y: float, button: Any, times: int, *, modifiers: int) -> None:
        which = _button(button)
        clicks = [(kind, x, y, which, k) for k in range(1, times + 1) for kind in (_PRESS, _RELEASE)]
        self.page.mouse((_MOVE, x, y, which, 0), *clicks, modifiers=modifiers)

    def _keyboard_down(self, key: str) -> None:
        found, modifiers = _key(key)
        self._held |= keys.MODIFIERS.get(found.key, 0)
        self.page.keys(("down", found, modifiers | self._held))

    def _keyboard_up(self, key: str) -> None:
        found, modifiers = _key(key)
        self._held &= ~keys.MODIFIERS.get(found.key, 0)
        self.page.keys(("up", found, modifiers | self._held))

    def _keyboard_press(self, key: str) -> None:
        found, modifiers = _key(key)
        self.page.press(found, modifiers, self._held)

    def _keyboard_type(self, text: str) -> None:
        self.page.type(text)

    def _keyboard_insert_text(self, text: str) -> None:
        self.page.insert(text)

    def _now(self) -> float:
        return float(self.page.run("__evopolicy.clock.now")) / 1000

    def _do(self, what: str, *arguments: Any) -> dict[str, Any]:
        found: dict[str, Any] = self.page.run(
            f"__evopolicy.gym.{what}({', '.join(map(json.dumps, arguments))})"
        )
        if "error" in found:
            raise ValueError(found["error"])
        return found


def _observed(width: int, height: int, *, screenshot: bool, dom_object: bool) -> dict[str, Any]:
    text, plain = spaces.Text(MAX_TEXT, min_length=0), spaces.Text(MAX_JSON, min_length=0)
    seconds = spaces.Box(0.0, np.inf, (1,), np.float64)
    observed: dict[str, Any] = {
        "chat_messages": spaces.Sequence(spaces.Dict({"role": text, "timestamp": seconds, "message": text})),
        "goal": text,
        "goal_object": spaces.Sequence(spaces.Dict({"type": text, "text": text})),
        "open_pages_urls": spaces.Sequence(text),
        "open_pages_titles": spaces.Sequence(text),
        "active_page_index": spaces.Box(0, 255, (1,), np.int64),
        "url": text,
        "axtree_object": plain,
        "extra_element_properties": plain,
        "focused_element_bid": text,
        "last_action": text,
        "last_action_error": text,
        "elapsed_time": seconds,
    }
    if dom_object:
        observed["dom_object"] = plain
    if screenshot:
        observed["screenshot"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
    return observed


def _json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def _message(role: str, text: str, at_s: float) -> dict[str, Any]:
    return {"role": role, "timestamp": np.array((at_s,), dtype=np.float64), "message": text}


def _button(name: Any) -> Any:
    if name not in ("left", "middle", "right"):
        raise ValueError(f"button is {name!r}: left, middle or right")
    return name


def _modifiers(names: list[Any]) -> int:
    """The modifiers of a click."""
    found = 0
    for name in names:
        key = "Control" if name == "ControlOrMeta" else name
        if key not in keys.MODIFIERS:
            raise ValueError(f"modifiers has {name!r}: {', '.join(keys.MODIFIERS)}, ControlOrMeta")
        found |= keys.MODIFIERS[key]
    return found


def _key(name: str) -> tuple[keys.Key, int]:
    found = keys.combined(name)
    if found is None:
        raise ValueError(f'Unknown key: "{name[:40]}"')
    return found
