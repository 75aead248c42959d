"""Every option of a run, declared once as `evopolicy_gateway/declared.py` describes; those of its jail are in
`jail/settings.py`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, ProtocolError, RequestError
from evopolicy_common.messages.environment import FailedEpisodes, ObservationForm, PolicyScope, StepLimit
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, ResourceLimits, Tier
from evopolicy_common.messages.gateway import FeedbackDetail, FinishRule, Profile, SimulationRule, VideoOption
from evopolicy_common.messages.run_settings import HIDDEN_COUNTS, PUBLISHED, RunSettings, episode_counts
from evopolicy_common.processes.packages import checked_names, packages_in, policy_versions
from evopolicy_common.records.model_record import Level
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.run_record import AgentLimits
from evopolicy_gateway import harnesses
from evopolicy_gateway.declared import Count, Option, Several
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.processes.clock import SILENCE_S
from evopolicy_gateway.run.plan import WALL_S, Plan, Texts, find_start, read_prices, read_texts
from evopolicy_gateway.run_folder.listener import Listener, listener_of
from evopolicy_gateway.submits.submit_request import Bounds, ids_in


def default_exp_id() -> str:
    """From the time, so that every run has a folder of its own."""
    return time.strftime("%Y%m%d-%H%M%S")


def one_environment(env: str) -> str:
    """The suite id that `env` names. ConfigError when it names none or several."""
    env_ids = catalogue.resolve([env])
    if len(env_ids) != 1:
        raise ConfigError(f"--env {env} names {len(env_ids)} environments; this command takes one")
    return env_ids[0]


def limits_of(texts: Sequence[str]) -> ResourceLimits:
    """`NAME=VALUE` texts over the usual limits."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--limit {text!r}: use the form NAME=VALUE")
        try:
            values[name] = float(value)
        except ValueError:
            raise ConfigError(f"--limit {text!r}: {value!r} is not a number") from None
    return limits_from(values, "--limit ")


def limits_from(values: Mapping[str, float], prefix: str) -> ResourceLimits:
    """Limits by their names over the usual ones. ConfigError for an impossible one; `prefix` begins the error."""
    usual = ResourceLimits()
    typed: dict[str, float | int] = {}
    for name, number in values.items():
        what = f"{prefix}{name}={number:g}"
        if name not in usual.__struct_fields__:
            raise ConfigError(f"{what}: unknown limit; the limits are {', '.join(usual.__struct_fields__)}")
        if not 0 < number < float("inf"):
            raise ConfigError(f"{what}: a limit must be a finite number above 0")
        if number > (most := LARGEST_LIMITS.get(name, LARGEST_LIMIT)):
            raise ConfigError(f"{what}: {name} can be {most:,} at most")
        typed[name] = int(number) if isinstance(getattr(usual, name), int) else number
    return replace(usual, **typed)


def cases_of(text: str) -> tuple[int, ...]:
    """Case ids of a text such as `0-3,7`."""
    # The coordinator knows the number of cases; these bounds only refuse nonsense.
    bounds = Bounds(n_env_instances=10**6, min_episodes=1, max_episodes=4096, remaining_budget=4096)
    try:
        ids = ids_in(text, bounds)
    except RequestError as error:
        raise ConfigError(f"--cases {text!r}: {error.message.replace('env_instances', 'it')}") from error
    if not ids:
        raise ConfigError(f"--cases {text!r} names no case; use a form such as 0-3,7")
    return ids


def packages_for(policy: Path, requested: Sequence[str] | None) -> tuple[str, ...]:
    """Packages of `--policy-package`, else of the policy's run. ConfigError for unavailable ones."""
    if requested:
        return checked_names(requested)
    folder = policy.absolute()
    for run in (folder, *list(folder.parents)[:2]):
        with contextlib.suppress(OSError, ProtocolError):
            packages = packages_in(read_record(run).versions.fingerprint)
            try:
                policy_versions(packages)
            except ConfigError as error:
                raise ConfigError(
                    f"{run / 'run.json'} names packages of its policies: {error}; --policy-package names others in"
                    " their place"
                ) from error
            return packages
    return ()


Seconds = Annotated[float, Meta(ge=1.0)]
OF_ONE_RUN = Option(suite=None)
RARE = Option(by_set=True)
AGENT_LIMITS: dict[str, tuple[str, float, float]] = {
    "cpus": ("cpus", 0.1, 1e4),
    "memory": ("memory_bytes", 1e8, 1e15),
    "pids": ("pids", 16, 1 << 22),
    "disk": ("disk_bytes", 1e6, 1e18),
}
"""Options `--agent-NAME`: the field of `AgentLimits`, the least value with which programs still start, the
greatest."""


class RunOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The options of a run and of its agent."""

    group: ClassVar[str] = "Run"

    agent: Annotated[str, OF_ONE_RUN]
    """evolve, random, replay:DIR, command:PROGRAM…, codex, claude-code, llm:PROVIDER/MODEL, acp:PROGRAM…,
    file:AGENT.toml, remote"""
    budget: Count | None = None
    """Train episodes; default: the suite's."""
    profile: Annotated[Profile, Option(command=Literal["published", "published-data"] | None)] | None = None
    """published: all settings of the published protocol (docs/reference/protocol.md), with its case files in --data;
    published-data: with all 64 validation and 256 held-out cases of the files."""
    runs: Annotated[Path, OF_ONE_RUN] = Path("runs")
    """Folder of run directories."""
    exp_id: Annotated[str | None, OF_ONE_RUN] = None
    """Name of the experiment; default: the time."""
    overwrite: Annotated[bool, OF_ONE_RUN] = False
    """Replace the run with this --exp-id."""
    resume: Annotated[bool, Option(suite=None, python=False)] = False
    """Continue the run with this --exp-id after its command was killed."""
    entry: Annotated[str | None, OF_ONE_RUN] = None
    """Name of the leaderboard entry; default: the agent's."""
    model: Annotated[str | None, Option(suite=None, by_set=True)] = None
    """Name of the model behind the agent; default: the entry's."""
    repeat: Annotated[int, Meta(ge=0), Option(suite=None, by_set=True)] = 0
    """Number of this repeat of the same agent and environment."""

    validation: Annotated[Count | None, Option(group="Score")] = None
    """Hidden validation cases."""
    heldout: Count | None = None
    """Hidden held-out cases."""
    hidden_cases: Annotated[Literal["shared", "per-run"] | None, RARE] = None
    """shared: the same for all runs of an environment (default); per-run: the run's own, so that runs cannot be
    paired."""
    replays: Annotated[VideoOption | None, RARE] = None
    """Videos of the held-out episodes; default: as --video."""

    min_episodes: Annotated[Count | None, Option(by_set=True, group="Policy and feedback")] = None
    """Least number of episodes in a submit."""
    max_episodes: Annotated[Count | None, RARE] = None
    """Greatest number of episodes in a submit."""
    policy_scope: Annotated[PolicyScope | None, RARE] = None
    """episode: a new Policy object for each episode (default); submit: one for all episodes of a submit."""
    observations: Annotated[ObservationForm | None, RARE] = None
    """Form of observations: arrays (default), or lists as published."""
    step_limit: Annotated[StepLimit | None, RARE] = None
    """published: the step limits of the published software (default); natural: those of the environment."""
    failed_episodes: Annotated[FailedEpisodes | None, RARE] = None
    """An episode in which the policy fails: play-on with random actions (default), or end-submit, as published: it
    ends, and the submit is not eligible."""
    tier: Tier = "bwrap"
    """Sandbox around the policy."""
    limits: Annotated[
        ResourceLimits,
        Option(
            flag="--limit", metavar="NAME=VALUE", command=Several, parse=limits_of, suite=dict[str, float]
        ),
    ] = ResourceLimits()
    """Limit for the policy, such as act_wall_s=5 or memory_bytes=2e9."""
    video: VideoOption = "off"
    """Videos in the feedback."""
    feedback: Annotated[FeedbackDetail | None, RARE] = None
    """Feedback to the agent: scores, trajectories as well, or also pictures and videos (default)."""

    start_from: Annotated[str | None, Option(metavar="RUN@submit_NNN", suite=str, group="Agent")] = None
    """Start with the workspace of an earlier run's submit, and its feedback below history/. The run has a full
    budget."""
    agents_md: Annotated[Path | None, RARE] = None
    """Replacement for AGENTS.md; `evopolicy files texts/agents.md` prints the standard one."""
    prompts: Annotated[Path | None, RARE] = None
    """Replacements for prompts; `evopolicy files texts/prompts.toml` prints the standard ones."""
    prices: Annotated[Path | None, RARE] = None
    """Prices by model, in US dollars per million tokens: the run's cost is recorded, and `max_cost` limits it."""
    simulation: Annotated[SimulationRule | None, RARE] = None
    """Whether AGENTS.md allows the agent to simulate the environment itself; default: forbidden."""
    finish: Annotated[FinishRule | None, RARE] = None
    """early: the agent may stop before it has spent its budget (default); budget: that is an error, as published."""
    record_model: Level = "digests"
    """Record of the model's calls in logs/model/: off, digests, or full, which `evopolicy replay` needs. For models
    reached with a key."""
    agent_wall_s: Annotated[Seconds, Option(suite=Annotated[float, Meta(gt=0)])] = WALL_S
    """Time limit for the agent, in seconds."""
    agent_silence_s: Annotated[Seconds, Option(suite=Annotated[float, Meta(gt=0)], by_set=True)] = SILENCE_S
    """End an agent that is inactive for this long, in seconds."""

    agent_cpus: Annotated[float | None, RARE] = None
    """Processor time for the agent's programs, in cores."""
    agent_memory: Annotated[float | None, RARE] = None
    """Memory for the agent's programs, in bytes, such as 8e9."""
    agent_pids: Annotated[int | None, RARE] = None
    """Greatest number of the agent's processes and threads."""
    agent_disk: Annotated[float | None, RARE] = None
    """Space for the agent's workspace, home, and /tmp, in bytes: with more, it is ended. Default: 2e10."""

    def texts(self, started_in: Path, config: AgentConfig | None = None) -> Texts:
        """The texts of the agent, or of its settings in a suite file. ConfigError names the file."""
        known = config or harnesses.config_of(self.agent, started_in)
        return read_texts(self.agents_md, self.prompts, known, started_in)

    def settings(
        self, env: str, exp_id: str, agent_host: str = "", texts: Texts | None = None, **notes: str
    ) -> RunSettings:
        """The settings of one run, `agent_host` as it has it. ConfigError naming the option that is wrong."""
        profile = self.profile or "own"
        given = {name: getattr(self, name) for name in _AS_GIVEN}
        given |= {"n_validation": self.validation, "n_heldout": self.heldout}
        given["hidden_cases"] = self.hidden_cases and self.hidden_cases.replace("-", "_")
        usual: dict[str, Any] = {"step_limit": "published"}
        if profile != "own":
            usual = PUBLISHED | dict(zip(("n_validation", "n_heldout"), HIDDEN_COUNTS[profile], strict=True))
            for name, value in given.items():
                if name in usual and value not in (None, usual[name]):
                    raise ConfigError(
                        f"profile {profile} has {name} = {usual[name]}, but {value} was given: drop one of them"
                    )
        chosen = usual | {name: value for name, value in given.items() if value is not None}
        entry = self.entry or harnesses.entry_name(self.agent)
        settings = RunSettings(
            env=env,
            entry=entry,
            model=self.model or entry,
            exp_id=exp_id,
            notes=notes,
            profile=profile,
            min_episodes_per_submit=self.min_episodes,
            max_episodes_per_submit=self.max_episodes,
            sandbox_tier=self.tier,
            definition=catalogue.pinned(env),
            agent_host=agent_host,
            **chosen,
            **(texts or Texts()).digests,
        )
        if settings.feedback != "pictures" and self.video != "off":
            raise ConfigError(
                f"feedback {settings.feedback} shows no videos, and video {self.video} is asked for: leave out one of"
                " them"
            )
        episode_counts(settings, catalogue.suite_of(env))
        return settings

    def _agent_limits(self) -> AgentLimits:
        """Limits of the agent's use of its machine. ConfigError naming the option that is wrong."""
        chosen: dict[str, Any] = {}
        for name, (field, least, most) in AGENT_LIMITS.items():
            value = getattr(self, f"agent_{name}")
            if value is None:
                continue
            if not least <= value <= most:
                raise ConfigError(f"--agent-{name} {value:g}: give a number from {least:g} to {most:g}")
            chosen[field] = value if name == "cpus" else int(value)
        return AgentLimits(**chosen)

    def plan(self, settings: RunSettings, started_in: Path, config: AgentConfig | None = None) -> Plan:
        """The run with these settings. `config`: as for `texts`. Raises ConfigError."""
        known, start_from = config or harnesses.config_of(self.agent, started_in), ""
        if self.start_from is not None:
            origin = find_start(self.start_from, started_in)
            settings = replace(settings, start=origin.start)
            start_from = f"{origin.folder.root}@{origin.submit}"
        return Plan(
            settings=settings,
            agent=self.agent,
            runs=self.runs,
            overwrite=self.overwrite,
            resume=self.resume,
            config=config,
            prices=read_prices(self.prices, known, started_in),
            limits=self._agent_limits(),
            started_in=started_in,
            wall_limit_s=self.agent_wall_s,
            silence_s=self.agent_silence_s,
            start_from=start_from,
            record_model=self.record_model,
        )

    def plans(
        self, env_ids: list[str], jail: JailSettings, agent_host: str = "", listener: Listener | None = None
    ) -> list[Plan]:
        """A plan for each environment, named after it. ConfigError naming the option or file that is wrong."""
        if self.resume and (self.overwrite or self.exp_id is None):
            raise ConfigError("--resume needs --exp-id, and cannot be combined with --overwrite")
        started_in, exp_id = Path.cwd(), self.exp_id or default_exp_id()
        texts = self.texts(started_in)
        plans = [self.plan(self.settings(env, exp_id, agent_host, texts), started_in) for env in env_ids]
        return [
            replace(each, name=each.settings.env, texts=texts, jail=jail, listener=listener) for each in plans
        ]


_OTHERWISE = {"entry", "model", "exp_id", "profile", "agents_md", "prompts"}
_OPTIONS = {*RunOptions.__struct_fields__} - _OTHERWISE
_AS_GIVEN = [name for name in RunSettings.__struct_fields__ if name in _OPTIONS]
"""Options that are settings of the run under the same name, as they are given; None: the usual value."""


class ListenerOptions(msgspec.Struct, frozen=True, kw_only=True):
    """A remote agent's HTTP address."""

    group: ClassVar[str] = "Remote agent (--agent remote)"

    http: Annotated[str | None, Option(metavar="HOST:PORT")] = None
    """Address of this machine at which the agent connects; every request needs the token."""
    http_url: Annotated[str | None, Option(metavar="URL")] = None
    """URL for the agent, if it differs from --http, such as that of a TLS proxy."""
    agent_host: Annotated[str | None, Option(metavar="BOOT_ID|elsewhere")] = None
    """Boot id of the agent's machine (there: cat /proc/sys/kernel/random/boot_id): no hidden episode is played on it
    while the agent is alive. elsewhere: you vouch that the agent is on no machine of the cluster. Default: the agent
    may be on any machine, so no hidden episode is played before it has ended."""

    def listener(self) -> Listener | None:
        """None without `--http`. ConfigError naming the option that is wrong."""
        if self.http is None and self.http_url is not None:
            raise ConfigError("--http-url needs --http HOST:PORT")
        return None if self.http is None else listener_of(self.http, self.http_url)


class ClusterOptions(msgspec.Struct, frozen=True, kw_only=True):
    """A cluster that is started for the command or the block."""

    group: ClassVar[str] = "Local cluster"

    slots: Annotated[int, Meta(ge=1, le=1024)] = 2
    """Episodes that each local worker plays at the same time. Commands that share a cluster add their slots."""
    state: Path | None = None
    """State folder of the local cluster. Commands with the same folder have the same cases, and share a cluster while
    they run. Default: $XDG_STATE_HOME/evopolicy/local."""
    fresh: bool = False
    """Use a temporary state folder: new cases, and no later comparison or `verify`."""
    data: Path | None = None
    """Folder of split files (`evopolicy data make`); default: derived from the state's secret."""
    hidden_isolation: Literal["related", "strict", "off"] | None = None
    """Agents that share no kernel with hidden episodes: those of runs with the same hidden cases (related,
    default), all (strict), or none (off)."""
    policy_package: Annotated[Several, Option(metavar="NAME")] = None
    """Package that policies may import in addition to numpy."""
    env_timeout: Annotated[Seconds | None, RARE] = None
    """Time limit for one call of an environment, in seconds, as of evopolicy-worker; default: 300."""
    env_memory: Annotated[Annotated[int, Meta(ge=64)] | None, RARE] = None
    """Memory limit of an environment's process, in MiB, as of evopolicy-worker; default: 4096."""
