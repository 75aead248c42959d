"""BrowserGym's actions: texts of function calls, such as `click('12')` or `fill('a3', 'hello')`, taken apart and never
run."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from typing import Any

MAX_CALLS = 32
"""Of one action."""
MAX_NUMBER = 1e6
SIGNATURES: Mapping[str, tuple[str, ...]] = {
    name: tuple(arguments.split())
    for name, arguments in {
        "noop": "wait_ms",
        "send_msg_to_user": "text",
        "report_infeasible": "reason",
        "scroll": "delta_x delta_y",
        "fill": "bid value",
        "select_option": "bid options",
        "check": "bid",
        "uncheck": "bid",
        "click": "bid button modifiers",
        "dblclick": "bid button modifiers",
        "hover": "bid",
        "press": "bid key_comb",
        "focus": "bid",
        "clear": "bid",
        "drag_and_drop": "from_bid to_bid",
        "mouse_move": "x y",
        "mouse_up": "x y button",
        "mouse_down": "x y button",
        "mouse_click": "x y button",
        "mouse_dblclick": "x y button",
        "mouse_drag_and_drop": "from_x from_y to_x to_y",
        "keyboard_down": "key",
        "keyboard_up": "key",
        "keyboard_press": "key",
        "keyboard_type": "text",
        "keyboard_insert_text": "text",
    }.items()
}
"""By function, the names of its arguments in order."""
DEFAULTS: Mapping[str, Any] = {"wait_ms": 1000, "button": "left", "modifiers": []}
_NUMBERS = ["wait_ms", "x", "y", "delta_x", "delta_y", "from_x", "from_y", "to_x", "to_y"]
_TYPES: Mapping[str, Any] = {
    **dict.fromkeys(_NUMBERS, int | float),
    "options": str | list,
    "modifiers": list,
}
"""Of arguments by their names; all others are texts."""
ELSEWHERE = (
    *("goto", "go_back", "go_forward", "new_tab", "tab_close", "tab_focus"),
    *("upload_file", "mouse_upload_file"),
)
"""BrowserGym's actions that leave the page, which these tasks never need."""


_TEXT = r"""\"{3}.*?\"{3}|'{3}.*?'{3}|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'"""
_CALL = re.compile(
    rf"""\#[^\n]*|\b([A-Za-z_]\w*)\s*\(((?>{_TEXT}|\#[^\n]*|[^()'"#])*+)\)""",
    re.DOTALL,
)
"""A comment, or a function's name and its arguments."""


def calls(text: str) -> list[tuple[str, dict[str, Any]]]:
    """The calls of an action, in order: functions and their arguments by name. As BrowserGym does, it finds them
    anywhere in the text, skips comments and the words in between, and lets a text have several lines. ValueError, in
    words, for an action without calls."""
    matches = [match for match in _CALL.finditer(text) if match[1]]
    given = [(match[1], each) for match in matches if (each := _given(match[2])) is not None]
    if not given:
        raise ValueError(f"Received an empty action: there is no function call in {text[:200]!r}")
    if len(given) > MAX_CALLS:
        raise ValueError(f"Received {len(given)} calls; {MAX_CALLS} are the limit")
    return [(name, _arguments(name, *each)) for name, each in given]


def _given(text: str) -> tuple[list[Any], dict[str, Any]] | None:
    """Arguments by position and by name; None where they are not all texts, numbers or lists of them."""
    text = re.sub(
        _TEXT, lambda match: match[0].replace("\r", "\\r").replace("\n", "\\n"), text, flags=re.DOTALL
    )
    try:
        call = ast.parse(f"call({text}\n)", mode="eval").body
        assert isinstance(call, ast.Call)
        named = {str(each.arg): ast.literal_eval(each.value) for each in call.keywords}
        return list(map(ast.literal_eval, call.args)), named
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
        return None


def _arguments(name: str, given: list[Any], named: dict[str, Any]) -> dict[str, Any]:
    if name not in SIGNATURES:
        why = "leaves the page" if name in ELSEWHERE else "does not exist"
        raise ValueError(f"Invalid action type '{name}': it {why}; there are {', '.join(SIGNATURES)}.")
    wanted = SIGNATURES[name]
    if len(given) > len(wanted) or not named.keys() <= set(wanted):
        raise ValueError(f"{name} takes {', '.join(wanted)}; it was given {[*given, *named]}")
    values = {**DEFAULTS, **dict(zip(wanted, given, strict=False)), **named}
    for argument in wanted:
        if argument not in values:
            raise ValueError(f"{name}() misses its argument {argument!r}")
        if not _is_of_type(argument, values[argument]):
            raise ValueError(f"{name}: {argument} is {values[argument]!r}, which is not of the right type")
    return {argument: values[argument] for argument in wanted}


def _is_of_type(argument: str, value: Any) -> bool:
    if not isinstance(value, _TYPES.get(argument, str)) or isinstance(value, bool):
        return False
    if isinstance(value, int | float):
        return abs(value) <= MAX_NUMBER  # false for NaN
    texts = [each for each in (value if isinstance(value, list) else [value]) if isinstance(each, str)]
    # Half of a surrogate pair cannot be sent to the browser.
    return not any("\ud800" <= character <= "\udfff" for text in texts for character in text)
