"""Runs a typer app with this project's manners: a wrong option is one line on stderr and exit code 2."""

from __future__ import annotations

from typing import Any

import typer

from evopolicy_common.cli import USAGE_ERROR, fail

# typer brings click with it, under a name of its own in newer versions: only its public exceptions lead there.
_ClickError: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")


def run_app(app: typer.Typer) -> None:
    """Runs the command that `sys.argv` names, and exits."""
    try:
        code = typer.main.get_command(app).main(standalone_mode=False)
    except _ClickError as error:
        fail(" ".join(error.format_message().split()) or "wrong usage; see --help", USAGE_ERROR)
    except (typer.Abort, KeyboardInterrupt):
        fail("interrupted", 130)
    raise SystemExit(code if isinstance(code, int) else 0)
