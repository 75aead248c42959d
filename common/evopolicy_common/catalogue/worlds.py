"""Worlds: ids such as `gym/acrobot@w1` of an environment under altered rules that its agent has to find out by playing.

The rules follow from a key, which is in the options of each of its cases, and as secret as their seeds.
"""

from __future__ import annotations

import re

N_WORLDS = 3
"""Worlds of each environment that has some."""
CANDIDATES = 16
"""Most candidates that are tried for an environment's worlds."""
OPTION = "world"
"""The key's name in a case's options."""
KEY = re.compile("[0-9a-f]{32}(-[0-9]{1,4})?")
"""The root of an environment's candidates, and which of them; files may have a key without number."""
_ID = re.compile(r"(.+)@w([1-9][0-9]*)")


def candidate(key: str) -> int | None:
    """The candidate's number in a key; None for a key without one, and for no key."""
    _, hyphen, number = key.partition("-")
    return int(number) if hyphen and KEY.fullmatch(key) else None


def unchanged(env_id: str) -> str:
    """The environment that a world alters; any other id is returned as it is."""
    match = _ID.fullmatch(env_id)
    return match[1] if match else env_id


def ids(env_id: str) -> tuple[str, ...]:
    return tuple(f"{env_id}@w{n}" for n in range(1, N_WORLDS + 1))
