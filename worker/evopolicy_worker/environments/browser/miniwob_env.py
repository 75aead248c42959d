"""MiniWoB++ with its own spaces: `miniwob/click-test-v1` and the like.

Observation and action are those of the package's `MiniWoBEnvironment` with its action set `all_supported`, except that
an observation has a `screenshot` only on request.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from evopolicy_worker.environments.browser import keys, miniwob_pages
from evopolicy_worker.environments.browser.page import CLICK, DOUBLE_CLICK
from evopolicy_worker.environments.browser.page_env import PageEnv, Stepped

MAX_TEXT = 256
MAX_FIELD = 64
MAX_TYPED = 64
MAX_REF = 1_000_000
MAX_FIELDS = 20
SCROLL = 50
"""Pixels that a step of the wheel scrolls."""
ACTIONS = (
    *("NONE", "MOVE_COORDS", "CLICK_COORDS", "DBLCLICK_COORDS", "MOUSEDOWN_COORDS", "MOUSEUP_COORDS"),
    *("SCROLL_UP_COORDS", "SCROLL_DOWN_COORDS", "CLICK_ELEMENT", "PRESS_KEY", "TYPE_TEXT", "TYPE_FIELD"),
    *("FOCUS_ELEMENT_AND_TYPE_TEXT", "FOCUS_ELEMENT_AND_TYPE_FIELD"),
)
KEYS = (
    *(f"<{name}>" for name in ("Enter", "PageUp", "PageDown", "Backspace", "Delete", "Tab", "Space")),
    *(f"<Arrow{name}>" for name in ("Up", "Right", "Down", "Left")),
    *'[]-=;"\\,./`1234567890',
    *(f"<Numpad{k}>" for k in range(10)),
    *(f"<Numpad{name}>" for name in ("Add", "Multiply", "Subtract", "Divide", "Decimal", "Enter")),
    *"abcdefghijklmnopqrstuvwxyz",
    *("C-a", "C-c", "C-x", "C-v"),
    *"ABCDEFGHIJKLMNOPQRSTUVWXYZ",
)
"""The keys that `key` of an action indexes."""
_PRESSED = tuple(filter(None, map(keys.miniwob, KEYS)))
_POINTED = {
    "MOVE_COORDS": (),
    "CLICK_COORDS": CLICK,
    "DBLCLICK_COORDS": DOUBLE_CLICK,
    "MOUSEDOWN_COORDS": CLICK[:1],
    "MOUSEUP_COORDS": CLICK[1:],
}
"""What happens at the place to which the mouse moves."""


class MiniWoBEnv(PageEnv):
    def __init__(self, page: str, **options: Any) -> None:
        """`options`: those of `PageEnv`."""
        super().__init__(page, **{"reward": "decayed", **options})
        width, height = self._size[2:]
        self.observation_space = spaces.Dict(_observed(width, height, screenshot=self._screenshot))
        self.action_space = spaces.Dict(
            {
                "action_type": spaces.Discrete(len(ACTIONS)),
                "coords": spaces.Box(np.zeros(2, np.float32), np.array([width, height], np.float32)),
                "ref": spaces.Discrete(MAX_REF),
                "key": spaces.Discrete(len(KEYS)),
                "text": spaces.Text(MAX_TYPED, min_length=0),
                "field": spaces.Discrete(MAX_FIELDS),
            }
        )
        self._fields: miniwob_pages.Fields = ()

    def _first(self, report: dict[str, Any]) -> Any:
        fields = report["fields"]
        self._fields = (
            miniwob_pages.fields(self.name, report["utterance"])
            if fields is None
            else tuple((str(key), str(value)) for key, value in fields)
        )
        return self._observation(report)

    def _step(self, action: Any) -> Stepped:
        self._act(action)
        report = self._pass()
        reward, done, info = self._scored(report)
        return self._observation({} if done else report), reward, done, False, info

    def _act(self, action: dict[str, Any]) -> None:
        kind = ACTIONS[action["action_type"]]
        page = self.page
        x, y = map(float, action["coords"])
        if kind in _POINTED:
            page.point(x, y, *_POINTED[kind])
        elif kind.startswith("SCROLL"):
            page.wheel(x, y, 0.0, SCROLL if "DOWN" in kind else -SCROLL)
        elif kind == "PRESS_KEY":
            page.press(*_PRESSED[action["key"]])
        elif kind in ("CLICK_ELEMENT", "FOCUS_ELEMENT_AND_TYPE_TEXT", "FOCUS_ELEMENT_AND_TYPE_FIELD"):
            page.run(f"core.elementClick({int(action['ref'])})")
        if kind.endswith("TYPE_TEXT"):
            page.type(action["text"])
        elif kind.endswith("TYPE_FIELD"):
            field = action["field"]
            page.type(self._fields[field][1] if field < len(self._fields) else "")

    def _observation(self, report: dict[str, Any]) -> dict[str, Any]:
        """The observation; empty after the end of an episode, as in MiniWoB++."""
        observed: dict[str, Any] = {
            "utterance": report.get("utterance", ""),
            "dom_elements": tuple(map(_element, report.get("elements", ()))),
            "fields": self._fields[:MAX_FIELDS] if report else (),
        }
        if self._screenshot:
            width, height = self._size[2:]
            empty = np.zeros((height, width, 3), np.uint8)
            observed["screenshot"] = self.picture(width, height) if report else empty
        return observed


def _observed(width: int, height: int, *, screenshot: bool) -> dict[str, Any]:
    text, name = spaces.Text(MAX_TEXT, min_length=0), spaces.Text(MAX_FIELD, min_length=0)
    element = {
        "ref": spaces.Discrete(2 * MAX_REF, start=-MAX_REF),
        "parent": spaces.Discrete(MAX_REF),
        **dict.fromkeys(("left", "top"), spaces.Box(-np.inf, np.inf, (1,))),
        **dict.fromkeys(("width", "height"), spaces.Box(0.0, np.inf, (1,))),
        **dict.fromkeys(("tag", "text", "value", "id", "classes"), text),
        **dict.fromkeys(("bg_color", "fg_color"), spaces.Box(0.0, 255.0, (4,))),
        "flags": spaces.MultiBinary(4),
    }
    observed: dict[str, Any] = {
        "utterance": text,
        "dom_elements": spaces.Sequence(spaces.Dict(element)),
        "fields": spaces.Sequence(spaces.Tuple((name, name))),
    }
    if screenshot:
        observed["screenshot"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
    return observed


_ELEMENT: Mapping[str, type[np.generic] | None] = {
    **dict.fromkeys(("ref", "parent")),
    **dict.fromkeys(("left", "top", "width", "height"), np.float32),
    **dict.fromkeys(("tag", "text", "value", "id", "classes")),
    **dict.fromkeys(("bg_color", "fg_color"), np.float32),
    "flags": np.int8,
}
"""Parts of an element as `miniwob.js` tells them, in order, and the types of those that are arrays."""


def _element(row: list[Any]) -> dict[str, Any]:
    return {
        name: part if dtype is None else np.array(part if isinstance(part, list) else (part,), dtype)
        for (name, dtype), part in zip(_ELEMENT.items(), row, strict=True)
    }
