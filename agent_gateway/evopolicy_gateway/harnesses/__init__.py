"""Agents by the name that `--agent` gives them."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses.base import Harness
from evopolicy_gateway.harnesses.command import CommandHarness

FORMS = "evolve, random, replay:DIR, command:PROGRAM…"


def entry_name(agent: str) -> str:
    """The leaderboard entry that an agent gets when the operator names none: `evolve`, `replay-gaits`, `command-run.sh`."""
    kind, _, rest = agent.partition(":")
    if kind == "replay":
        return f"replay-{Path(rest).resolve().name}"
    if kind == "command" and rest.strip():
        return f"command-{Path(_split(rest)[0]).name}"
    return kind


def make(agent: str, started_in: Path) -> Harness:
    """The harness of `--agent`. ConfigError for what is none, or names what is not there.

    Files in a command or after `replay:` are meant from `started_in`: the agent itself runs elsewhere.
    """
    kind, colon, rest = agent.partition(":")
    if kind in ("evolve", "random") and not colon:
        module = {"evolve": "evolve", "random": "uniform"}[kind]
        return CommandHarness(kind, _ours(module))
    if kind == "replay" and rest:
        folder = (started_in / rest).resolve()
        if not folder.is_dir():
            raise ConfigError(f"--agent {agent}: {folder} is not a folder")
        return CommandHarness("replay", [*_ours("replay"), str(folder)], {"folder": str(folder)})
    if kind == "command" and rest.strip():
        return CommandHarness("command", _program(agent, _split(rest), started_in))
    raise ConfigError(f"--agent {agent!r} is not an agent; there are {FORMS}")


def _ours(module: str) -> list[str]:
    # -P: modules in the workspace, which the agent writes, must not take the place of installed ones.
    return [sys.executable, "-P", "-m", f"evopolicy_gateway.agents.{module}"]


def _split(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"--agent command:{command}: {error}") from error


def _program(agent: str, words: list[str], started_in: Path) -> list[str]:
    """The command with files that lie where it was given named absolutely."""
    # Links stay links: a virtual environment's python is one, and another program without it.
    resolved = [
        os.path.abspath(started_in / word) if (started_in / word).is_file() else word for word in words
    ]
    if shutil.which(resolved[0]) is None:
        raise ConfigError(f"--agent {agent}: no program {words[0]!r}, neither a file here nor on the PATH")
    return resolved
