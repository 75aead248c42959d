"""What is to be played: a run's settings, its agent, and the folder that it is played in."""

from __future__ import annotations

from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError
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


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """A run to be played."""

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
    jail: JailSettings = JailSettings()
    listener: Listener | None = None
    """Where a remote agent is served; None for an agent that is started here."""

    @property
    def folder(self) -> RunFolder:
        return run_folder(self.runs, self.settings.entry, self.settings.env, self.settings.exp_id)

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
