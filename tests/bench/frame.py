"""What the benches share: options, tables, and files of results."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


def options(doc: str | None, **known: tuple[Any, ...]) -> argparse.Namespace:
    """The command line of a bench: for each option its default, help, and choices if there are some.

    Instead of a default, a type stands for None. False is a flag; a list takes several values.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, (default, text, *choices) in known.items():
        how: dict[str, Any] = {"action": "store_true"}
        if isinstance(default, type):
            how = {"type": default}
        elif isinstance(default, list):
            how = {"nargs": "+", "default": default, "type": type(default[0])}
        elif default is not False:
            how = {"type": type(default), "default": default}
        how |= {"choices": choices[0]} if choices else {}
        shown = " ".join(map(str, default)) if isinstance(default, list) else default
        text += f" (default: {shown})" if how.get("default") else ""
        parser.add_argument(f"--{name.replace('_', '-')}", help=text, **how)
    return parser.parse_args()


def console() -> Console:
    """As wide as the terminal; without one, wide enough for names, which its 80 columns would cut."""
    return Console(width=None if sys.stdout.isatty() else 160)


def table(*headings: str, title: str | None = None) -> Table:
    """A table whose first column has words, and the others numbers."""
    made = Table(title=title)
    for number, heading in enumerate(headings):
        made.add_column(heading, justify="right" if number else "left")
    return made


def save(path: Path | None, found: Any) -> None:
    """Writes all numbers where `--json` says."""
    if path is not None:
        path.write_text(json.dumps(found, indent=2) + "\n")


def cpu_s(stat: str | int) -> float:
    """User and system time of a process, or of the thread of a path's `stat`, seconds."""
    text = Path(f"/proc/{stat}/stat" if isinstance(stat, int) else stat).read_text()
    fields = text.rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
