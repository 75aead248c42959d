"""Our own commands in the fenced blocks of a Markdown file, as words, whatever they are started with."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

PROGRAMS = ("evopolicy", "evopolicy-coordinator", "evopolicy-worker")


def readme_commands(path: Path) -> list[list[list[str]]]:
    """For each block that has any, its commands in order; the program's name without its folder."""
    blocks = re.findall(r"```\n(.*?)```", path.read_text(), re.DOTALL)
    found = [[_command(line) for line in block.splitlines()] for block in blocks]
    return [told for block in found if (told := [words for words in block if words])]


def _command(line: str) -> list[str]:
    words = shlex.split(line, comments=True)
    for index, word in enumerate(words):
        name = word.rpartition("/")[2]
        # The shortest of the names is also that of a user and a folder: it counts at the beginning only.
        if name in PROGRAMS and (index == 0 or name != "evopolicy") and words[index + 1 :]:
            return [name, *words[index + 1 :]]
    return []
