"""The interface of a harness, which starts one kind of agent, sends it prompts and reads its output.

A harness runs in the agent supervisor (`supervisor.py`), which holds no credentials: it knows the workspace and the
three URLs. It neither ends the agent's processes at the run's end nor watches the wall clock; the agent supervisor does
both.
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
from evopolicy_gateway.inputs.kept import KeptInputs
from evopolicy_gateway.jail.jail import Jail
from evopolicy_gateway.processes.agent_process import AgentLog, AgentProcess
from evopolicy_gateway.processes.child_messages import AgentDoing, AgentEnded, RelayAddress
from evopolicy_gateway.processes.clock import Activity, AgentClock
from evopolicy_gateway.relay.limits import ModelTerms
from evopolicy_gateway.workspace.prompts import Prompts

_INFO_TIMEOUT_S = 30.0


class AgentError(EvopolicyError):
    """The agent cannot be started, or its harness cannot interpret its output; for the operator."""


class Stage(msgspec.Struct, frozen=True, kw_only=True):
    """The surroundings in which an agent runs."""

    workspace: Path
    """The agent's working directory."""
    urls: Mapping[str, str]
    """The `EVOPOLICYGYM_*` variables that hold URLs."""
    environment: Mapping[str, str]
    """All variables of the agent, including the `EVOPOLICYGYM_*` ones."""
    log: AgentLog
    on_turn: Callable[[int, str], None]
    """Called with a turn's number and the agent's text, for people who watch."""
    started: list[int] = []
    """Ids of the processes started by `start`, which also collects their exit status."""
    session_file: Path | None = None
    """File of the session's state, with which the session resumes after its agent supervisor was killed."""
    on_doing: Callable[[AgentDoing], None] = lambda _: None
    clock: AgentClock = msgspec.field(default_factory=lambda: AgentClock(float("inf")))
    activity: Activity | None = None
    """None: inactivity is not watched."""
    over: asyncio.Event = msgspec.field(default_factory=asyncio.Event)
    """Set when the agent's time is up: programs that end after that were ended, and are not restarted."""
    prompts: Prompts = Prompts()
    tells_left: bool = False
    """Whether prompts say how much of the agent's time and tokens is left."""
    jail: Jail | None = None
    """The jail of every program that `start` starts."""
    joins: Sequence[str] = ()
    """The agent's cgroups, as in `ending_with_parent`."""

    async def sleep(self, seconds: float) -> None:
        """Sleeps, but not beyond the agent's time."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.over.wait(), seconds)

    async def start(self, program: list[str], *, talks: bool) -> AgentProcess:
        """Starts a program of the agent in the workspace. `talks`: its stdin is a pipe. Raises AgentError when that
        fails."""
        way = None if self.jail is None else self.jail.way(program)
        try:
            process = await AgentProcess.start(
                program if way is None else way.words,
                self.workspace,
                self.environment,
                self.log,
                talks=talks,
                pass_fds=() if way is None else way.pass_fds,
                joins=self.joins,
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
        """The present content of `/info`. Raises OSError when the gateway does not answer."""
        return await asyncio.to_thread(_get_json, self.urls["EVOPOLICYGYM_INFO_URL"])


class Harness(ABC):
    name: str
    """Name in `run.json`: `command`, `replay`, `evolve`, …"""
    command: Sequence[str] = ()
    """Words of the operator's command, whose files a jail shows; never words of an agent."""
    variables: Sequence[str] = ()
    """Names of the operator's variables that the agent's settings pass on, into a jail too."""
    hosts: Sequence[str] = ()
    """`HOST:PORT` that the agent's settings name, which a jail lets it reach."""
    packages: Sequence[str] = ()
    """Distributions of our own Python that a jail shows."""
    skills_at = "~/.agents/skills"
    """Folder in the jail in which the agent looks for skills."""
    own_files: Sequence[str] = ()
    """Files of the operator's home of which the agent gets a copy."""
    resumable = False
    """Whether it resumes from `Stage.session_file` after all its processes were killed."""
    continues = False
    """Whether its program continues by itself from its workspace when it is started again, without a session."""

    def take_inputs(self, kept: KeptInputs) -> None:
        """Gives it the run's skills and MCP servers, before it plays."""
        assert not kept, "only agents with settings have inputs"

    model: ModelTerms | None = None
    """Of agents whose model is known; None for agents without one."""
    relay: RelayAddress | None = None
    """Where the agent finds its model; None: at the provider, with the operator's key."""

    def known_facts(self) -> dict[str, Any]:
        """Facts for `run.json` that do not depend on the agent's end, in case its supervisor cannot report the
        others."""
        return {}

    def check(self, env: str) -> None:  # noqa: B027
        """Raises ConfigError when the agent cannot play `env` on this machine; call it before a run is opened."""

    @abstractmethod
    async def run_agent(self, stage: Stage) -> AgentEnded:
        """Runs the agent until it stops by itself. Cancelled when the run ends for another reason."""


# The gateway is on this machine; proxies of the environment must not be used for it.
_opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _get_json(url: str) -> dict[str, Any]:
    try:
        with _opener.open(url, timeout=_INFO_TIMEOUT_S) as answer:
            document = json.load(answer)
    except HTTPException as error:  # the gateway was killed while it answered
        raise OSError(f"{url} did not answer to the end: {error!r}") from error
    return dict(document)
