"""A suite's TOML file, and its expansion into runs.

`docs/how-to/sweeps.md` explains it with examples. A setting of a run comes from the last matching `[[overrides]]`, else
from the agent's `[agents.run]`, else from `[defaults]`, else from the environment's suite. Unknown keys are refused.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import FailedEpisodes, ObservationForm, PolicyScope, StepLimit
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.gateway import (
    FeedbackDetail,
    FinishRule,
    Profile,
    SimulationRule,
    VideoOption,
)
from evopolicy_common.regular_files import read_given
from evopolicy_common.wire import keys
from evopolicy_gateway import harnesses
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.processes.clock import SILENCE_S
from evopolicy_gateway.run import prices, texts
from evopolicy_gateway.run.options import agent_limits, limits_from, run_settings
from evopolicy_gateway.run.plan import WALL_S, Plan

Positive = Annotated[int, Meta(ge=1)]


class RunTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a run; None: not set here."""

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
    feedback: FeedbackDetail | None = None
    failed_episodes: FailedEpisodes | None = None
    agents_md: str | None = None
    """File with the text in place of `AGENTS.md`."""
    prompts: str | None = None
    """File with prompts in place of the standard ones."""
    prices: str | None = None
    """File with a table of prices for each model."""
    tier: Tier | None = None
    video: VideoOption | None = None
    replays: VideoOption | None = None
    limits: dict[str, float] | None = None
    agent_wall_s: Annotated[float, Meta(gt=0)] | None = None
    agent_silence_s: Annotated[float, Meta(gt=0)] | None = None
    agent_cpus: float | None = None
    """Cores."""
    agent_memory: float | None = None
    """Bytes."""
    agent_pids: int | None = None
    agent_disk: float | None = None
    """Bytes."""
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
    """In the form of `--agent`; alternative to `config`."""
    config: AgentConfig | None = None
    """A coding agent's settings."""
    environments: tuple[str, ...] = ()
    """In place of the suite's."""
    parallel: Positive | None = None
    """Maximum number of its simultaneous runs."""
    run: RunTable = RunTable()
    jail: JailSettings = JailSettings()
    """Paths and hosts that its jail allows in addition to its harness's."""


class Parallel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Maximum numbers of simultaneous runs; an agent's own limit is in its table."""

    machine: Positive = 4
    """On each participating host."""
    agent: Positive | None = None
    """Of each agent, on each host."""
    providers: dict[str, Positive] = {}
    """Of each provider, on each host."""
    claim_ttl_s: Annotated[float, Meta(ge=1, le=3600)] = 60.0
    """A host that is silent for this long loses its runs to the others, seconds."""


class Caps(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Joint limits of all runs of this host. A used-up limit stops coding agents and prevents further runs."""

    max_requests: Positive | None = None
    """To the models, as far as the relay counts them."""
    max_tokens: Positive | None = None
    max_cost: Annotated[float, Meta(gt=0)] | None = None
    """US dollars, over the agents that have `prices`."""


class SuiteFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole file."""

    name: str
    """Names the sweep on the cluster and in the run directories."""
    environments: tuple[str, ...]
    """Names of suites, ids of environments, or globs."""
    agents: tuple[AgentTable, ...]
    description: str = ""
    defaults: RunTable = RunTable()
    parallel: Parallel = Parallel()
    caps: Caps = Caps()
    overrides: tuple[Override, ...] = ()


def find(name: str) -> tuple[Path | None, bytes]:
    """Reads a suite's file by its path or shipped name, such as `core16.toml`. Raises ConfigError when it is missing.

    Returns the path, None for a shipped file, and the bytes.
    """
    path = Path(name)
    if path.is_file():
        return path, read_given(path, str(path))
    shipped = resources.files("evopolicy_gateway.suite") / "shipped"
    there = sorted(entry.name for entry in shipped.iterdir() if entry.name.endswith(".toml"))
    wanted = name if name.endswith(".toml") else f"{name}.toml"
    if wanted in there:
        return None, (shipped / wanted).read_bytes()
    raise ConfigError(f"no file and no shipped suite named {name!r}; shipped are {', '.join(there)}")


def read(name: str) -> SuiteFile:
    """Reads and validates a suite's file. Raises ConfigError with the problem and its place."""
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


def expand(suite: SuiteFile, root: Path, started_in: Path, only: tuple[str, ...] = ()) -> list[Plan]:
    """Returns the runs in their starting order. `root`: the sweep's folder. `only`: globs of run names.

    Environments come before agents, so that a sweep stopped early compares all agents on some environments, not one
    agent on all. Raises ConfigError for impossible runs.
    """
    names = [agent.name for agent in suite.agents]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ConfigError(f"several agents are named {', '.join(doubled)}")
    runs: list[Plan] = []
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
                    runs.append(_plan(suite, agent, env, repeat, table, root, started_in))
    if only:
        runs = [run for run in runs if any(fnmatch.fnmatch(run.name, pattern) for pattern in only)]
        if not runs:
            raise ConfigError(f"--only {' '.join(only)} matches no run of the suite")
    for run in {run.entry: run for run in runs}.values():
        _check_agent(run)
    return runs


def check_agents_start(runs: Iterable[Plan]) -> None:
    """Raises ConfigError when an agent of these runs cannot start on this machine, such as a missing CLI."""
    for run in {(run.entry, run.settings.env): run for run in runs}.values():
        try:
            run.harness().check(run.settings.env)
        except ConfigError as error:
            error.args = (f"agent {run.entry!r}: {error}",)
            raise


def _check_agent(run: Plan) -> None:
    if not run.entry or "/" in run.entry:
        raise ConfigError(f"agent {run.entry!r}: a name without '/' is needed")
    try:
        run.harness()
        run.jail.check()
    except ConfigError as error:
        error.args = (f"agent {run.entry!r}: {error}",)
        raise


def _table(suite: SuiteFile, agent: AgentTable, env: str) -> RunTable:
    found = suite.defaults
    fitting = [
        one
        for one in suite.overrides
        if any(fnmatch.fnmatch(agent.name, glob) for glob in one.agents)
        and any(fnmatch.fnmatch(env, glob) or env in _resolved(glob) for glob in one.environments)
    ]
    for table in (agent.run, *fitting):
        values = {
            name: value for name in RunTable.__struct_fields__ if (value := getattr(table, name)) is not None
        }
        found = msgspec.structs.replace(found, **values)
    return found


def _resolved(name: str) -> list[str]:
    try:
        return list(catalogue.resolve([name]))
    except ConfigError:
        return []


def _plan(
    suite: SuiteFile, agent: AgentTable, env: str, repeat: int, table: RunTable, root: Path, started_in: Path
) -> Plan:
    if (agent.config is None) == (not agent.agent):
        raise ConfigError(f"agent {agent.name!r} needs either `agent` or `[agents.config]`")
    harness = agent.agent or agent.config.harness if agent.config else agent.agent
    model = agent.config.model if agent.config is not None else None
    known = agent.config or harnesses.config_of(agent.agent, started_in)
    agent_texts = texts.read(table.agents_md, table.prompts, known, started_in)
    settings = run_settings(
        table,
        limits_from(table.limits or {}, "limits."),
        env=env,
        entry=agent.name,
        model=model or agent.name,
        exp_id=f"{suite.name}-{repeat}",
        repeat=repeat,
        notes={"suite": suite.name},
        **agent_texts.digests,
    )
    return Plan(
        name=f"{agent.name}/{env}/{repeat}",
        settings=settings,
        agent=harness,
        runs=root,
        started_in=started_in,
        wall_limit_s=table.agent_wall_s or WALL_S,
        silence_s=table.agent_silence_s or SILENCE_S,
        config=agent.config,
        prices=prices.read(table.prices, known, started_in),
        texts=agent_texts,
        parallel=agent.parallel,
        jail=agent.jail,
        limits=agent_limits(table),
    )
