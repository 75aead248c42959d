"""`evopolicy files`: what comes with the package besides code, and the files that it can write."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
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
    """List, print or copy the examples, deployment files, standard texts, schemas and pages that come with evopolicy.

    Commands find these files under the names in the documentation, unless the current folder has a file of that name.
    texts/ has the standard texts of agents, templates for the settings agents_md and prompts; schemas/ has the JSON
    Schema of each file.
    """
    with fail_on_our_errors():
        wanted = name.rstrip("/")
        if wanted in (made := _made()) and to is None:
            if wanted.startswith("schemas/"):
                say_json(msgspec.json.decode(made[wanted]()))
            else:
                say_lines(made[wanted]().splitlines())
            return
        everything: list[tuple[str, Path | Callable[[], str]]] = [*shipped.files(), *made.items()]
        chosen = [
            (each, place)
            for each, place in everything
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
            if isinstance(place, Path):
                shutil.copyfile(place, target)
            else:
                target.write_text(place(), encoding="utf-8")
        say_lines([f"{len(chosen)} files copied to {to}"])


def _made() -> dict[str, Callable[[], str]]:
    """The files that are written on demand, by name."""
    texts: dict[str, Callable[[], str]] = {
        "texts/agents.md": lambda: agents_md.STANDARD,
        "texts/prompts.toml": lambda: (
            "\n".join(f'{name} = """\\\n{text}"""' for name, text in prompts.STANDARD.items()) + "\n"
        ),
    }
    return texts | {f"schemas/{name}.schema.json": partial(_schema, name) for name in schemas.KINDS}


def _schema(name: str) -> str:
    return msgspec.json.format(msgspec.json.encode(schemas.schema(name)), indent=2).decode() + "\n"
