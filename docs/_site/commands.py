"""Writes `docs/reference/cli.md` from the commands themselves: `python docs/_site/commands.py >
docs/reference/cli.md`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from enum import Enum
from typing import Any, Literal, get_args, get_origin

import typer

from evopolicy_coordinator.cli.main import app as coordinator
from evopolicy_gateway.cli.main import app as front
from evopolicy_gateway.declared import SET, declared
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.run_options import ListenerOptions, RunOptions
from evopolicy_worker.cli import app as worker

OF_A_RUN = {
    SET,
    *(one.flag for each in (RunOptions, JailSettings, ListenerOptions) for one in declared(each).values()),
}
"""Options that `options.md` describes."""
TYPER = ("help", "install_completion", "show_completion")
"""Options that typer adds."""


def page() -> str:
    """The page's Markdown. A row that several commands have is in one list at its start, one for each option."""
    apps = {"": front, "-coordinator": coordinator, "-worker": worker}
    trees = {f"evopolicy{name}": typer.main.get_command(app) for name, app in apps.items()}
    found = [each for name, command in trees.items() for each in _commands(name, command, 2)]
    rows = Counter(
        (each.opts[0], _row(each))
        for _, command, _ in found
        for each in _options(command)
        if not _of_a_run(command, each)
    )
    shared = {name: row for (name, row), times in reversed(rows.most_common()) if times > 1}.values()
    parts = [
        "# Commands\n\nEvery command has `--help` with an example. `evopolicy run`, `local`, and `suite` also have the"
        " [options of a run](options.md). An option with `…` may be"
        " repeated. Several commands share these options:\n",
        *sorted(shared),
        "",
    ]
    for name, command, depth in found:
        parts += [f"{'#' * depth} {name}\n", _text(command.help or "") + "\n"]
        options = [each for each in _options(command) if not _of_a_run(command, each)]
        if own := [_row(each) for each in options if _row(each) not in shared]:
            parts += [*own, ""]
        if also := [f"`{each.opts[0]}`" for each in options if _row(each) in shared]:
            parts.append(f"Also {', '.join(also)}.\n")
        if of_a_run := [f"`{each.opts[0]}`" for each in _options(command) if _of_a_run(command, each)]:
            some = f": {', '.join(of_a_run)}" if command.name == "suite" else ""
            parts.append(f"Also [options of a run](options.md){some}.\n")
    return "\n".join(parts)


def _commands(name: str, command: Any, depth: int) -> Iterator[tuple[str, Any, int]]:
    yield name, command, depth
    for sub in sorted(getattr(command, "commands", {})):
        yield from _commands(f"{name} {sub}", command.commands[sub], min(depth + 1, 4))


def _options(command: Any) -> list[Any]:
    return [each for each in command.params if not getattr(each, "hidden", False) and each.name not in TYPER]


def _of_a_run(command: Any, option: Any) -> bool:
    return command.name in ("run", "local", "suite") and option.opts[0] in OF_A_RUN


def _row(option: Any) -> str:
    return f"- {_names(option)}: {_meaning(option)}"


def _names(option: Any) -> str:
    if option.param_type_name == "argument":
        return f"`{option.name.upper()}`"
    names = ", ".join(f"`{one}`" for one in [*option.opts, *option.secondary_opts])
    names += "…" * option.multiple
    return f"{names} {_plain('|'.join(_choices(option.type_descriptor.annotation)))}".rstrip()


def _choices(annotation: Any) -> list[str]:
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return [str(one.value) for one in annotation]
    if get_origin(annotation) is Literal:
        return [str(one) for one in get_args(annotation)]
    return [one for part in get_args(annotation) for one in _choices(part)]


def _meaning(option: Any) -> str:
    text, default = " ".join((getattr(option, "help", None) or "").split()), option.default
    text = text.replace("; may be repeated", "")
    shown = getattr(option, "show_default", False) and not callable(default)
    if shown and default not in (None, False, "", (), []):
        text += f" Default: {default}."
    return _plain(text)


def _plain(text: str) -> str:
    return text.replace("<", "&lt;").replace(">", "&gt;")


def _text(text: str) -> str:
    text = re.sub(r"Example: .*\n+", "", text.replace("\b", "").replace("\f", ""))
    return re.sub(r"<([A-Za-z])", r"&lt;\1", text.strip())


if __name__ == "__main__":
    print(page())
