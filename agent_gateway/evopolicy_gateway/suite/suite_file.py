"""A suite's TOML file, and the runs that it comes to.

`docs/how-to/sweeps.md` explains it with examples. A setting of a run is looked for in the last `[[overrides]]` that fits, then in
the agent's `[agents.run]`, then in `[defaults]`; what is nowhere is the environment suite's own. Unknown keys are refused.
"""

from __future__ import annotations

import fnmatch
import hashlib
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import ObservationForm, PolicyScope, StepLimit
from evopolicy_common.messages.episode import ResourceLimits, Tier
from evopolicy_common.messages.gateway import FinishRule, Profile, SimulationRule, VideoOption
from evopolicy_common.messages.operator import RunSettings
from evopolicy_common.wire import keys
from evopolicy_gateway import harnesses
from evopolicy_gateway.agent_supervisor.clock import SILENCE_S
from evopolicy_gateway.cli.options import hidden_cases_of, settings_of
from evopolicy_gateway.harnesses.agent_config import AgentConfig
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.layout import RunFolder, run_folder

Positive = Annotated[int, Meta(ge=1)]
WALL_S = 12 * 3600.0
_OPERATIONAL = frozenset(
    ("retries", "backoff_s", "silence_s", "pause_s", "max_pause_s", "pass_environment", "prices")
)
"""Settings of a coding agent that change nothing of what a run measures."""


class RunTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a run; None: look further."""

    budget: Positive | None = None
    min_episodes: Positive | None = None
    max_episodes: Positive | None = None
    validation: Positive | None = None
    heldout: Positive | None = None
    profile: Profile | None = None
    hidden_cases: Literal["shared", "per-run"] | None = None
    policy_scope: PolicyScope | None = None
    observations: ObservationForm | None = None
    simulation: SimulationRule | None = None
    finish: FinishRule | None = None
    step_limit: StepLimit | None = None
    tier: Tier | None = None
    video: VideoOption | None = None
    replays: VideoOption | None = None
    limits: dict[str, float] | None = None
    agent_wall_s: Annotated[float, Meta(gt=0)] | None = None
    agent_silence_s: Annotated[float, Meta(gt=0)] | None = None
    repeats: Positive | None = None


class Override(RunTable, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings for some of the runs."""

    agents: tuple[str, ...] = ("*",)
    """Names or globs."""
    environments: tuple[str, ...] = ("*",)


class AgentTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One leaderboard entry."""

    name: str
    agent: str = ""
    """As `--agent` takes it; or `config`."""
    config: AgentConfig | None = None
    """A coding agent's settings."""
    environments: tuple[str, ...] = ()
    """In place of the suite's."""
    parallel: Positive | None = None
    """Runs of it at once."""
    run: RunTable = RunTable()
    jail: JailSettings = JailSettings()
    """What its jail shows and lets through besides its harness's own."""


class Parallel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How many runs go on at once; an agent's own limit is in its table."""

    machine: Positive = 4
    """On each host that takes part."""
    agent: Positive | None = None
    """Of each agent, on each host."""
    providers: dict[str, Positive] = {}
    """Of each provider, on each host."""
    claim_ttl_s: Annotated[float, Meta(ge=1, le=3600)] = 60.0
    """A host that is not heard of for so long loses its runs to the others."""


class Caps(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What all runs of this host may use together; once it is used no further run is begun, and coding agents are stopped."""

    max_tokens: Positive | None = None
    max_cost: Annotated[float, Meta(gt=0)] | None = None
    """US dollars, over the agents that have `prices`."""


class SuiteFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole file."""

    name: str
    """Names the sweep on the cluster and in the run directories."""
    environments: tuple[str, ...]
    """Suites, suite ids, globs."""
    agents: tuple[AgentTable, ...]
    description: str = ""
    defaults: RunTable = RunTable()
    parallel: Parallel = Parallel()
    caps: Caps = Caps()
    overrides: tuple[Override, ...] = ()


class SuiteRun(msgspec.Struct, frozen=True, kw_only=True):
    """One run of a sweep, as the file wants it."""

    name: str
    """`agent/environment/repeat`."""
    agent: str
    provider: str
    harness: str
    """As `--agent` takes it."""
    config: AgentConfig | None
    settings: RunSettings
    wall_s: float
    silence_s: float = SILENCE_S
    parallel: int | None
    """Runs of its agent at once."""
    jail: JailSettings = JailSettings()

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
        found = {"agent": self.harness, "config": config, "settings": told, "agent_wall_s": self.wall_s}
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

    def folder(self, root: Path) -> RunFolder:
        return run_folder(root, self.settings.entry, self.settings.env, self.settings.exp_id)


def find(name: str) -> tuple[Path | None, bytes]:
    """The bytes of a suite's file: a path, or the name of a shipped one such as `core16.toml`."""
    path = Path(name)
    if path.is_file():
        return path, path.read_bytes()
    shipped = resources.files("evopolicy_gateway.suite") / "shipped"
    there = sorted(entry.name for entry in shipped.iterdir() if entry.name.endswith(".toml"))
    wanted = name if name.endswith(".toml") else f"{name}.toml"
    if wanted in there:
        return None, (shipped / wanted).read_bytes()
    raise ConfigError(f"no file {name!r}, and no shipped suite of that name; shipped are {', '.join(there)}")


def read(name: str) -> SuiteFile:
    """The suite in a file. ConfigError says what is wrong and where."""
    _, data = find(name)
    try:
        suite = msgspec.toml.decode(data, type=SuiteFile)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{name}: {error}") from error
    if not keys.valid_name(suite.name) or len(suite.name) > 40:
        raise ConfigError(f"{name}: name {suite.name!r}: letters, digits, '.', '_' and '-' only, 40 at most")
    if not suite.agents or not suite.environments:
        raise ConfigError(f"{name}: at least one agent and one environment are needed")
    return suite


def expand(suite: SuiteFile, started_in: Path, only: tuple[str, ...] = ()) -> list[SuiteRun]:
    """The runs in the order in which they are begun. `only`: globs of run names.

    Environments come before agents, so that a sweep that is stopped early compares its agents on some environments rather
    than having one agent on all. ConfigError for what cannot be a run.
    """
    names = [agent.name for agent in suite.agents]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ConfigError(f"agents of one name: {', '.join(doubled)}")
    runs: list[SuiteRun] = []
    chosen = {
        agent.name: catalogue.resolve(agent.environments or suite.environments) for agent in suite.agents
    }
    everything = list(dict.fromkeys(env for agent in suite.agents for env in chosen[agent.name]))
    tables = {
        (agent.name, env): _table(suite, agent, env) for agent in suite.agents for env in chosen[agent.name]
    }
    most = max((table.repeats or 1 for table in tables.values()), default=0)
    for repeat in range(most):
        for env in everything:
            for agent in suite.agents:
                table = tables.get((agent.name, env))
                if table is not None and repeat < (table.repeats or 1):
                    runs.append(_run(suite, agent, env, repeat, table))
    if only:
        runs = [run for run in runs if any(fnmatch.fnmatch(run.name, pattern) for pattern in only)]
        if not runs:
            raise ConfigError(f"--only {' '.join(only)} fits no run of the suite")
    taking_part = {run.agent for run in runs}
    for agent in suite.agents:
        if agent.name in taking_part:
            _check_agent(agent, started_in)
    return runs


def check_agents_start(runs: Iterable[SuiteRun], started_in: Path) -> None:
    """ConfigError where an agent of these runs cannot be started on this machine, such as a CLI that is missing."""
    for run in {run.agent: run for run in runs}.values():
        try:
            harnesses.make(run.harness, started_in, run.config).check()
        except ConfigError as error:
            raise ConfigError(f"agent {run.agent!r}: {error}") from error


def _check_agent(agent: AgentTable, started_in: Path) -> None:
    if not agent.name or "/" in agent.name:
        raise ConfigError(f"agent {agent.name!r}: a name without '/' is needed")
    try:
        harnesses.make(agent.agent, started_in, agent.config)
        agent.jail.check()
    except ConfigError as error:
        raise ConfigError(f"agent {agent.name!r}: {error}") from error


def _table(suite: SuiteFile, agent: AgentTable, env: str) -> RunTable:
    found = suite.defaults
    fitting = [
        one
        for one in suite.overrides
        if any(fnmatch.fnmatch(agent.name, glob) for glob in one.agents)
        and any(fnmatch.fnmatch(env, glob) or env in _resolved(glob) for glob in one.environments)
    ]
    for table in (agent.run, *fitting):
        told = {
            name: value for name in RunTable.__struct_fields__ if (value := getattr(table, name)) is not None
        }
        found = msgspec.structs.replace(found, **told)
    return found


def _resolved(name: str) -> list[str]:
    try:
        return list(catalogue.resolve([name]))
    except ConfigError:
        return []


def _run(suite: SuiteFile, agent: AgentTable, env: str, repeat: int, table: RunTable) -> SuiteRun:
    if (agent.config is None) == (not agent.agent):
        raise ConfigError(f"agent {agent.name!r} needs either `agent` or `[agents.config]`")
    harness = agent.agent or agent.config.harness if agent.config else agent.agent
    model = agent.config.model if agent.config is not None else None
    settings = RunSettings(
        env=env,
        entry=agent.name,
        model=model or agent.name,
        exp_id=f"{suite.name}-{repeat}",
        repeat=repeat,
        budget=table.budget,
        min_episodes_per_submit=table.min_episodes,
        max_episodes_per_submit=table.max_episodes,
        n_validation=table.validation,
        n_heldout=table.heldout,
        **settings_of(
            table.profile,
            hidden_cases=hidden_cases_of(table.hidden_cases),
            policy_scope=table.policy_scope,
            observations=table.observations,
            simulation=table.simulation,
            finish=table.finish,
            step_limit=table.step_limit,
        ),  # type: ignore[arg-type]
        sandbox_tier=table.tier or "bwrap",
        video=table.video or "off",
        replays=table.replays,
        limits=_limits(table.limits or {}),
        notes={"suite": suite.name},
    )
    return SuiteRun(
        name=f"{agent.name}/{env}/{repeat}",
        agent=agent.name,
        provider=agent.config.provider_name if agent.config is not None else harness.partition(":")[0],
        harness=harness,
        config=agent.config,
        settings=settings,
        wall_s=table.agent_wall_s or WALL_S,
        silence_s=table.agent_silence_s or SILENCE_S,
        parallel=agent.parallel,
        jail=agent.jail,
    )


def _unusual(told: dict[str, Any], usual: dict[str, Any]) -> dict[str, Any]:
    """What differs from the usual, inner tables too."""
    found = {name: value for name, value in told.items() if name not in usual or value != usual[name]}
    return {
        name: _unusual(value, usual[name])
        if isinstance(value, dict) and isinstance(usual.get(name), dict)
        else value
        for name, value in found.items()
    }


def _limits(told: dict[str, float]) -> ResourceLimits:
    usual = ResourceLimits()
    for name, value in told.items():
        if name not in usual.__struct_fields__ or not 0 < value < float("inf"):
            raise ConfigError(
                f"limits.{name} = {value}: limits above zero are {', '.join(usual.__struct_fields__)}"
            )
    typed = {
        name: int(value) if isinstance(getattr(usual, name), int) else value for name, value in told.items()
    }
    return msgspec.structs.replace(usual, **typed)
