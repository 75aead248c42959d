"""How one CLI is spoken to: its arguments, and what the events of its stream mean. No I/O here.

`cli_agent.py` runs any dialect: it starts the program, feeds each line of its stream to a `TurnReader`, and decides from
what the reader has gathered whether the turn is done, failed, or to be resumed.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from evopolicy_gateway.harnesses.agent_config import AgentConfig
from evopolicy_gateway.harnesses.turn_failure import TurnFailure
from evopolicy_gateway.harnesses.usage import Usage

_MAX_VERSION_CHARS = 2000
_VERSION = re.compile(r"\d+\.\d+(?:\.\d+)?[\w.+-]*")


class TurnReader(ABC):
    """Gathers what one turn's stream tells."""

    def __init__(self) -> None:
        self.session: str | None = None
        """The session's id, once the stream has told it."""
        self.done = False
        """The agent has ended its turn as it should."""
        self.failure: TurnFailure | None = None
        """Why the turn failed; a turn that is done has none."""
        self.usage = Usage()
        """Of this turn so far, or of the whole session where the dialect is `cumulative`."""
        self.text = ""
        """What the agent said last."""
        self.action = ""
        """What it does now, for people who watch."""
        self.requests_failed = 0
        """Retries that the CLI made by itself."""

    @abstractmethod
    def read(self, event: Mapping[str, Any]) -> None:
        """Takes the next event; raises nothing for events it does not know."""


class Dialect(ABC):
    """One kind of CLI."""

    name: str
    program: tuple[str, ...]
    """Unless the operator names another."""
    cumulative = False
    """Its token counts are of the session, not of the turn."""
    tested_version = ""
    """Of the CLI that the dialect was last held against."""
    install = ""
    """How to get it."""
    makes_session_id = False
    """The first turn is given an id that we make."""
    resumes = True
    """Sessions can be continued."""
    help_args: tuple[str, ...] = ()
    """What makes it print its options; empty: they are not looked at."""
    prompt_on_stdin = True
    tells_end = True
    """Its stream says how a turn ended; otherwise the exit status does."""

    def __init__(self, config: AgentConfig) -> None:
        self.config = config

    @abstractmethod
    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        """After the program's name. `session`: to continue, or to begin under; `options`: the text of its help."""

    @abstractmethod
    def reader(self) -> TurnReader:
        """For the next turn."""

    def environment(self) -> dict[str, str]:
        """Variables that it needs besides the operator's."""
        return {}

    def required_options(self) -> list[str]:
        """Options that its help must list."""
        return []

    def version_args(self) -> tuple[str, ...]:
        return ("--version",)

    def version_in(self, text: str) -> str | None:
        """The version in what it says to `--version`."""
        found = _VERSION.search(text[:_MAX_VERSION_CHARS])
        return None if found is None else found.group(0)


def mapping(value: Any) -> Mapping[str, Any]:
    """The value if it is an object, else an empty one: streams are not to be trusted with their shape."""
    return value if isinstance(value, dict) else {}


def string(value: Any) -> str:
    return value if isinstance(value, str) else ""


def first_line(text: str, limit: int = 160) -> str:
    """For a live view: the first line that says something."""
    for line in text.splitlines():
        if stripped := line.strip():
            return stripped if len(stripped) <= limit else stripped[: limit - 1] + "…"
    return ""
