"""The keys of a US keyboard, by the names that MiniWoB++ and BrowserGym give them."""

from __future__ import annotations

import string

import msgspec

ALT, CONTROL, META, SHIFT = 1, 2, 4, 8
"""Modifiers, as the DevTools protocol counts them."""


class Key(msgspec.Struct, frozen=True):
    """One key, or a key with the character that it types together with Shift."""

    key: str
    """Value of `KeyboardEvent.key`."""
    code: str
    """Value of `KeyboardEvent.code`: the place on the keyboard; empty for a character of no key."""
    number: int
    """Virtual key code; 0 for a character of no key."""
    text: str = ""
    """The text that it types."""
    location: int = 0
    """3 on the number pad, 1 and 2 for the left and right of a pair."""
    shift: bool = False
    """Whether Shift is held for it."""


def _named() -> dict[str, Key]:
    moving = ("PageUp", "PageDown", "End", "Home", "ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown")
    numbers = {"Backspace": 8, "Tab": 9, "Enter": 13, "Escape": 27, "Insert": 45, "Delete": 46}
    numbers |= {name: 33 + k for k, name in enumerate(moving)} | {f"F{k}": 111 + k for k in range(1, 13)}
    signs = {"Multiply": ("*", 106), "Add": ("+", 107), "Subtract": ("-", 109)}
    signs |= {"Decimal": (".", 110), "Divide": ("/", 111)} | {str(k): (str(k), 96 + k) for k in range(10)}
    modifiers = {"Shift": 16, "Control": 17, "Alt": 18, "Meta": 91}
    return {
        **{name: Key(name, name, n, "\r" if name == "Enter" else "") for name, n in numbers.items()},
        "Space": Key(" ", "Space", 32, " "),
        **{name: Key(name, f"{name}Left", n, location=1) for name, n in modifiers.items()},
        **{
            f"Numpad{name}": Key(text, f"Numpad{name}", n, text, location=3)
            for name, (text, n) in signs.items()
        },
        "NumpadEnter": Key("Enter", "NumpadEnter", 13, "\r", location=3),
    }


def _printable() -> dict[str, Key]:
    pairs = [
        *((each, each.upper(), f"Key{each.upper()}", ord(each.upper())) for each in string.ascii_lowercase),
        *(
            (digit, above, f"Digit{digit}", ord(digit))
            for digit, above in zip("1234567890", "!@#$%^&*()", strict=True)
        ),
        *(("-", "_", "Minus", 189), ("=", "+", "Equal", 187), ("[", "{", "BracketLeft", 219)),
        *(("]", "}", "BracketRight", 221), ("\\", "|", "Backslash", 220), (";", ":", "Semicolon", 186)),
        *(("'", '"', "Quote", 222), ("`", "~", "Backquote", 192), (",", "<", "Comma", 188)),
        *((".", ">", "Period", 190), ("/", "?", "Slash", 191)),
    ]
    keys = {" ": Key(" ", "Space", 32, " ")}
    for plain, shifted, code, number in pairs:
        keys[plain] = Key(plain, code, number, plain)
        keys[shifted] = Key(shifted, code, number, shifted, shift=True)
    return keys


NAMED = _named()
"""Keys that type no character of their own, by `KeyboardEvent.code`."""
PRINTABLE = _printable()
"""Keys by the character that they type."""
MODIFIERS = {"Alt": ALT, "Control": CONTROL, "Meta": META, "Shift": SHIFT}
_BY_CODE = {key.code: key for key in PRINTABLE.values() if not key.shift} | {
    "ControlOrMeta": NAMED["Control"],
    **{f"{name}Left": NAMED[name] for name in MODIFIERS},
}
_SHIFTED = {key.code: key for key in PRINTABLE.values() if key.shift}


def typed(character: str) -> Key:
    """The key that types a character; one without a place on the keyboard for a character that it lacks."""
    if character in ("\n", "\r"):
        return NAMED["Enter"]
    if character == "\t":
        return NAMED["Tab"]
    return PRINTABLE.get(character) or Key(character, "", 0, character)


def named(name: str) -> Key | None:
    """A key by its name (`Enter`, `KeyA`, `ArrowDown`), or by the character that it types. None for an unknown one."""
    return NAMED.get(name) or _BY_CODE.get(name) or (typed(name) if len(name) == 1 else None)


def miniwob(name: str) -> tuple[Key, int] | None:
    """Key and modifiers by MiniWoB++'s name: `<Enter>`, `a`, `A`, `C-c`, `S-<Tab>`. None for an unknown one."""
    modifiers = 0
    letters = {"A-": ALT, "C-": CONTROL, "M-": META, "S-": SHIFT}
    while name[:2] in letters and len(name) > 2:
        modifiers |= letters[name[:2]]
        name = name[2:]
    key = named(name[1:-1]) if len(name) > 2 and name[0] == "<" and name[-1] == ">" else PRINTABLE.get(name)
    return None if key is None else (key, modifiers | (SHIFT if key.shift else 0))


def combined(name: str) -> tuple[Key, int] | None:
    """Key and modifiers by BrowserGym's name: `Enter`, `Control+a`, `Shift+Tab`, `Control++`. None for an unknown
    one."""
    parts = [""]
    for character in name:
        if character == "+" and parts[-1]:
            parts.append("")
        else:
            parts[-1] += character
    *held, last = parts
    modifiers = 0
    for each in held:
        if each == "ControlOrMeta":
            each = "Control"
        if each not in MODIFIERS:
            return None
        modifiers |= MODIFIERS[each]
    key = named(last)
    return None if key is None else (key, modifiers | (SHIFT if key.shift else 0))


def shifted(key: Key) -> Key:
    """The key with the character that it types together with Shift."""
    return _SHIFTED.get(key.code, key)
