"""Codes of records as people read them; files and scripts keep the codes."""

from __future__ import annotations

_WORDS = {
    "no_ok_submit": "no working submit",
    "error": "failed",
    "silent": "agent silent",
    "told": "stopped by its command",
    "wall_limit": "time limit reached",
}


def in_words(code: str) -> str:
    """A status of a run or a submit, or the reason why an agent ended, in words."""
    return _WORDS.get(code, code.replace("_", " "))
