"""A command's output as a picture of a terminal.

python examples/smoke-report/capture_terminal.py PICTURE.svg COLUMNS COMMAND…
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

from capture_view import FETCHED_FONT
from rich.console import Console
from rich.text import Text


def main() -> None:
    picture, columns, *command = sys.argv[1:]
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        env={**os.environ, "COLUMNS": columns},
    )
    console = Console(record=True, width=int(columns), file=io.StringIO(), force_terminal=True)
    console.print(Text(done.stdout.rstrip("\n")))
    drawn = console.export_svg(title=" ".join(command))
    Path(picture).write_text(FETCHED_FONT.sub("", drawn), encoding="utf-8")


if __name__ == "__main__":
    main()
