"""What `run` and `local` take for each run: options, and the settings that they become. A wrong value is a ConfigError."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import ObservationForm, PolicyScope, StepLimit
from evopolicy_common.messages.gateway import FinishRule, SimulationRule, VideoOption
from evopolicy_common.messages.operator import RunSettings
from evopolicy_gateway import harnesses
from evopolicy_gateway.agent_supervisor.clock import SILENCE_S
from evopolicy_gateway.cli.options import (
    HiddenCasesOption,
    Limits,
    ProfileOption,
    TierName,
    hidden_cases_of,
    limits_of,
    one_of,
    settings_of,
    tier_of,
)
from evopolicy_gateway.http.door import Door, agent_host_of, door_of
from evopolicy_gateway.jail.settings import JailSettings, Mode, absolute

WALL_S = 12 * 3600.0

Several = list[str] | None
"""An option that may be repeated."""


_CHOICES: dict[str, object] = {
    "policy_scope": PolicyScope,
    "observations": ObservationForm,
    "simulation": SimulationRule,
    "finish": FinishRule,
    "step_limit": StepLimit,
}


class RunOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The run itself."""

    agent: Annotated[
        str,
        typer.Option(
            help="evolve, random, replay:DIR, command:PROGRAM…, codex, claude-code, file:AGENT.toml, remote",
            show_default=False,
        ),
    ]
    budget: Annotated[int | None, typer.Option(min=1, help="Train episodes; default: the suite's.")] = None
    model: Annotated[
        str | None, typer.Option(help="Name of the model behind the agent; default: the entry's.")
    ] = None
    entry: Annotated[
        str | None, typer.Option(help="Name of the leaderboard entry; default: the agent's.")
    ] = None
    exp_id: Annotated[str | None, typer.Option(help="Name of this experiment; default: the time.")] = None
    repeat: Annotated[
        int, typer.Option(min=0, help="Which repeat of the same agent and environment this is.")
    ] = 0
    min_episodes: Annotated[int | None, typer.Option(min=1, help="Fewest episodes of a submit.")] = None
    max_episodes: Annotated[int | None, typer.Option(min=1, help="Most episodes of a submit.")] = None
    validation: Annotated[int | None, typer.Option(min=1, help="Hidden validation cases.")] = None
    heldout: Annotated[int | None, typer.Option(min=1, help="Hidden held-out cases.")] = None
    profile: ProfileOption = None
    hidden_cases: HiddenCasesOption = None
    policy_scope: Annotated[
        str | None,
        typer.Option(help="episode: a fresh Policy each (default); submit: one through a submit."),
    ] = None
    observations: Annotated[str | None, typer.Option(help="arrays (default), or lists as published.")] = None
    simulation: Annotated[
        str | None,
        typer.Option(
            help="forbidden: only submits play the environment (default); allowed: the agent may simulate it."
        ),
    ] = None
    finish: Annotated[
        str | None,
        typer.Option(
            help="early: an agent may stop before its budget is spent (default); budget: that is an error, as published."
        ),
    ] = None
    step_limit: Annotated[
        str | None,
        typer.Option(
            help="published: episodes are cut where the published software cuts them (default); natural: by their"
            " environment alone."
        ),
    ] = None
    tier: TierName = "bwrap"
    video: Annotated[str, typer.Option(help="Videos in the feedback: off, first, all.")] = "off"
    replays: Annotated[
        str | None,
        typer.Option(help="Videos of the score's held-out episodes: off, first, all; default: as --video."),
    ] = None
    limit: Limits = None
    agent_wall_s: Annotated[float, typer.Option(min=1.0, help="Seconds that the agent may take.")] = WALL_S
    agent_silence_s: Annotated[
        float,
        typer.Option(
            min=1.0,
            help="A program that asks for no submit, changes no file and takes no processor time for so long is ended.",
        ),
    ] = SILENCE_S
    runs: Annotated[Path, typer.Option(help="Folder of run directories.")] = Path("runs")
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a run of that name.")] = False
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run of that --exp-id, whose command was killed.")
    ] = False

    def settings(self, env: str, exp_id: str, agent_host: str = "") -> RunSettings:
        """The settings of one run, `agent_host` as it has it. ConfigError naming the option that is wrong."""
        entry = self.entry or harnesses.entry_name(self.agent)
        return RunSettings(
            env=env,
            entry=entry,
            model=self.model or entry,
            exp_id=exp_id,
            repeat=self.repeat,
            budget=self.budget,
            min_episodes_per_submit=self.min_episodes,
            max_episodes_per_submit=self.max_episodes,
            n_validation=self.validation,
            n_heldout=self.heldout,
            agent_host=agent_host,
            **settings_of(
                self.profile,
                hidden_cases=hidden_cases_of(self.hidden_cases),
                **{name: self._one_of(name, kind) for name, kind in _CHOICES.items()},
            ),  # type: ignore[arg-type]
            sandbox_tier=tier_of(self.tier),
            video=one_of("--video", self.video, VideoOption),  # type: ignore[arg-type]
            replays=None if self.replays is None else one_of("--replays", self.replays, VideoOption),  # type: ignore[arg-type]
            limits=limits_of(self.limit or ()),
        )

    def _one_of(self, name: str, kind: object) -> str | None:
        told = getattr(self, name)
        return None if told is None else one_of(f"--{name.replace('_', '-')}", told, kind)


class JailOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What the agent sees and reaches."""

    jail: Annotated[
        str,
        typer.Option(
            help="Around the agent: bwrap, open-network (jailed, with this machine's network), none. Recorded in run.json."
        ),
    ] = "bwrap"
    jail_bind: Annotated[
        Several, typer.Option(help="File or folder that the agent sees, read-only; may be repeated.")
    ] = None
    jail_bind_rw: Annotated[Several, typer.Option(help="File or folder that it may also change.")] = None
    jail_env: Annotated[
        Several, typer.Option(help="Variable that is passed on to it, such as an API key's.")
    ] = None
    allow_host: Annotated[
        Several,
        typer.Option(help="HOST or HOST:PORT that it reaches besides its harness's own; may be repeated."),
    ] = None

    def settings(self) -> JailSettings:
        """The jail that is asked for. ConfigError naming the option that is wrong, or what this machine lacks."""
        started_in = Path.cwd()
        settings = JailSettings(
            mode=one_of("--jail", self.jail, Mode),  # type: ignore[arg-type]
            read=tuple(absolute(path, started_in) for path in self.jail_bind or ()),
            write=tuple(absolute(path, started_in) for path in self.jail_bind_rw or ()),
            environment=tuple(self.jail_env or ()),
            hosts=tuple(self.allow_host or ()),
        )
        settings.check()
        return settings

    def of_remote_agent(self) -> JailSettings:
        """None of ours, as somebody else starts the agent. ConfigError when one is asked for."""
        widened = (self.jail_bind, self.jail_bind_rw, self.jail_env, self.allow_host)
        if self.jail == "open-network" or any(widened):
            raise ConfigError(
                "--agent remote is not started here, so --jail and its options do not go with it"
            )
        return JailSettings(mode="none")


class DoorOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Where a remote agent is served."""

    http: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            help="With --agent remote: the address of this machine on which the agent is served; every request needs the token.",
        ),
    ] = None
    http_url: Annotated[
        str | None,
        typer.Option(help="How the agent reaches it where that is another URL, such as that of a TLS front."),
    ] = None

    agent_host: Annotated[
        str | None,
        typer.Option(
            metavar="BOOT_ID|elsewhere",
            help="With --agent remote: the kernel that the agent runs on (there: cat /proc/sys/kernel/random/boot_id), so that"
            " hidden episodes are kept from it; elsewhere: you vouch that it is on no machine of the cluster. Default: it"
            " may be on any, so no hidden episode is played before the agent has ended.",
        ),
    ] = None

    def host_of(self, agent: str) -> str:
        """`RunSettings.agent_host`. ConfigError for what names no kernel, or an agent that is started here."""
        return "" if self.agent_host is None else agent_host_of(agent, self.agent_host)

    def door(self) -> Door | None:
        """None without `--http`. ConfigError naming the option that is wrong."""
        if self.http is None and self.http_url is not None:
            raise ConfigError("--http-url tells how --http HOST:PORT is reached; it needs that")
        return None if self.http is None else door_of(self.http, self.http_url)
