"""Compares the commands in documents with the commands themselves. Runs nothing."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import typer

from evopolicy_coordinator.cli import main as coordinator_cli
from evopolicy_gateway.cli import main as gateway_cli
from evopolicy_worker import cli as worker_cli

APPS = {
    "evopolicy": gateway_cli.app,
    "evopolicy-coordinator": coordinator_cli.app,
    "evopolicy-worker": worker_cli.app,
}


def blocks_of_commands(path: Path) -> list[list[list[str]]]:
    """For each fenced block that has any, our own commands in order, as words, whatever they are started with; none of
    diagrams."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", path.read_text(), re.DOTALL | re.MULTILINE)
    plain = [text for language, text in blocks if not language and "─" not in text]
    found = [[_command(line) for line in text.splitlines()] for text in plain]
    return [rows for block in found if (rows := [words for words in block if words])]


@cache
def commands() -> tuple[tuple[str, Any], ...]:
    """Every command of ours that does something, by its whole name."""
    return tuple(each for name in APPS for each in _below(name, _program(name)))


@cache
def _program(name: str) -> Any:
    return typer.main.get_command(APPS[name])


def parse(words: list[str]) -> None:
    """Fails when the command does not take these words."""
    command = _program(words[0])
    arguments = words[1:]
    name: str | None = words[0]
    while name is not None:
        context = command.make_context(name, list(arguments))
        rest = [*getattr(context, "_protected_args", getattr(context, "protected_args", [])), *context.args]
        name = None
        if rest:
            name, command, arguments = command.resolve_command(context, rest)


def _below(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    inner = getattr(command, "commands", {})
    if not inner or command.invoke_without_command:
        yield name, command
    for word, each in inner.items():
        yield from _below(f"{name} {word}", each)


def _command(line: str) -> list[str]:
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        return []
    for index, word in enumerate(words):
        name = word.rpartition("/")[2]
        # The shortest of the names is also that of a user and a folder: it counts at the beginning only.
        if name in APPS and (index == 0 or name != "evopolicy") and words[index + 1 :]:
            return [name, *takewhile(lambda word: word not in (">", "|", "&"), words[index + 1 :])]
    return []
