"""The interface of a CLI's dialect: its arguments, and the meaning of its stream's events. No I/O.

`cli_agent.py` runs any dialect: it starts the program, feeds each line of its stream to a `TurnReader`, and then
decides by the reader's state whether the turn is complete, failed, or to be resumed.
"""

from __future__ import annotations

import itertools
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from evopolicy_gateway.harnesses.coding_agents.turn_failure import TurnFailure
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig, TokenPaths
from evopolicy_gateway.inputs.kept import KeptInputs
from evopolicy_gateway.processes.child_messages import RelayAddress
from evopolicy_gateway.relay.answers import values
from evopolicy_gateway.relay.usage import Usage, count

_MAX_VERSION_CHARS = 2000
_VERSION = re.compile(r"\d+\.\d+(?:\.\d+)?[\w.+-]*")


class TurnReader(ABC):
    """Collects the state of one turn from its stream."""

    def __init__(self) -> None:
        self.session: str | None = None
        """The session's id, once the stream has reported it."""
        self.done = False
        """Whether the agent completed its turn."""
        self.failure: TurnFailure | None = None
        """Why the turn failed; None for a completed turn."""
        self.usage = Usage()
        """Token use of this turn so far, or of the whole session if the dialect is `cumulative`."""
        self.text = ""
        """The agent's latest text."""
        self.action = ""
        """The agent's present action, for people who watch."""
        self.requests_failed = 0
        """Number of retries by the CLI itself."""

    @abstractmethod
    def read_event(self, event: Mapping[str, object]) -> None:
        """Processes the next event; ignores unknown events."""


class Dialect(ABC):
    name: str
    program: tuple[str, ...]
    cumulative = False
    """Whether its token counts are of the session, not of the turn."""
    tested_version = ""
    """Version of the CLI with which the dialect was last tested."""
    install = ""
    makes_session_id = False
    """Whether the first turn starts under an id that we generate."""
    resumes = True
    help_args: tuple[str, ...] = ()
    """Arguments that make the CLI print its options; empty: its options are not checked."""
    prompt_on_stdin = True
    packages: tuple[str, ...] = ()
    """Distributions of our Python that its program imports."""
    version_args: tuple[str, ...] = ("--version",)
    skills_at = "~/.agents/skills"
    """Folder in which the CLI looks for skills."""
    takes_variables = True
    """Whether its program reads the relay's address and token from variables, which its commands see too."""
    tells_end = True
    """Whether its stream reports how a turn ended; otherwise the exit status does."""

    def __init__(self, config: AgentConfig) -> None:
        self.config = config
        self.kept = KeptInputs()
        """The run's skills and MCP servers."""
        self.relay: RelayAddress | None = None
        """Where its program finds the model; None: at the provider."""

    @abstractmethod
    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        """Arguments after the program's name. `session`: the session to resume or start; `options`: the help text."""

    @abstractmethod
    def reader(self) -> TurnReader:
        """A reader for the next turn."""

    def stdin(self, prompt: str) -> str:
        """Input on stdin, for a program that reads its prompt there."""
        return prompt

    def environment(self) -> dict[str, str]:
        """Variables that it needs besides the operator's."""
        return {}

    def required_options(self) -> list[str]:
        return []

    def version_in(self, text: str) -> str | None:
        """The version in its `--version` output; None if there is none."""
        match = _VERSION.search(text[:_MAX_VERSION_CHARS])
        return match and match[0]


def usage_of(event: Mapping[str, object], paths: TokenPaths) -> Usage | None:
    """The paper's token counts from an event of a stream, of which nothing is trusted; None without counts."""
    counts: dict[str, int] = {}
    for name in ("input", "cache_read", "cache_creation", "output", "reasoning", "total"):
        numbers = (value for value in values(event, getattr(paths, name)) if isinstance(value, int))
        for value in itertools.islice(numbers, 1):
            counts[name] = count(value)
    if not counts:
        return None
    given, cached = counts.get("input", 0), counts.get("cache_read", 0)
    return Usage(
        input_noncached=max(0, given - (cached if paths.input_includes_cached else 0)),
        cache_read=cached,
        cache_creation=counts.get("cache_creation", 0),
        output=max(counts.get("output", 0), counts.get("total", 0) - given),
        reasoning=counts.get("reasoning"),
    )


def mapping(value: object) -> Mapping[str, Any]:
    """The value if it is an object, else an empty one: a stream's structure is not trusted."""
    return value if isinstance(value, dict) else {}


def mappings(value: object) -> list[Mapping[str, Any]]:
    """The objects in a list; none if the value is no list."""
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []


def string(value: object) -> str:
    return value if isinstance(value, str) else ""


def first_line(text: str, limit: int = 160) -> str:
    """The first line that is not blank, cut to `limit` characters, for a live view."""
    for line in text.splitlines():
        if stripped := line.strip():
            return stripped if len(stripped) <= limit else stripped[: limit - 1] + "…"
    return ""
