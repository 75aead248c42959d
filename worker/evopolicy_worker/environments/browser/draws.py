"""Random actions for checks of pages: calls, elements and places that an observation shows.

Of the random values of the action spaces hardly one names an element, or is a call at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from evopolicy_worker.environments.browser.browsergym_calls import SIGNATURES
from evopolicy_worker.environments.browser.page_env import USUAL

Rng = np.random.Generator
Box = tuple[float, float, float, float]
"""Left, top, width, height."""
_FIELDS, _BOXES = ("textbox", "searchbox", "spinbutton"), ("checkbox", "radio")
_ROLES = {
    "fill": _FIELDS,
    "clear": _FIELDS,
    "check": _BOXES,
    "uncheck": _BOXES,
    "select_option": ("combobox", "listbox"),
}
"""Calls that only elements of these roles take."""
_TEXTS = ("a", "7", "hello", "12/24/2020", "12:30PM", "two words\nand a line", "é中😀")
_KEYS = ("Enter", "Tab", "Shift+Tab", "Escape", "Backspace", "Delete", "Space", "a", "B", "7", "Home", "Shift+End", "PageDown",  # noqa: E501
         "ArrowUp", "ArrowDown", "ArrowLeft", "Shift+ArrowRight", "Control+a", "Control+c", "Control+v", "Control+x")  # fmt: skip  # noqa: E501
_MODIFIERS: Sequence[list[str]] = ([], [], [], ["Shift"], ["Control"])
_TURNS = (0, 50, -50, 300)
_ENDS = {"x": 0, "y": 1}


class _Seen:
    """What there is in the page that an observation of BrowserGym shows."""

    def __init__(self, obs: Mapping[str, Any]) -> None:
        properties = msgspec.json.decode(obs["extra_element_properties"])
        nodes = msgspec.json.decode(obs["axtree_object"])["nodes"]
        shown = {bid: each for bid, each in properties.items() if each["visibility"] > 0}
        self.boxes: list[Box] = [tuple(each["bbox"]) for each in shown.values()]
        usual = [bid for bid, each in shown.items() if each["clickable"]] or [*shown] or ["0"]
        self.bids = {name: usual for name in SIGNATURES if name not in _ROLES}
        """By call, the elements that take it."""
        del self.bids["report_infeasible"]  # It would end the episode.
        for name, roles in _ROLES.items():
            if taken := [each["browsergym_id"] for each in nodes if each["role"]["value"] in roles]:
                self.bids[name] = taken
        names = [str(each["name"]["value"])[:40] for each in nodes]
        self.texts = [*_TEXTS, *_TEXTS, *names]
        self.options = [
            name for name, each in zip(names, nodes, strict=True) if each["role"]["value"] == "option"
        ] or names


def _one(of: Sequence[Any], rng: Rng) -> Any:
    return of[int(rng.integers(len(of)))]


_BUTTONS = ("left", "left", "left", "middle", "right")
_DRAWN: Mapping[str, Callable[[_Seen, str], Sequence[Any]]] = {
    "bid": lambda seen, name: seen.bids[name],
    "from_bid": lambda seen, name: seen.bids[name],
    "to_bid": lambda seen, name: seen.bids[name],
    "text": lambda seen, name: seen.texts,
    "value": lambda seen, name: seen.texts,
    "options": lambda seen, name: seen.options,
    "key": lambda seen, name: _KEYS,
    "key_comb": lambda seen, name: _KEYS,
    "button": lambda seen, name: _BUTTONS,
    "modifiers": lambda seen, name: _MODIFIERS,
    "delta_x": lambda seen, name: _TURNS,
    "delta_y": lambda seen, name: _TURNS,
    "wait_ms": lambda seen, name: (0, 200, 1000),
}
"""By the name of a call's argument, the values of which one is drawn; the other arguments are a place's."""


def browsergym(obs: Mapping[str, Any], rng: Rng) -> str:
    """One or two calls as text."""
    seen = _Seen(obs)
    return "\n".join(_call(_one([*seen.bids], rng), seen, rng) for _ in range(_one((1, 1, 2), rng)))


def _call(name: str, seen: _Seen, rng: Rng) -> str:
    place = (0.0, 0.0)
    arguments = []
    for argument in SIGNATURES[name]:
        if argument in _DRAWN:
            arguments.append(_one(_DRAWN[argument](seen, name), rng))
            continue
        if argument.endswith("x"):
            place = _place(seen.boxes, USUAL[:2], rng)
        arguments.append(round(place[_ENDS[argument[-1]]], 1))
    return f"{name}({', '.join(map(repr, arguments))})"


def _place(boxes: Sequence[Box], size: tuple[int, ...], rng: Rng) -> tuple[float, float]:
    """A place: anywhere, or in one of the boxes."""
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
