"""Task texts: one Markdown file per environment, from which alone one could write a policy.

A file is named after the suite id with `/` as `_`. A line `<!-- include: NAME -->` stands for another file of this
folder: what several environments share is written once. Form of a text: an objective; `## Observation` with a table
whose first column names components (`0`, `0–4`, `image[0–6, 0–6, 0]`, `direction`); `## Action` with a table whose
first column names dimensions or choices; `## Reward`; `## Start`; `## End`. A test reads the tables and holds them
against the spaces.
"""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files

_INCLUDE = re.compile(r"^<!-- include: ([\w.-]+) -->$", re.MULTILINE)


@cache
def task_text(env_id: str) -> str:
    """The Markdown text of an environment. FileNotFoundError when none is written."""
    return _read(env_id.replace("/", "_") + ".md")


def _read(name: str) -> str:
    text = files(__package__).joinpath(name).read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda match: _read(match[1]).rstrip("\n"), text)
