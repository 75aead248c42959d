"""Writes `docs/reference/cli.md` from the commands themselves: `python docs/_site/commands.py >
docs/reference/cli.md`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from typing import Any, Literal, get_args, get_origin

import typer

from evopolicy_coordinator.cli.main import app as coordinator
from evopolicy_gateway.cli.main import app as front
from evopolicy_gateway.cli.serve import app as gateway
from evopolicy_worker.cli import app as worker


def page() -> str:
    """The page's Markdown."""
    apps = {"": front, "-coordinator": coordinator, "-worker": worker, "-gateway": gateway}
    parts = ["# Commands\n\nEvery command has `--help` with an example.\n"]
    for name, app in apps.items():
        parts += _described(f"evopolicy{name}", typer.main.get_command(app), 2)
    return "\n".join(parts)


def _described(name: str, command: Any, depth: int) -> Iterator[str]:
    yield f"{'#' * depth} {name}\n"
    yield _text(command.help or "") + "\n"
    options = [each for each in command.params if not getattr(each, "hidden", False) and each.name != "help"]
    if options:
        yield "| option | meaning |\n|---|---|"
        for each in options:
            yield f"| {_names(each)} | {_cell(each)} |"
        yield ""
    for sub in sorted(getattr(command, "commands", {})):
        yield from _described(f"{name} {sub}", command.commands[sub], min(depth + 1, 4))


def _names(option: Any) -> str:
    if option.param_type_name == "argument":
        return f"`{option.name.upper()}`"
    names = ", ".join(f"`{one}`" for one in [*option.opts, *option.secondary_opts])
    return f"{names} {_cell_text('|'.join(_choices(option.type_descriptor.annotation)))}".rstrip()


def _choices(annotation: Any) -> list[str]:
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return [str(one.value) for one in annotation]
    if get_origin(annotation) is Literal:
        return [str(one) for one in get_args(annotation)]
    return [one for part in get_args(annotation) for one in _choices(part)]


def _cell(option: Any) -> str:
    text, default = " ".join((getattr(option, "help", None) or "").split()), option.default
    shown = getattr(option, "show_default", False) and not callable(default)
    if shown and default not in (None, False, (), []):
        text += f" Default: {default}."
    return _cell_text(text)


def _cell_text(text: str) -> str:
    return text.replace("<", "&lt;").replace(">", "&gt;").replace("|", "&#124;")


def _text(text: str) -> str:
    return re.sub(r"<([A-Za-z])", r"&lt;\1", text.replace("\b", "").replace("\f", "").strip())


if __name__ == "__main__":
    print(page())
