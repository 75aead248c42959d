"""A suite's TOML file, and its expansion into runs.

`docs/how-to/sweeps.md` explains it with examples. A setting of a run comes from the last matching `[[overrides]]`, else
from the agent's `[agents.run]`, else from `[defaults]`, else from the environment's suite. Unknown keys are refused.
"""

from __future__ import annotations

import contextlib
import difflib
import fnmatch
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import msgspec
from msgspec import Meta

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError
from evopolicy_common.regular_files import read_given
from evopolicy_common.wire import keys
from evopolicy_gateway.declared import Count, literals, suite_keys
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.plan import Plan, check_apart
from evopolicy_gateway.run.run_options import RunOptions, limits_from

if TYPE_CHECKING:

    class RunTable(msgspec.Struct, frozen=True):
        """As below; only the names of its fields are used."""

else:
    RunTable = msgspec.defstruct(
        "RunTable",
        [*suite_keys(RunOptions), ("repeats", Count | None, None)],
        namespace={"__doc__": "Settings of a run; None: not set here."},
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )


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
    parallel: Count | None = None
    """Maximum number of its simultaneous runs."""
    run: RunTable = RunTable()
    jail: JailSettings = JailSettings()
    """Paths and hosts that its jail allows in addition to its harness's."""


class Parallel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Maximum numbers of simultaneous runs; an agent's own limit is in its table."""

    machine: Count = 4
    """On each participating host."""
    agent: Count | None = None
    """Of each agent, on each host."""
    providers: dict[str, Count] = {}
    """Of each provider, on each host."""
    claim_ttl_s: Annotated[float, Meta(ge=1, le=3600)] = 60.0
    """A host that is silent for this many seconds loses its runs to the others."""


class Caps(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Joint limits of all runs of this host. A used-up limit stops coding agents and prevents further runs."""

    max_requests: Count | None = None
    """To the models, as far as the relay counts them."""
    max_tokens: Count | None = None
    max_cost: Annotated[float, Meta(gt=0)] | None = None
    """US dollars, over the agents that have `prices`."""


class SuiteFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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


def _found(name: str) -> bytes:
    """A suite's file by its path or shipped name, such as `core16.toml`. Raises ConfigError when it is missing."""
    path = Path(name)
    if path.is_file():
        return read_given(path, str(path))
    shipped = resources.files("evopolicy_gateway.suite") / "shipped"
    there = sorted(entry.name for entry in shipped.iterdir() if entry.name.endswith(".toml"))
    wanted = name if name.endswith(".toml") else f"{name}.toml"
    if wanted in there:
        return (shipped / wanted).read_bytes()
    raise ConfigError(f"no file and no shipped suite named {name!r}; shipped are {', '.join(there)}")


def read_suite(name: str) -> SuiteFile:
    """Reads and validates a suite's file. Raises ConfigError with the problem and its place."""
    data = _found(name)
    try:
        suite = msgspec.toml.decode(data, type=SuiteFile)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}{_explained(str(error), data.decode())}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{name}: {error}") from error
    if not keys.valid_name(suite.name) or len(suite.name) > 40:
        raise ConfigError(f"{name}: name {suite.name!r}: letters, digits, '.', '_' and '-' only, 40 at most")
    if not suite.agents or not suite.environments:
        raise ConfigError(f"{name}: at least one agent and one environment are needed")
    return suite


_TABLES: dict[type[msgspec.Struct], str] = {
    SuiteFile: "the top of the file",
    RunTable: "[defaults], [agents.run], or [[overrides]]",
    AgentTable: "[[agents]]",
    Override: "[[overrides]]",
    Parallel: "[parallel]",
    Caps: "[caps]",
    JailSettings: "[agents.jail]",
    AgentConfig: "[agents.config]",
}
"""Where each belongs. A key that several have belongs to the first."""


def _explained(problem: str, text: str) -> str:
    """A fault that msgspec names, with the line of its key, the nearest known key, or the values that are allowed."""
    unknown = re.search(r"unknown field `([^`]*)`", problem)
    key = unknown[1] if unknown else problem.rpartition(".")[2].strip("`")
    numbers = [
        n for n, line in enumerate(text.splitlines(), 1) if re.match(rf"\s*\W*{re.escape(key)}\b", line)
    ]
    place = f", line {numbers[0]}" if len(numbers) == 1 else ""
    known: dict[str, tuple[object, str]] = {}
    for table, where in _TABLES.items():
        for field in msgspec.structs.fields(table):
            known.setdefault(field.encode_name, (field.type, where))
    kind, where = known.get(key, (None, ""))
    if not unknown:
        allowed = _allowed(kind)
        return f"{place}: {problem}" + (f"; use one of {', '.join(allowed)}" if allowed else "")
    if where:
        return f"{place}: {problem}; `{key}` belongs in {where}"
    near = difflib.get_close_matches(key, known, 1)
    return f"{place}: {problem}" + (f"; did you mean {near[0]}?" if near else "")


def _allowed(kind: object) -> list[str]:
    """The values of the Literals in a type."""
    if found := literals(kind):
        return [*map(repr, found)]
    return [each for part in get_args(kind) for each in _allowed(part)]


def expand(suite: SuiteFile, root: Path, started_in: Path, only: tuple[str, ...] = ()) -> list[Plan]:
    """Returns the runs in their starting order. `root`: the sweep's folder. `only`: globs of run names.

    Environments come before agents, so that a sweep stopped early compares all agents on some environments, not one
    agent on all. Raises ConfigError for impossible runs.
    """
    agents = suite.agents
    counts = Counter(agent.name for agent in agents)
    if doubled := sorted(name for name, count in counts.items() if count > 1):
        raise ConfigError(f"several agents are named {', '.join(doubled)}")
    chosen = [(agent, catalogue.resolve(agent.environments or suite.environments)) for agent in agents]
    everything = dict.fromkeys(env for _, envs in chosen for env in envs)
    places = [(env, agent) for env in everything for agent, envs in chosen if env in envs]
    tables = [(env, agent, _table(suite, agent, env)) for env, agent in places]
    runs = [
        _plan(suite, agent, env, repeat, table, root, started_in)
        for repeat in range(max((table.get("repeats", 1) for _, _, table in tables), default=0))
        for env, agent, table in tables
        if repeat < table.get("repeats", 1)
    ]
    if only:
        runs = [run for run in runs if _matches(run.name, only)]
        if not runs:
            raise ConfigError(f"--only {' '.join(only)} matches no run of the suite")
    for run in {run.entry: run for run in runs}.values():
        with _named(run):
            if not run.entry or "/" in run.entry:
                raise ConfigError("a name without '/' is needed")
            run.harness()
            run.jail.check()
    check_apart(runs)
    return runs


def check_agents_start(runs: Iterable[Plan]) -> None:
    """Raises ConfigError when an agent of these runs cannot start on this machine, such as a missing CLI."""
    for run in {(run.entry, run.settings.env): run for run in runs}.values():
        with _named(run):
            run.harness().check(run.settings.env)


@contextlib.contextmanager
def _named(run: Plan) -> Iterator[None]:
    """Errors inside the `with` name the run's agent."""
    try:
        yield
    except ConfigError as error:
        error.args = (f"agent {run.entry!r}: {error}",)
        raise


def _table(suite: SuiteFile, agent: AgentTable, env: str) -> dict[str, Any]:
    """The settings of the agent's runs on `env`, as far as the file has them."""
    fitting = [
        one
        for one in suite.overrides
        if _matches(agent.name, one.agents)
        and (_matches(env, one.environments) or any(env in _resolved(name) for name in one.environments))
    ]
    return {
        name: value
        for table in (suite.defaults, agent.run, *fitting)
        for name in RunTable.__struct_fields__
        if (value := getattr(table, name)) is not None
    }


def _matches(name: str, globs: Iterable[str]) -> bool:
    return any(fnmatch.fnmatch(name, glob) for glob in globs)


def _resolved(name: str) -> list[str]:
    with contextlib.suppress(ConfigError):
        return list(catalogue.resolve([name]))
    return []


def _plan(
    suite: SuiteFile, agent: AgentTable, env: str, repeat: int, table: dict[str, Any], *folders: Path
) -> Plan:
    """`folders`: the sweep's, and the one in which the command was started."""
    root, started_in = folders
    config = agent.config
    if (config is None) == (not agent.agent):
        raise ConfigError(f"agent {agent.name!r} needs either `agent` or `[agents.config]`")
    given = RunOptions(
        agent=agent.agent if config is None else config.harness,
        entry=agent.name,
        model=None if config is None else config.model,
        exp_id=f"{suite.name}-{repeat}",
        repeat=repeat,
        runs=root,
        **{name: value for name, value in table.items() if name != "repeats"}
        | {"limits": limits_from(table.get("limits", {}), "limits.")},
    )
    agent_texts = given.texts(started_in, config)
    settings = given.settings(env, given.exp_id or "", texts=agent_texts, suite=suite.name)
    return msgspec.structs.replace(
        given.plan(settings, started_in, config),
        name=f"{agent.name}/{env}/{repeat}",
        texts=agent_texts,
        parallel=agent.parallel,
        jail=agent.jail,
    )
