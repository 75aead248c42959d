"""`evopolicy files`, `texts` and `schema`: what comes with the package besides code."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Literal

import typer

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError
from evopolicy_common.terminal import say_json, say_lines
from evopolicy_gateway import shipped
from evopolicy_gateway.cli import schemas
from evopolicy_gateway.workspace import agents_md, prompts

app = App()


@app.command("files", epilog="Example: evopolicy files deploy --to .")
def files(
    name: Annotated[
        str, typer.Argument(help="A file or folder, such as deploy or constraints.txt; default: all.")
    ] = "",
    to: Annotated[Path | None, typer.Option(help="Copy the files into this folder.")] = None,
) -> None:
    """List or copy the examples, deployment files and pages that come with evopolicy.

    Commands find these files under the names in the documentation, unless the current folder has a file of that name.
    """
    with fail_on_our_errors():
        wanted = name.rstrip("/")
        chosen = [
            (each, place)
            for each, place in shipped.files()
            if not wanted or each == wanted or each.startswith(f"{wanted}/")
        ]
        if not chosen:
            raise ConfigError(f"no file {name!r} comes with evopolicy; `evopolicy files` lists all")
        if to is None:
            # One file is given as its place, for other programs: pip install -c "$(evopolicy files constraints.txt)".
            say_lines([str(chosen[0][1])] if chosen[0][0] == wanted else [each for each, _ in chosen])
            return
        targets = [to / each for each, _ in chosen]
        there = [target for target in targets if target.exists()]
        if there:
            raise ConfigError(f"{there[0]} already exists; choose another folder with --to")
        for target, (_, place) in zip(targets, chosen, strict=True):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(place, target)
        say_lines([f"{len(chosen)} files copied to {to}"])


@app.command("texts", epilog="Example: evopolicy texts prompts > prompts.toml")
def texts(
    which: Annotated[
        Literal["agents-md", "prompts"],
        typer.Argument(help="The option that the text is for.", show_default=False),
    ],
) -> None:
    """Print the standard texts for agents, as templates for --agents-md and --prompts."""
    if which == "agents-md":
        say_lines(agents_md.STANDARD.splitlines())
        return
    for name, text in prompts.STANDARD.items():
        say_lines([f'{name} = """\\', f'{text}"""'])


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
