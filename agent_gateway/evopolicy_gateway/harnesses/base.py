"""What a harness is: how one kind of agent is started, talked to and read, from its first word to its last.

A harness runs in the agent supervisor (`supervisor.py`), which holds no credentials: it knows the workspace and the three URLs.
It does not end processes and does not watch the clock; the agent supervisor does both.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import urllib.request
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import EvopolicyError
from evopolicy_gateway.agent_supervisor.agent_log import AgentLog
from evopolicy_gateway.agent_supervisor.agent_process import AgentProcess
from evopolicy_gateway.agent_supervisor.clock import Activity, AgentClock
from evopolicy_gateway.jail.jail import Jail
from evopolicy_gateway.operator.child_messages import AgentDoing, AgentEnded

_INFO_TIMEOUT_S = 30.0


class AgentError(EvopolicyError):
    """The agent cannot be started, or its harness cannot make sense of it; for the operator."""


def _nobody_watches(_: AgentDoing) -> None:
    pass


class Stage(msgspec.Struct, frozen=True, kw_only=True):
    """Where an agent plays."""

    workspace: Path
    """Its working directory."""
    urls: Mapping[str, str]
    """The `EVOPOLICYGYM_*` variables that hold URLs."""
    environment: Mapping[str, str]
    """All its variables, the `EVOPOLICYGYM_*` ones too."""
    log: AgentLog
    on_turn: Callable[[int, str], None]
    """Told what the agent says, for people who watch."""
    started: list[int] = []
    """Ids of the processes that `start` has started, whose exit status it takes."""
    session_file: Path | None = None
    """Where a session is kept, so that it goes on after its agent supervisor was killed."""
    on_doing: Callable[[AgentDoing], None] = _nobody_watches
    clock: AgentClock = msgspec.field(default_factory=lambda: AgentClock(float("inf")))
    activity: Activity | None = None
    """None: nobody asks whether it is silent."""
    over: asyncio.Event = msgspec.field(default_factory=asyncio.Event)
    """Set when the agent's time is over: a program that ends from now on has been ended, and is not started again."""
    jail: Jail | None = None
    """Around every program that `start` starts."""

    def with_environment(self, more: Mapping[str, str]) -> Stage:
        """The same stage with more variables."""
        return msgspec.structs.replace(self, environment={**self.environment, **more})

    async def sleep(self, seconds: float) -> None:
        """Waits, but not beyond the agent's time."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.over.wait(), seconds)

    async def start(self, program: list[str], *, talks: bool) -> AgentProcess:
        """Starts a program of the agent in the workspace; `talks`: it is written to. AgentError when it cannot be."""
        way = None if self.jail is None else self.jail.way(program)
        try:
            process = await AgentProcess.start(
                program if way is None else way.words,
                self.workspace,
                self.environment,
                self.log,
                talks=talks,
                pass_fds=() if way is None else way.pass_fds,
            )
        except OSError as error:
            if way is not None:
                way.failed()
            raise AgentError(f"cannot start {program[0]}: {error.strerror or error}") from error
        if way is not None:
            way.started(process.ended)
        self.started.append(process.pid)
        return process

    async def info(self) -> dict[str, Any]:
        """What `/info` says now. OSError when the gateway does not answer."""
        return await asyncio.to_thread(_get_json, self.urls["EVOPOLICYGYM_INFO_URL"])


class Harness(ABC):
    """One kind of agent."""

    name: str
    """As `run.json` names it: `command`, `replay`, `evolve`, …"""
    command: Sequence[str] = ()
    """Words of the operator's command, whose files a jail shows; nothing that an agent has said."""
    variables: Sequence[str] = ()
    """Variables of the operator that the agent's settings pass on, into a jail too."""
    resumable = False
    """It goes on from `Stage.session_file` after everything of it was killed."""

    def known(self) -> dict[str, Any]:
        """Facts for `run.json` that do not depend on how it ends: where nobody is left who could tell the others."""
        return {}

    def check(self) -> None:  # noqa: B027
        """ConfigError where the agent cannot be started on this machine; to be asked before a run is opened."""

    @abstractmethod
    async def play(self, stage: Stage) -> AgentEnded:
        """Plays until the agent stops by itself. Cancelled when the run is over for another reason."""


# The gateway is on this machine; a proxy from the surroundings must not be asked for it.
_opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _get_json(url: str) -> dict[str, Any]:
    try:
        with _opener.open(url, timeout=_INFO_TIMEOUT_S) as answer:
            document = json.load(answer)
    except HTTPException as error:  # a gateway that was killed while it answered
        raise OSError(f"{url} did not answer to the end: {error!r}") from error
    return dict(document)
