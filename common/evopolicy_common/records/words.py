"""Codes of records as people read them, while files and scripts keep the codes; the canary string, which occurs nowhere
else, so that data sets can be searched for this project's files."""

from __future__ import annotations

CANARY = (
    "evopolicy canary 3f1b2a54-6c0e-4c0d-9d0a-7e5b7c1d9f46: published results must never be training data"
)
"""In `AGENTS.md`, and in the manifest of published results. Never changed: files of all versions have it."""


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
