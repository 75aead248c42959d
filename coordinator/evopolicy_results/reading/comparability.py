"""Settings that must agree within one comparison: budgets, policy scopes, splits, fingerprints, the agents'
confinement, and whether hidden episodes and agents shared a kernel. Results that an audit disputes must not be mixed
with others.

These must agree over all runs of a suite: budget, scope, observation form, simulation rule, finish rule, detail of
the feedback, text of `AGENTS.md`, failed episodes, hidden evaluation, profile, jail, hidden isolation, hidden cases,
and the limits of agents with a model. The prompts must agree over the runs
of one entry. These must agree over the runs of one environment, since environments differ
in them anyway: splits (by hash), library fingerprint, environment version, bounds of a submit, a policy's limits,
step limit, and videos in feedback. Runs with hidden cases of their own differ in these splits by design.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.environment import Split
from evopolicy_common.records.fingerprints import comparable
from evopolicy_common.records.run_record import inputs_digest
from evopolicy_common.terminal import counted
from evopolicy_results.reading.environments import ordered_environments, suites_of
from evopolicy_results.reading.records import Run, path_text


class Mixture(msgspec.Struct, frozen=True, kw_only=True):
    """One setting in which compared runs differ."""

    what: str
    """`episode budget`, `policy scope`, `train split`, …"""
    where: str
    """Suite or environment."""
    values: dict[str, int]
    """Each value as text, to the number of runs with it."""
    folders: dict[str, tuple[str, ...]] = {}
    """Each value to the folders of the runs with it; empty if the runs have none, or the value names its run."""

    def __str__(self) -> str:
        found = ", ".join(f"{value} ({counted(n, 'run')})" for value, n in self.values.items())
        return f"{self.what} on {self.where}" + (f": {found}" if found else "")


class MixedRunsError(EvopolicyError):
    """The runs are not a fair comparison; `mixtures` lists the differences."""

    def __init__(self, mixtures: Sequence[Mixture]) -> None:
        super().__init__("\n".join(["these runs cannot be compared:", *_named(mixtures)]))
        self.mixtures = tuple(mixtures)


_MOST_NAMED = 5
"""Of the values of a setting, and of the runs of a value, in an error."""


def _named(mixtures: Sequence[Mixture]) -> Iterator[str]:
    """Lines with the differences, and with the folders of the runs where another difference has not named them."""
    told: dict[frozenset[tuple[str, ...]], Mixture] = {}
    for mixture in mixtures:
        yield f"  {mixture}"
        first = told.setdefault(frozenset(mixture.folders.values()), mixture)
        if first is not mixture and mixture.folders:
            yield f"    the same runs as for the {first.what}"
            continue
        for value, folders in islice(mixture.folders.items(), _MOST_NAMED):
            more = len(folders) - _MOST_NAMED
            yield f"    {value}: {', '.join(folders[:_MOST_NAMED])}" + (
                f" and {more} more" if more > 0 else ""
            )
        if (more := len(mixture.folders) - _MOST_NAMED) > 0:
            yield f"    and {more} more values"


IN_QUESTION = "results in dispute, or of a forger,"
UNKNOWN_ISOLATION = "hidden isolation, where some runs do not tell it,"
"""Older runs without this record beside runs with it; their comparison needs an option of its own."""

_SAME_CASES = "the same cases (one --state or --data for all, none with --fresh, all in the same --jail)"


class _Setting(NamedTuple):
    """A setting in which compared runs have to agree."""

    of: Callable[[Run], str]
    remedy: str = ""
    """How to play runs that agree in it; empty where no option decides it."""


def _dimension(name: str, remedy: str) -> _Setting:
    return _Setting(lambda run: str(getattr(run.record.experiment_dimensions, name)), remedy)


_BY_SUITE = {
    "episode budget": _dimension("episode_budget", "the same --budget"),
    "policy scope": _dimension("policy_scope", "the same --policy-scope"),
    "observation form": _dimension("observations", "the same --observations"),
    "simulation rule": _dimension("simulation", "the same --simulation"),
    "finish rule": _dimension("finish", "the same --finish"),
    "feedback detail": _dimension("feedback", "the same --feedback"),
    "text of AGENTS.md": _Setting(
        lambda run: _text(run.record.experiment_dimensions.agents_md), "the same --agents-md"
    ),
    "failed episodes": _dimension("failed_episodes", "the same --failed-episodes"),
    "hidden evaluation": _dimension("hidden_evaluation", "the same --profile"),
    "profile": _dimension("profile", "the same --profile"),
    "jail": _Setting(lambda run: run.record.jail, "the same --jail"),
    "hidden cases": _dimension("hidden_cases", "the same --hidden-cases"),
}
_ISOLATION = _Setting(lambda run: run.record.hidden_isolation)
_MODEL_LIMITS = {
    "model limits": _Setting(
        lambda run: _model_limits(run), "the same max_requests, max_tokens, and max_cost in the agents' files"
    )
}
_AGENT_LIMITS = {
    "agent limits": _Setting(
        lambda run: _agent_limits(run),
        "the same --agent-cpus, --agent-memory, --agent-pids, and --agent-disk, on machines that can keep"
        " them",
    )
}
_BY_ENTRY = {
    "prompts": _Setting(
        lambda run: _text(run.record.agent.prompts), "the same --prompts, or another --entry for each"
    ),
    "skills and MCP servers": _Setting(
        lambda run: inputs_digest(run.record.agent.inputs)[:12] or "none",
        "the same `skills` and `[mcp]` in the agent's file, or another --entry for each",
    ),
}
_BY_ENVIRONMENT = {
    "train split": _Setting(lambda run: _split(run, "train"), _SAME_CASES),
    "validation split": _Setting(lambda run: _split(run, "validation"), _SAME_CASES),
    "held-out split": _Setting(lambda run: _split(run, "heldout"), _SAME_CASES),
    "environment version": _Setting(lambda run: run.record.versions.env),
    "episodes a submit": _Setting(lambda run: run.submit_size, "the same --min-episodes and --max-episodes"),
    "policy limits": _Setting(lambda run: _limits(run), "the same --limit"),
    "step limit": _Setting(lambda run: _step_limit(run), "the same --step-limit"),
    "videos in feedback": _dimension("video", "the same --video"),
}
REMEDIES = {
    what: setting.remedy
    for what, setting in (_BY_SUITE | _BY_ENTRY | _MODEL_LIMITS | _AGENT_LIMITS | _BY_ENVIRONMENT).items()
    if setting.remedy
}
"""By `Mixture.what`: how to play runs that agree in it."""


def _split(run: Run, split: Split) -> str:
    if split != "train" and run.record.experiment_dimensions.hidden_cases == "per_run":
        return "its own"
    return run.record.versions.cases_hash(split).removeprefix("sha256:")[:12]


def _text(digest: str) -> str:
    return digest.removeprefix("sha256:")[:12] or "standard"


def _step_limit(run: Run) -> str:
    """Empty if the environment has only one limit."""
    entry = catalogue.entries().get(run.env)
    both = entry is not None and entry.published_steps is not None
    return run.record.experiment_dimensions.step_limit if both else ""


def _model_limits(run: Run) -> str:
    use = run.record.agent.model_use
    return _words(use and use.limits)


def _agent_limits(run: Run) -> str:
    resources = run.record.agent.resources
    return _words(resources and resources.limits)


def _limits(run: Run) -> str:
    return _words(run.record.experiment_dimensions.limits)


def _words(limits: msgspec.Struct | None) -> str:
    """As `name=value` words; empty if the run has no record of them."""
    given = {} if limits is None else msgspec.to_builtins(limits)
    return " ".join(f"{name}={value}" for name, value in given.items() if value is not None)


def mixtures(runs: Iterable[Run]) -> list[Mixture]:
    """Every difference between runs of one suite or environment, and disputed runs; empty for a fair comparison."""
    by_env: dict[str, list[Run]] = {}
    for run in runs:
        by_env.setdefault(run.env, []).append(run)
    out: list[Mixture] = []
    for suite, envs in suites_of(by_env).items():
        together = [run for env in envs for run in by_env[env]]
        out += _differences(_BY_SUITE, suite, together)
        out += _isolation(suite, together)
        # Agents without a model have no limits, and stand beside those with any.
        limited = [run for run in together if run.record.agent.model_use is not None]
        out += _differences(_MODEL_LIMITS, suite, limited)
        measured = [run for run in together if run.record.agent.resources is not None]
        out += _differences(_AGENT_LIMITS, suite, measured)
        for entry in sorted({run.entry for run in together}):
            out += _differences(
                _BY_ENTRY, f"{suite}, {entry}", [run for run in together if run.entry == entry]
            )
    for env in ordered_environments(by_env):
        out += _differences(_BY_ENVIRONMENT, env, by_env[env])
        out += _differences({"fingerprint": _Setting(_fingerprint_beside(by_env[env]))}, env, by_env[env])
        out += _in_question(env, by_env[env])
    return out


def _fingerprint_beside(runs: list[Run]) -> Callable[[Run], str]:
    """Returns a function for the parts of a run's fingerprint that differ among `runs`, and its overrides by the
    operator."""
    compared = comparable([run.record.versions.fingerprint for run in runs])
    items = {id(run): set(parts.items()) for run, parts in zip(runs, compared, strict=True)}
    common = set.intersection(*items.values())

    def beside(run: Run) -> str:
        versions = run.record.versions
        words = [f"{k}={v}" for k, v in sorted(items[id(run)] - common)]
        return " ".join([*words, *(f"then {each}" for each in versions.fingerprint_overrides)])

    return beside


def _isolation(suite: str, runs: list[Run]) -> list[Mixture]:
    """Differences among runs with a record of their isolation, and runs without one beside them."""
    known = [run for run in runs if run.record.hidden_isolation != "unknown"]
    found = _differences({"hidden isolation": _ISOLATION}, suite, known)
    if 0 < len(known) < len(runs):
        found += _differences({UNKNOWN_ISOLATION: _ISOLATION}, suite, runs)
    return found


def _in_question(env: str, runs: list[Run]) -> list[Mixture]:
    """Runs whose results may be forged, according to their own audits."""
    names = [run.name for run in runs if run.record.audit is not None and run.record.audit.in_question]
    return [Mixture(what=IN_QUESTION, where=env, values=dict.fromkeys(names, 1))] if names else []


def _differences(settings: dict[str, _Setting], where: str, runs: list[Run]) -> list[Mixture]:
    found: list[Mixture] = []
    for what, setting in settings.items():
        by_value: dict[str, list[str]] = {}
        for run in runs:
            by_value.setdefault(setting.of(run) or "none", []).append(path_text(run.path))
        if len(by_value) > 1:
            folders = {value: tuple(those) for value, those in sorted(by_value.items())}
            counts = {value: len(those) for value, those in folders.items()}
            found.append(Mixture(what=what, where=where, values=counts, folders=folders))
    return found
