"""Options of `run` and `local` for each run, and their conversion to settings. A wrong value is a ConfigError."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import FailedEpisodes, ObservationForm, PolicyScope, StepLimit
from evopolicy_common.messages.gateway import FeedbackDetail, FinishRule, SimulationRule, VideoOption
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_gateway import harnesses
from evopolicy_gateway.cli.options import (
    AGENT,
    JAIL,
    POLICY,
    REMOTE,
    RUN,
    SCORE,
    HiddenCasesOption,
    Limits,
    ProfileOption,
    TierName,
)
from evopolicy_gateway.jail.settings import JailSettings, Mode, absolute
from evopolicy_gateway.processes.clock import SILENCE_S
from evopolicy_gateway.run import texts
from evopolicy_gateway.run.options import limits_of, run_settings
from evopolicy_gateway.run.plan import WALL_S
from evopolicy_gateway.run.texts import Texts
from evopolicy_gateway.run_folder.listener import Listener, agent_host_of, listener_of

Several = list[str] | None
"""An option that may be repeated."""


class RunOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The run itself."""

    agent: Annotated[
        str,
        typer.Option(
            help="evolve, random, replay:DIR, command:PROGRAM…, codex, claude-code, llm:openai/MODEL, acp:PROGRAM…, file:AGENT.toml, remote",
            show_default=False,
            rich_help_panel=RUN,
        ),
    ]
    budget: Annotated[
        int | None, typer.Option(min=1, help="Train episodes; default: the suite's.", rich_help_panel=RUN)
    ] = None
    profile: ProfileOption = None
    runs: Annotated[Path, typer.Option(help="Folder of run directories.", rich_help_panel=RUN)] = Path("runs")
    exp_id: Annotated[
        str | None, typer.Option(help="Name of the experiment; default: the time.", rich_help_panel=RUN)
    ] = None
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the run with this --exp-id.", rich_help_panel=RUN)
    ] = False
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the run with this --exp-id after its command was killed.",
            rich_help_panel=RUN,
        ),
    ] = False
    entry: Annotated[
        str | None,
        typer.Option(help="Name of the leaderboard entry; default: the agent's.", rich_help_panel=RUN),
    ] = None
    model: Annotated[
        str | None,
        typer.Option(help="Name of the model behind the agent; default: the entry's.", rich_help_panel=RUN),
    ] = None
    repeat: Annotated[
        int,
        typer.Option(
            min=0, help="Number of this repeat of the same agent and environment.", rich_help_panel=RUN
        ),
    ] = 0
    validation: Annotated[
        int | None, typer.Option(min=1, help="Hidden validation cases.", rich_help_panel=SCORE)
    ] = None
    heldout: Annotated[
        int | None, typer.Option(min=1, help="Hidden held-out cases.", rich_help_panel=SCORE)
    ] = None
    hidden_cases: HiddenCasesOption = None
    replays: Annotated[
        VideoOption | None,
        typer.Option(
            help="Videos of the held-out episodes; default: as --video.",
            rich_help_panel=SCORE,
            show_default=False,
        ),
    ] = None
    min_episodes: Annotated[
        int | None, typer.Option(min=1, help="Least number of episodes in a submit.", rich_help_panel=POLICY)
    ] = None
    max_episodes: Annotated[
        int | None,
        typer.Option(min=1, help="Greatest number of episodes in a submit.", rich_help_panel=POLICY),
    ] = None
    policy_scope: Annotated[
        PolicyScope | None,
        typer.Option(
            help="episode: a new Policy object for each episode (default); submit: one for all episodes of a submit.",
            rich_help_panel=POLICY,
            show_default=False,
        ),
    ] = None
    observations: Annotated[
        ObservationForm | None,
        typer.Option(
            help="Form of observations: arrays (default), or lists as published.",
            rich_help_panel=POLICY,
            show_default=False,
        ),
    ] = None
    step_limit: Annotated[
        StepLimit | None,
        typer.Option(
            help="published: the step limits of the published software (default); natural: those of the environment.",
            rich_help_panel=POLICY,
            show_default=False,
        ),
    ] = None
    failed_episodes: Annotated[
        FailedEpisodes | None,
        typer.Option(
            help="An episode in which the policy fails: play-on with random actions (default), or end-submit, as published: it ends,"
            " and the submit is not eligible.",
            rich_help_panel=POLICY,
            show_default=False,
        ),
    ] = None
    tier: TierName = "bwrap"
    limit: Limits = None
    video: Annotated[VideoOption, typer.Option(help="Videos in the feedback.", rich_help_panel=POLICY)] = (
        "off"
    )
    feedback: Annotated[
        FeedbackDetail | None,
        typer.Option(
            help="Feedback to the agent: scores, trajectories as well, or also pictures and videos (default).",
            rich_help_panel=POLICY,
            show_default=False,
        ),
    ] = None
    agents_md: Annotated[
        Path | None,
        typer.Option(
            "--agents-md",
            metavar="FILE",
            help="Replacement for AGENTS.md; `evopolicy texts` prints the standard one.",
            rich_help_panel=AGENT,
        ),
    ] = None
    prompts: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Replacements for prompts; `evopolicy texts` prints the standard ones.",
            rich_help_panel=AGENT,
        ),
    ] = None
    prices: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Prices by model, in US dollars per million tokens: the run's cost is recorded, and `max_cost` limits it.",
            rich_help_panel=AGENT,
        ),
    ] = None
    simulation: Annotated[
        SimulationRule | None,
        typer.Option(
            help="Whether AGENTS.md allows the agent to simulate the environment itself; default: forbidden.",
            rich_help_panel=AGENT,
            show_default=False,
        ),
    ] = None
    finish: Annotated[
        FinishRule | None,
        typer.Option(
            help="early: the agent may stop before it has spent its budget (default); budget: that is an error, as published.",
            rich_help_panel=AGENT,
            show_default=False,
        ),
    ] = None
    agent_wall_s: Annotated[
        float, typer.Option(min=1.0, help="Time limit for the agent, in seconds.", rich_help_panel=AGENT)
    ] = WALL_S
    agent_silence_s: Annotated[
        float,
        typer.Option(
            min=1.0,
            help="End an agent that submits nothing, changes no file and uses no processor time for this long, in seconds.",
            rich_help_panel=AGENT,
        ),
    ] = SILENCE_S
    agent_cpus: Annotated[
        float | None,
        typer.Option(help="Processor time for the agent's programs, in cores.", rich_help_panel=AGENT),
    ] = None
    agent_memory: Annotated[
        float | None,
        typer.Option(help="Memory for the agent's programs, in bytes, such as 8e9.", rich_help_panel=AGENT),
    ] = None
    agent_pids: Annotated[
        int | None,
        typer.Option(help="Greatest number of the agent's processes and threads.", rich_help_panel=AGENT),
    ] = None
    agent_disk: Annotated[
        float | None,
        typer.Option(
            help="Space for the agent's workspace, home, and /tmp, in bytes: with more, it is ended. Default: 2e10.",
            rich_help_panel=AGENT,
            show_default=False,
        ),
    ] = None

    def texts(self, started_in: Path) -> Texts:
        """The agent's texts. ConfigError naming the file that is wrong."""
        config = harnesses.config_of(self.agent, started_in)
        return texts.read(self.agents_md, self.prompts, config, started_in)

    def settings(
        self, env: str, exp_id: str, agent_host: str = "", texts: Texts | None = None
    ) -> RunSettings:
        """The settings of one run, `agent_host` as it has it. ConfigError naming the option that is wrong."""
        entry = self.entry or harnesses.entry_name(self.agent)
        named = {"env": env, "entry": entry, "model": self.model or entry, "exp_id": exp_id}
        named |= (texts or Texts()).digests
        return run_settings(
            self, limits_of(self.limit or ()), repeat=self.repeat, agent_host=agent_host, **named
        )


class JailOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The agent's view of its episodes, and its access to files and hosts."""

    jail: Annotated[
        Mode,
        typer.Option(
            help="Jail of the agent; open-network: a jail with this machine's network. Recorded in run.json.",
            rich_help_panel=JAIL,
        ),
    ] = "bwrap"
    jail_bind: Annotated[
        Several,
        typer.Option(
            metavar="PATH",
            help="File or folder that the agent may read; may be repeated.",
            rich_help_panel=JAIL,
        ),
    ] = None
    jail_bind_rw: Annotated[
        Several,
        typer.Option(
            metavar="PATH",
            help="File or folder that the agent may also change; may be repeated.",
            rich_help_panel=JAIL,
        ),
    ] = None
    jail_env: Annotated[
        Several,
        typer.Option(
            metavar="NAME",
            help="Environment variable that the agent gets, such as an API key; may be repeated.",
            rich_help_panel=JAIL,
        ),
    ] = None
    allow_host: Annotated[
        Several,
        typer.Option(
            metavar="HOST[:PORT]",
            help="Host that the agent may connect to, in addition to its model's; may be repeated.",
            rich_help_panel=JAIL,
        ),
    ] = None

    def settings(self) -> JailSettings:
        """The requested jail. Raises ConfigError that names the invalid option, or the missing part of this machine."""
        started_in = Path.cwd()
        settings = JailSettings(
            mode=self.jail,
            read=tuple(absolute(path, started_in) for path in self.jail_bind or ()),
            write=tuple(absolute(path, started_in) for path in self.jail_bind_rw or ()),
            environment=tuple(self.jail_env or ()),
            hosts=tuple(self.allow_host or ()),
        )
        settings.check()
        return settings

    def of_remote_agent(self) -> JailSettings:
        """No jail, since the operator starts a remote agent. Raises ConfigError when one is requested."""
        widened = (self.jail_bind, self.jail_bind_rw, self.jail_env, self.allow_host)
        if self.jail == "open-network" or any(widened):
            raise ConfigError(
                "--agent remote is not started by this command, so --jail and its options do not apply"
            )
        return JailSettings(mode="none")


class ListenerOptions(msgspec.Struct, frozen=True, kw_only=True):
    """A remote agent's HTTP address."""

    http: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            rich_help_panel=REMOTE,
            help="Address of this machine at which the agent connects; every request needs the token.",
        ),
    ] = None
    http_url: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            rich_help_panel=REMOTE,
            help="URL for the agent, if it differs from --http, such as that of a TLS proxy.",
        ),
    ] = None

    agent_host: Annotated[
        str | None,
        typer.Option(
            metavar="BOOT_ID|elsewhere",
            rich_help_panel=REMOTE,
            help="Boot id of the agent's machine (there: cat /proc/sys/kernel/random/boot_id): no hidden episode is played on it"
            " while the agent is alive. elsewhere: you vouch that the agent is on no machine of the cluster. Default: the agent"
            " may be on any machine, so no hidden episode is played before it has ended.",
        ),
    ] = None

    def host_of(self, agent: str) -> str:
        """`RunSettings.agent_host`. ConfigError for what names no kernel, or an agent that is started here."""
        return "" if self.agent_host is None else agent_host_of(agent, self.agent_host)

    def listener(self) -> Listener | None:
        """None without `--http`. ConfigError naming the option that is wrong."""
        if self.http is None and self.http_url is not None:
            raise ConfigError("--http-url needs --http HOST:PORT")
        return None if self.http is None else listener_of(self.http, self.http_url)
