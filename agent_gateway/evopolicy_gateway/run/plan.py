"""What is to be played: a run's settings, its agent, and the folder that it is played in."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import StepLimit
from evopolicy_common.messages.operator import RunSettings
from evopolicy_common.processes.preflight import check_installed, check_loopback, check_text, check_writable
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_gateway import harnesses
from evopolicy_gateway.agent_supervisor.clock import SILENCE_S
from evopolicy_gateway.harnesses.agent_config import AgentConfig
from evopolicy_gateway.http.listener import Listener, check_agent
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.operator.locks import check_free
from evopolicy_gateway.run.layout import IntendedRun, RunFolder, run_folder, saved

WALL_S = 12 * 3600.0
"""An agent's time where nobody says otherwise."""
_OPERATIONAL = frozenset(
    ("retries", "backoff_s", "silence_s", "pause_s", "max_pause_s", "pass_environment", "prices")
)
"""Settings of a coding agent that change nothing of what a run measures."""


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """A run to be played: for itself, or as one of a sweep."""

    name: str = ""
    """How its operator is told of it, unique within a command: its environment, in a sweep `agent/environment/repeat`."""
    settings: RunSettings
    agent: str
    """As `--agent` takes it."""
    runs: Path
    started_in: Path
    wall_limit_s: float
    """The agent's time, seconds."""
    silence_s: float = SILENCE_S
    """A program that does nothing for so long is ended, seconds."""
    overwrite: bool = False
    resume: bool = False
    """What the folder holds of this run is gone on with."""
    config: AgentConfig | None = None
    """A coding agent's settings, from a suite's file."""
    parallel: int | None = None
    """Most runs of its entry at once; None: as many as there may be."""
    jail: JailSettings = JailSettings()
    listener: Listener | None = None
    """Where a remote agent is served; None for an agent that is started here."""

    @property
    def folder(self) -> RunFolder:
        return run_folder(self.runs, self.settings.entry, self.settings.env, self.settings.exp_id)

    @property
    def entry(self) -> str:
        """Leaderboard entry."""
        return self.settings.entry

    @property
    def provider(self) -> str:
        """Whom its agent asks: runs with a provider that is away wait together."""
        return self.config.provider_name if self.config is not None else self.agent.partition(":")[0]

    @property
    def defining(self) -> dict[str, Any]:
        """Everything that makes it this run and no other; the attempt and operational settings do not.

        What is as usual is left out, so that a setting which a later version adds makes no other run of it.
        """
        config = None
        if self.config is not None:
            told = _unusual(msgspec.to_builtins(self.config), msgspec.to_builtins(AgentConfig(harness="")))
            config = {name: value for name, value in told.items() if name not in _OPERATIONAL}
        settings = self.settings
        # Without a published limit both kinds are the same.
        both = catalogue.entry(settings.env).published_steps is not None
        limit: StepLimit = "natural" if both else settings.step_limit
        usual = RunSettings(env="", entry="", model="", exp_id="", attempt=settings.attempt, step_limit=limit)
        told = _unusual(msgspec.to_builtins(settings), msgspec.to_builtins(usual))
        told.pop("replays", None)  # recorded once all is over, it changes nothing of the run
        found = {"agent": self.agent, "config": config, "settings": told, "agent_wall_s": self.wall_limit_s}
        if self.silence_s != SILENCE_S:
            found["agent_silence_s"] = self.silence_s
        # What a jail shows (`read`) is where programs lie, which differs from host to host.
        reached = {name: value for name, value in self.jail.chosen().items() if name != "read"}
        if reached or self.jail.mode != JailSettings().mode:
            found["jail"] = {"mode": self.jail.mode, **reached}
        return found

    @property
    def digest(self) -> str:
        """Of all that defines it."""
        return hashlib.sha256(msgspec.json.encode(list(self.defining.values()), order="sorted")).hexdigest()[
            :16
        ]

    def check(self) -> None:
        """ConfigError when the agent cannot start, or its jail or the run's folder cannot be had, such as one that may not
        be overwritten."""
        check_free(self.folder.lock, self.folder.root)
        self.check_held()

    def check_held(self) -> None:
        """`check` for who may hold the folder's lock."""
        check_text(self.started_in, "cd")
        msgspec.json.encode((self.settings, self.agent))  # UnicodeEncodeError for an option that is not UTF-8
        check_installed("gateway")
        check_writable(self.runs, "--runs")
        if self.listener is None:
            check_loopback()
        check_agent(self.agent, self.listener)
        harnesses.make(self.agent, self.started_in, self.config).check()
        self.jail.check()
        folder = self.folder
        if not folder.root.exists():
            return
        if not (folder.run_json.exists() or folder.state.exists() or not any(folder.root.iterdir())):
            raise ConfigError(f"{folder.root} is not a run's folder; choose another --runs or --exp-id")
        if self.resume:
            intended = self.intended()
            if intended is not None and intended.settings != self.settings:
                raise ConfigError(
                    f"{folder.root} holds a run with other settings; go on with it by the options it was begun with"
                )
        elif not self.overwrite:
            kind = "a finished" if folder.run_json.exists() else "an unfinished"
            raise ConfigError(
                f"{folder.root} holds {kind} run; choose another --exp-id, or replace it with --overwrite"
                + ("" if folder.run_json.exists() else ", or go on with it with --resume")
            )

    def intended(self) -> IntendedRun | None:
        """What was begun in the folder; None for nothing."""
        try:
            return saved(self.folder.intended, IntendedRun)
        except FileNotFoundError:
            return None

    def claim(self) -> None:
        """Makes the run's folder, empty, for who holds its lock. ConfigError as `check`."""
        self.check_held()
        if self.folder.root.exists():
            remove_tree(self.folder.root)
        self.folder.root.mkdir(parents=True)


def _unusual(told: dict[str, Any], usual: dict[str, Any]) -> dict[str, Any]:
    """What differs from the usual, inner tables too."""
    found = {name: value for name, value in told.items() if name not in usual or value != usual[name]}
    return {
        name: _unusual(value, usual[name])
        if isinstance(value, dict) and isinstance(usual.get(name), dict)
        else value
        for name, value in found.items()
    }
