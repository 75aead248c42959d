"""Random actions for checks of pages: calls, elements and places that an observation shows.

Of the random values of the action spaces hardly one names an element, or is a call at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from evopolicy_worker.environments.browser.browsergym_calls import SIGNATURES
from evopolicy_worker.environments.browser.page_env import USUAL

Rng = np.random.Generator
Box = tuple[float, float, float, float]
"""Left, top, width, height."""
_ROLES = {
    **dict.fromkeys(("fill", "clear"), ("textbox", "searchbox", "spinbutton")),
    **dict.fromkeys(("check", "uncheck"), ("checkbox", "radio")),
    "select_option": ("combobox", "listbox"),
}
"""Calls that only elements of these roles take."""
_TEXTS = ("a", "7", "hello", "12/24/2020", "12:30PM", "two words\nand a line", "é中😀")
_KEYS = ("Enter", "Tab", "Shift+Tab", "Escape", "Backspace", "Delete", "Space", "a", "B", "7", "Home", "Shift+End", "PageDown",  # noqa: E501
         "ArrowUp", "ArrowDown", "ArrowLeft", "Shift+ArrowRight", "Control+a", "Control+c", "Control+v", "Control+x")  # fmt: skip  # noqa: E501


class _Seen:
    """The elements and texts of a page that an observation of BrowserGym shows."""

    def __init__(self, obs: Mapping[str, Any]) -> None:
        properties = msgspec.json.decode(obs["extra_element_properties"])
        nodes = msgspec.json.decode(obs["axtree_object"])["nodes"]
        shown = {bid: each for bid, each in properties.items() if each["visibility"] > 0}
        self.boxes: list[Box] = [tuple(each["bbox"]) for each in shown.values()]
        usual = [bid for bid, each in shown.items() if each["clickable"]] or [*shown] or ["0"]
        self.bids = {name: usual for name in SIGNATURES if name not in _ROLES}
        """By call, the elements that take it."""
        del self.bids["report_infeasible"]  # It would end the episode.
        roles = [each["role"]["value"] for each in nodes]
        for name, wanted in _ROLES.items():
            if taken := [
                each["browsergym_id"] for each, role in zip(nodes, roles, strict=True) if role in wanted
            ]:
                self.bids[name] = taken
        names = [str(each["name"]["value"])[:40] for each in nodes]
        self.texts = [*_TEXTS, *_TEXTS, *names]
        self.options = [name for name, role in zip(names, roles, strict=True) if role == "option"] or names


def _one(of: Sequence[Any], rng: Rng) -> Any:
    return of[int(rng.integers(len(of)))]


def _values(seen: _Seen, name: str) -> Mapping[str, Sequence[Any]]:
    """By the name of a call's argument, the values of which one is drawn; the other arguments are a place's."""
    return {
        **dict.fromkeys(("bid", "from_bid", "to_bid"), seen.bids[name]),
        **dict.fromkeys(("text", "value"), seen.texts),
        **dict.fromkeys(("key", "key_comb"), _KEYS),
        **dict.fromkeys(("delta_x", "delta_y"), (0, 50, -50, 300)),
        "options": seen.options,
        "button": ("left", "left", "left", "middle", "right"),
        "modifiers": ([], [], [], ["Shift"], ["Control"]),
        "wait_ms": (0, 200, 1000),
    }


def browsergym(obs: Mapping[str, Any], rng: Rng) -> str:
    """One or two calls as text."""
    seen = _Seen(obs)
    return "\n".join(_call(_one([*seen.bids], rng), seen, rng) for _ in range(_one((1, 1, 2), rng)))


def _call(name: str, seen: _Seen, rng: Rng) -> str:
    place, values = (0.0, 0.0), _values(seen, name)
    arguments = []
    for argument in SIGNATURES[name]:
        if argument in values:
            arguments.append(_one(values[argument], rng))
            continue
        if argument.endswith("x"):
            place = _place(seen.boxes, USUAL[:2], rng)
        arguments.append(round(place[argument.endswith("y")], 1))
    return f"{name}({', '.join(map(repr, arguments))})"


def _place(boxes: Sequence[Box], size: tuple[int, ...], rng: Rng) -> tuple[float, float]:
    anywhere = [(0.0, 0.0, float(size[0]), float(size[1]))]
    left, top, width, height = _one(_one((boxes or anywhere, anywhere), rng), rng)
    return left + width * rng.random(), top + height * rng.random()


def miniwob(obs: Mapping[str, Any], drawn: dict[str, Any], rng: Rng) -> dict[str, Any]:
    """MiniWoB++'s action that was drawn from its space, with an element that there is and, mostly, a place in one."""
    elements = obs["dom_elements"]
    if not elements:
        return drawn
    place = _place([_box(each) for each in elements], USUAL[2:], rng)
    return {**drawn, "ref": max(0, _one(elements, rng)["ref"]), "coords": np.array(place, np.float32)}


def _box(element: Mapping[str, Any]) -> Box:
    left, top, width, height = (float(element[side][0]) for side in ("left", "top", "width", "height"))
    return left, top, width, height
