"""Hints that can be pasted: our programs as they were called, and the command that adds an extra."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import sys
from functools import cache
from pathlib import Path

COMMANDS = (
    "accept-worlds|backup|certs|check|check-env|data|demo|diff|disk|doctor|envs|epoch|export|files"
    "|finish|gc|harbor|identity|leaderboard|local|move|publish|replay|report|rescore|router-config|run|runs"
    "|setup|status|suite|try|verify|web|workers"
)
"""First words of our programs' commands, as a pattern."""
# A program is followed by a command, an option or a value's name. Help is general, and `there:` is another machine.
_COMMAND = re.compile(
    r"(?<![\w./'-])(?<!there: )(?<!Usage: )(?<!Example: )evopolicy(?:-coordinator|-gateway|-worker)?"
    rf"(?= (?:-[-\w]|[A-Z]{{2}}|(?:{COMMANDS})(?![\w-])))"
)


def as_called(text: str) -> str:
    """The text with our commands as they can be called from here, such as `.venv/bin/evopolicy report`."""
    return _COMMAND.sub(lambda match: program(match[0]), text) if "evopolicy" in text else text


def program(name: str) -> str:
    """How a shell in this folder calls a program of this installation: by name if the PATH has it, or else by path."""
    called = sys.argv[0]
    beside = called if os.path.basename(called).startswith("evopolicy") and "/" in called else sys.executable
    path = os.path.join(os.path.dirname(beside), name)
    if not os.path.exists(path):
        return name
    on_path = shutil.which(name)
    if on_path is not None and os.path.samefile(on_path, path):
        return name
    return shlex.quote(_near(path))


def add_extra(extra: str) -> str:
    """The command that adds an extra to this installation, from the clone or the wheel that it was made of."""
    python = shlex.quote(_near(sys.executable))
    pip = (
        f"{python} -m pip install" if importlib.util.find_spec("pip") else f"uv pip install --python {python}"
    )
    url, is_folder = source()
    if is_folder:
        from urllib.parse import unquote, urlsplit

        folder = unquote(urlsplit(url).path)
        return f"{pip} -e '{'.' if Path(folder) == Path.cwd() else folder}[{extra}]'"
    return f"{pip} 'evopolicy[{extra}] @ {url}'"


def _near(path: str) -> str:
    near = os.path.relpath(path) if os.path.isabs(path) else path
    return path if near.startswith("..") else near


@cache
def source() -> tuple[str, bool]:
    """The URL that pip or uv installed this distribution from, and whether it is a folder."""
    import importlib.metadata
    import json

    made = importlib.metadata.distribution("evopolicy")
    record = json.loads(made.read_text("direct_url.json") or "{}")
    wheel = f"file:///path/to/evopolicy-{made.version}-py3-none-any.whl"
    return record.get("url", wheel), "dir_info" in record
