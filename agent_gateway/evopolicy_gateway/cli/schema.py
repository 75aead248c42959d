"""`evopolicy schema`: JSON Schemas of the project's files."""

from __future__ import annotations

from typing import Annotated

import typer

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.cli.frame import App
from evopolicy_common.terminal import say_json, say_lines
from evopolicy_gateway.cli import schemas

app = App()


@app.command("schema", epilog="Example: evopolicy schema suite.toml > suite.schema.json")
def schema(
    name: Annotated[
        str, typer.Argument(help="Name of the file, such as run.json; default: list the names.")
    ] = "",
) -> None:
    """Print the JSON Schema of one of evopolicy's files."""
    with fail_on_our_errors():
        if not name:
            say_lines([f"{each:<14}{kind.about}" for each, kind in schemas.KINDS.items()])
            return
        say_json(schemas.schema(name))
