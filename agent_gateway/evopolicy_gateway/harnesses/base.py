"""What a harness is: how one kind of agent is started, talked to and read, from its first word to its last.

A harness runs in the agent's keeper (`keeper.py`), which holds no credentials: it knows the workspace and the three URLs.
It does not end processes and does not watch the clock; the keeper does both.
"""

from __future__ import annotations

import asyncio
import json
import urllib.request
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import EvopolicyError
from evopolicy_gateway.harnesses.agent_log import AgentLog
from evopolicy_gateway.harnesses.agent_process import AgentProcess

_INFO_TIMEOUT_S = 30.0


class AgentError(EvopolicyError):
    """The agent cannot be started, or its harness cannot make sense of it; for the operator."""


class Ending(msgspec.Struct, frozen=True, kw_only=True):
    """How an agent ended by itself."""

    reason: Literal["agent_stopped", "agent_failed"]
    detail: str = ""
    turns: int = 0
    """Prompts that it answered."""
    retries: int = 0
    facts: dict[str, Any] = {}
    """What else `run.json` tells: `cli_version`, `model_string`, `settings`, `tokens`."""


class Stage(msgspec.Struct, frozen=True, kw_only=True):
    """Where an agent plays."""

    workspace: Path
    """Its working directory."""
    urls: Mapping[str, str]
    """The `EVOPOLICYGYM_*` variables."""
    environment: Mapping[str, str]
    """All its variables, those of `urls` too."""
    log: AgentLog
    on_turn: Callable[[int, str], None]
    """Told what the agent says, for people who watch."""
    started: list[int] = []
    """Ids of the processes that `start` has started, whose exit status it takes."""

    async def start(self, program: list[str], *, talks: bool) -> AgentProcess:
        """Starts a program of the agent in the workspace; `talks`: it is written to. AgentError when it cannot be."""
        try:
            process = await AgentProcess.start(
                program, self.workspace, self.environment, self.log, talks=talks
            )
        except OSError as error:
            raise AgentError(f"cannot start {program[0]}: {error.strerror or error}") from error
        self.started.append(process.pid)
        return process

    async def info(self) -> dict[str, Any]:
        """What `/info` says now. OSError when the gateway does not answer."""
        return await asyncio.to_thread(_get_json, self.urls["EVOPOLICYGYM_INFO_URL"])


class Harness(ABC):
    """One kind of agent."""

    name: str
    """As `run.json` names it: `command`, `replay`, `evolve`, …"""

    @abstractmethod
    async def play(self, stage: Stage) -> Ending:
        """Plays until the agent stops by itself. Cancelled when the run is over for another reason."""


# The gateway is on this machine; a proxy from the surroundings must not be asked for it.
_opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _get_json(url: str) -> dict[str, Any]:
    with _opener.open(url, timeout=_INFO_TIMEOUT_S) as answer:
        document = json.load(answer)
    return dict(document)
