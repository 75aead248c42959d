"""What must not be mixed in one comparison: budgets, policy scopes, splits, fingerprints, how agents were confined, whether
hidden episodes and agents shared a kernel, and results that an audit has put in question with any others.

Budget, scope, observation form, finish rule, profile, jail, hidden isolation and hidden cases must agree over all runs of a suite; splits (by
hash), library fingerprint, environment version, how large a submit may be, a policy's limits, and whether feedback has
videos over the runs of one environment, since environments differ in them anyway. Runs that played hidden cases of their
own differ in these splits by design.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.environment import Split
from evopolicy_common.records.fingerprints import comparable
from evopolicy_coordinator.analysis.reading.records import Run
from evopolicy_coordinator.analysis.scoring.scores import ordered_environments, suites_of


class Mixture(msgspec.Struct, frozen=True, kw_only=True):
    """One thing in which runs that are compared differ."""

    what: str
    """`episode budget`, `policy scope`, `train split`, …"""
    where: str
    """Suite or environment."""
    values: dict[str, int]
    """Each value as text, to the number of runs that have it."""

    def __str__(self) -> str:
        found = ", ".join(f"{value} ({n} run{'s' * (n != 1)})" for value, n in self.values.items())
        return f"{self.what} on {self.where}: {found}"


class MixedRunsError(EvopolicyError):
    """Runs that are no fair comparison; `mixtures` tells in what."""

    def __init__(self, mixtures: Sequence[Mixture]) -> None:
        super().__init__(
            "these runs are no one comparison:\n" + "\n".join(f"  {mixture}" for mixture in mixtures)
        )
        self.mixtures = tuple(mixtures)


IN_QUESTION = "results in dispute, or of a forger,"
UNKNOWN_ISOLATION = "hidden isolation, where some runs do not tell it,"
"""Runs from before it was recorded beside runs that tell it: compared only where that is allowed by name."""

_BY_SUITE: dict[str, Callable[[Run], str]] = {
    "episode budget": lambda run: str(run.budget),
    "policy scope": lambda run: run.record.experiment_dimensions.policy_scope,
    "observation form": lambda run: run.record.experiment_dimensions.observations,
    "simulation rule": lambda run: run.record.experiment_dimensions.simulation,
    "finish rule": lambda run: run.record.experiment_dimensions.finish,
    "profile": lambda run: run.record.experiment_dimensions.profile,
    "jail": lambda run: run.record.jail,
    "hidden cases": lambda run: run.record.experiment_dimensions.hidden_cases,
}
_BY_ENVIRONMENT: dict[str, Callable[[Run], str]] = {
    "train split": lambda run: _split(run, "train"),
    "validation split": lambda run: _split(run, "validation"),
    "held-out split": lambda run: _split(run, "heldout"),
    "environment version": lambda run: run.record.versions.env,
    "episodes a submit": lambda run: run.submit_size,
    "policy limits": lambda run: _limits(run),
    "step limit": lambda run: _step_limit(run),
    "videos in feedback": lambda run: run.record.experiment_dimensions.video,
}


_SAME_CASES = "the same cases (one --state or --data for all, none with --fresh, all in the same --jail)"
REMEDIES = {
    "episode budget": "the same --budget",
    "policy scope": "the same --policy-scope",
    "observation form": "the same --observations",
    "simulation rule": "the same --simulation",
    "finish rule": "the same --finish",
    "profile": "the same --profile",
    "jail": "the same --jail",
    "hidden cases": "the same --hidden-cases",
    **dict.fromkeys(("train split", "validation split", "held-out split"), _SAME_CASES),
    "episodes a submit": "the same --min-episodes and --max-episodes",
    "policy limits": "the same --limit",
    "step limit": "the same --step-limit",
    "videos in feedback": "the same --video",
}
"""How runs are to be played that agree in a thing, by `Mixture.what`."""


def _split(run: Run, split: Split) -> str:
    if split != "train" and run.record.experiment_dimensions.hidden_cases == "per_run":
        return "its own"
    return run.record.versions.cases_hash(split).removeprefix("sha256:")[:12]


def _step_limit(run: Run) -> str:
    """Empty where the environment has one limit only."""
    entry = catalogue.entries().get(run.env)
    both = entry is not None and entry.published_steps is not None
    return run.record.experiment_dimensions.step_limit if both else ""


def _limits(run: Run) -> str:
    """As `name=value` words; empty where the run does not tell."""
    limits = run.record.experiment_dimensions.limits
    return "" if limits is None else " ".join(f"{k}={v}" for k, v in msgspec.to_builtins(limits).items())


def mixtures(runs: Iterable[Run]) -> list[Mixture]:
    """Everything in which runs of one suite or environment differ, and runs that are in question; empty for a fair
    comparison."""
    by_env: dict[str, list[Run]] = {}
    for run in runs:
        by_env.setdefault(run.env, []).append(run)
    out: list[Mixture] = []
    for suite, envs in suites_of(by_env).items():
        together = [run for env in envs for run in by_env[env]]
        out += _differences(_BY_SUITE, suite, together)
        out += _isolation(suite, together)
    for env in ordered_environments(by_env):
        out += _differences(_BY_ENVIRONMENT, env, by_env[env])
        out += _differences({"fingerprint": _fingerprint_beside(by_env[env])}, env, by_env[env])
        out += _in_question(env, by_env[env])
    return out


def _fingerprint_beside(runs: list[Run]) -> Callable[[Run], str]:
    """What of a run's fingerprint is not the same in all of `runs`, as `name=version` words, and how an operator changed it."""
    compared = comparable([run.record.versions.fingerprint for run in runs])
    items = {id(run): set(parts.items()) for run, parts in zip(runs, compared, strict=True)}
    common = set.intersection(*items.values())

    def beside(run: Run) -> str:
        versions = run.record.versions
        words = [f"{k}={v}" for k, v in sorted(items[id(run)] - common)]
        return " ".join([*words, *(f"then {each}" for each in versions.fingerprint_overrides)])

    return beside


def _isolation(suite: str, runs: list[Run]) -> list[Mixture]:
    """Differences among the runs that tell it, and runs that do not tell it beside them."""
    told = {"hidden isolation": lambda run: run.record.hidden_isolation}
    known = [run for run in runs if run.record.hidden_isolation != "unknown"]
    found = _differences(told, suite, known)
    if 0 < len(known) < len(runs):
        found += _differences({UNKNOWN_ISOLATION: told["hidden isolation"]}, suite, runs)
    return found


def _in_question(env: str, runs: list[Run]) -> list[Mixture]:
    """Runs whose numbers may be forged, by the word of their own audits."""
    names = [run.name for run in runs if run.record.audit is not None and run.record.audit.in_question]
    return [Mixture(what=IN_QUESTION, where=env, values=dict.fromkeys(names, 1))] if names else []


def _differences(checks: dict[str, Callable[[Run], str]], where: str, runs: list[Run]) -> list[Mixture]:
    found: list[Mixture] = []
    for what, value_of in checks.items():
        counts: dict[str, int] = {}
        for run in runs:
            value = value_of(run) or "none"
            counts[value] = counts.get(value, 0) + 1
        if len(counts) > 1:
            found.append(Mixture(what=what, where=where, values=dict(sorted(counts.items()))))
    return found
