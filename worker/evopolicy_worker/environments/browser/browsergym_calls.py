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
_NUMBER = (int, float)
BID = {"bid": str}
_POINT: dict[str, Any] = {"x": _NUMBER, "y": _NUMBER}
_BUTTON = {"button": ("left", str), "modifiers": ([], list)}
SIGNATURES: Mapping[str, Mapping[str, Any]] = {
    "noop": {"wait_ms": (1000, _NUMBER)},
    "send_msg_to_user": {"text": str},
    "report_infeasible": {"reason": str},
    "scroll": {"delta_x": _NUMBER, "delta_y": _NUMBER},
    "fill": {**BID, "value": str},
    "select_option": {**BID, "options": (str, list)},
    "check": BID,
    "uncheck": BID,
    "click": {**BID, **_BUTTON},
    "dblclick": {**BID, **_BUTTON},
    "hover": BID,
    "press": {**BID, "key_comb": str},
    "focus": BID,
    "clear": BID,
    "drag_and_drop": {"from_bid": str, "to_bid": str},
    "mouse_move": _POINT,
    "mouse_up": {**_POINT, "button": ("left", str)},
    "mouse_down": {**_POINT, "button": ("left", str)},
    "mouse_click": {**_POINT, "button": ("left", str)},
    "mouse_dblclick": {**_POINT, "button": ("left", str)},
    "mouse_drag_and_drop": {"from_x": _NUMBER, "from_y": _NUMBER, "to_x": _NUMBER, "to_y": _NUMBER},
    "keyboard_down": {"key": str},
    "keyboard_up": {"key": str},
    "keyboard_press": {"key": str},
    "keyboard_type": {"text": str},
    "keyboard_insert_text": {"text": str},
}
"""By function, its arguments in order: their types, or a default and their types. A default's types include None."""
ELSEWHERE = (
    "goto",
    "go_back",
    "go_forward",
    "new_tab",
    "tab_close",
    "tab_focus",
    "upload_file",
    "mouse_upload_file",
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
    found = [
        (match[1], given)
        for match in _CALL.finditer(text)
        if match[1] and (given := _given(match[2])) is not None
    ]
    if not found:
        raise ValueError(f"Received an empty action: there is no function call in {text[:200]!r}")
    if len(found) > MAX_CALLS:
        raise ValueError(f"Received {len(found)} calls; {MAX_CALLS} are the limit")
    return [(name, _arguments(name, *given)) for name, given in found]


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
    if len(given) > len(wanted) or not named.keys() <= wanted.keys():
        raise ValueError(f"{name} takes {', '.join(wanted)}; it was given {[*given, *named]}")
    all_given = dict(zip(wanted, given, strict=False)) | named
    return {each: _argument(name, each, parameter, all_given) for each, parameter in wanted.items()}


def _argument(name: str, argument: str, parameter: Any, given: Mapping[str, Any]) -> Any:
    has_default = isinstance(parameter, tuple) and not isinstance(parameter[0], type)
    types = parameter[1] if has_default else parameter
    if argument not in given:
        if has_default:
            return parameter[0]
        raise ValueError(f"{name}() misses its argument {argument!r}")
    value = given[argument]
    numbers = isinstance(value, int | float) and not abs(value) <= MAX_NUMBER
    texts = value if isinstance(value, list) else [value]
    unwritable = any(isinstance(each, str) and not each.isascii() and _has_surrogates(each) for each in texts)
    if not isinstance(value, types) or isinstance(value, bool) or numbers or unwritable:
        raise ValueError(f"{name}: {argument} is {value!r}, which is not of the right type")
    return value


def _has_surrogates(text: str) -> bool:
    return any("\ud800" <= character <= "\udfff" for character in text)
