"""Each pair of entries on every environment: gap, interval, permutation test, and Holm's correction over the suite."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec
import numpy as np

from evopolicy_coordinator.analysis.statistics import intervals
from evopolicy_coordinator.analysis.statistics.distributions import ALPHA, holm
from evopolicy_coordinator.analysis.statistics.intervals import (
    TOO_FEW_CASES,
    TOO_FEW_RUNS,
    Estimate,
    difference,
    of_runs,
)
from evopolicy_coordinator.analysis.statistics.permutation import (
    Test,
    label_test,
    patterns_for,
    sign_test,
)
from evopolicy_coordinator.analysis.statistics.resampling import RESAMPLES
from evopolicy_coordinator.analysis.statistics.samples import Floats, Sample, matched

Verdict = Literal["first", "second", "not told apart", "too few cases", "too few runs", "not comparable"]

NO_COMMON_CASES = "no common cases"
NO_RETURNS = "returns by case are not known"
NO_SCORE = "a run has no ok submit"


class Pair(msgspec.Struct, frozen=True, kw_only=True):
    """Two entries on one environment."""

    env: str
    first: str
    second: str
    gap: Estimate | None
    """`first − second`, held-out mean return on the common cases; None if either has no score."""
    compares: Literal["agents", "checkpoints"]
    """`checkpoints`: an entry has one run here, so the variation between its runs is unknown."""
    n_runs: tuple[int, int]
    n_cases: int
    """Common cases; 0 if runs are compared by their scores alone."""
    n_left_out: int
    """Cases that only some of the runs have; they cannot be paired."""
    p: float | None
    """p value of the permutation test; None without a test."""
    p_least: float | None
    """The smallest p that the test could give."""
    p_holm: float | None
    """Corrected over the suite's pairs of agents, or over its pairs with the random reference."""
    verdict: Verdict
    """The better entry by the corrected p at 5 %."""
    reason: str
    """Why there is no interval, or no test that could reject; empty otherwise."""


class _Draft(msgspec.Struct, kw_only=True):
    samples: tuple[Sample, Sample]
    gap: Estimate | None = None
    n_cases: int = 0
    n_left_out: int = 0
    test: Test | None = None
    reason: str = ""
    signs: Floats | None = None
    """Differences by case (or by run, against a fixed policy) whose signs are flipped; those of equal length share a
    test."""


def pairs(
    samples: Mapping[tuple[str, str], Sample],
    entries: Sequence[str],
    environments: Sequence[str],
    *,
    resamples: int = RESAMPLES,
) -> list[Pair]:
    """All pairs of `entries` (the reference last) that both have a sample on an environment."""
    drafts = [
        _draft((samples[one, env], samples[other, env]), resamples)
        for env in environments
        for one, other in itertools.combinations(entries, 2)
        if (one, env) in samples and (other, env) in samples
    ]
    families = [any(sample.is_fixed for sample in draft.samples) for draft in drafts]
    _test(drafts, patterns_for(max(1, len(drafts)), ALPHA))
    corrected: list[float | None] = [None] * len(drafts)
    sizes: dict[bool, int] = {}
    for family in (False, True):
        own = [i for i, fixed in enumerate(families) if fixed is family]
        found = [test.p if (test := drafts[i].test) is not None else None for i in own]
        sizes[family] = sum(p is not None for p in found)
        for i, p in zip(own, holm(found), strict=True):
            corrected[i] = p
    return [
        _pair(draft, p, sizes[family]) for draft, p, family in zip(drafts, corrected, families, strict=True)
    ]


def _draft(samples: tuple[Sample, Sample], resamples: int) -> _Draft:
    first, second = samples
    draft = _Draft(samples=samples)
    if first.scores is None or second.scores is None:
        draft.reason = NO_SCORE
        return draft
    many = len(first.runs) > 1 and (len(second.runs) > 1 or second.is_fixed)
    common = matched(samples)
    if common is not None:
        one, other = common.returns
        draft.gap = difference(one, other, resamples=resamples, fixed=second.is_fixed)
        draft.n_cases, draft.n_left_out = one.shape[1], common.n_left_out
        draft.reason = draft.gap.reason
        if not many:
            draft.signs = one.mean(axis=0) - other.mean(axis=0)
        elif len(other) == 1:
            draft.signs = (one - other).mean(axis=1)
        return draft
    if many and len(second.runs) > 1:
        draft.gap = of_runs(first.scores, second.scores)
        draft.reason = draft.gap.reason
        return draft
    draft.gap = Estimate(value=float(np.mean(first.scores) - np.mean(second.scores)))
    draft.reason = NO_RETURNS if not all(run.returns for s in samples for run in s.runs) else NO_COMMON_CASES
    return draft


def _test(drafts: Sequence[_Draft], n_random: int) -> None:
    """Runs the tests: those over cases share their sign patterns, those over runs are separate."""
    together: dict[int, list[_Draft]] = {}
    for draft in drafts:
        if draft.signs is not None:
            together.setdefault(len(draft.signs), []).append(draft)
        elif draft.gap is not None and draft.reason not in (NO_RETURNS, NO_COMMON_CASES):
            draft.test = label_test(*(_run_means(draft)), n_random)
    for group in together.values():
        columns = np.stack([draft.signs for draft in group if draft.signs is not None], axis=1)
        for draft, test in zip(group, sign_test(columns, n_random), strict=True):
            draft.test = test


def _run_means(draft: _Draft) -> tuple[list[float], list[float]]:
    common = matched(draft.samples)
    if common is None:
        first, second = (sample.scores or [] for sample in draft.samples)
        return first, second
    one, other = (matrix.mean(axis=1).tolist() for matrix in common.returns)
    return one, other


def _pair(draft: _Draft, p_holm: float | None, n_tests: int) -> Pair:
    first, second = draft.samples
    agents = len(first.runs) > 1 and (len(second.runs) > 1 or second.is_fixed)
    reason, test = draft.reason, draft.test
    verdict: Verdict = "not comparable"
    if test is not None and p_holm is not None and draft.gap is not None:
        if p_holm <= ALPHA and draft.gap.value != 0.0:
            verdict = "first" if draft.gap.value > 0.0 else "second"
        elif test.least * n_tests > ALPHA:
            verdict = "too few runs" if agents else "too few cases"
            reason = reason or (TOO_FEW_RUNS if agents else TOO_FEW_CASES)
        else:
            verdict = "not told apart"
    return Pair(
        env=first.env,
        first=first.entry,
        second=second.entry,
        gap=draft.gap,
        compares="agents" if agents else "checkpoints",
        n_runs=(len(first.runs), len(second.runs)),
        n_cases=draft.n_cases,
        n_left_out=draft.n_left_out,
        p=test.p if test is not None else None,
        p_least=test.least if test is not None else None,
        p_holm=p_holm,
        verdict=verdict,
        reason=reason,
    )


def cell_mean(sample: Sample, *, resamples: int = RESAMPLES) -> Estimate | None:
    """An entry's held-out mean on one environment; None if a run has no ok submit."""
    if sample.scores is None:
        return None
    common = matched([sample])
    if common is not None:
        return intervals.mean(common.returns[0], resamples=resamples)
    if len(sample.runs) == 1:
        return Estimate(value=sample.scores[0], reason=NO_RETURNS)
    return of_runs(sample.scores)
