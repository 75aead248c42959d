"""Each pair of entries on every environment: gap, interval, p value, and Holm's correction over all pairs of the suite.

The verdict rests on the interval's own distribution, so it never contradicts the interval: the uncorrected p is at most
0.05 exactly if the interval excludes 0, and the corrected p is no smaller.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec
import numpy as np

from evopolicy_common.statistics import intervals
from evopolicy_common.statistics.distributions import ALPHA, holm, normal_quantile
from evopolicy_common.statistics.intervals import Estimate, difference, of_runs
from evopolicy_common.statistics.resampling import RESAMPLES
from evopolicy_results.statistics.permutation import label_test
from evopolicy_results.statistics.repeats import repeats_needed, spread_of
from evopolicy_results.statistics.samples import Matched, Sample, matched

Verdict = Literal["first", "second", "not told apart", "not comparable"]

NO_COMMON_CASES = "no common cases"
NO_RETURNS = "returns by case are not known"
NO_SCORE = "a run has no ok submit"
MAX_CASES = 100_000


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
    """Two-sided p value of no difference, from the interval's distribution; None without an interval."""
    p_holm: float | None
    """Corrected over all pairs of the suite, those with the random reference included."""
    p_these_cases: float | None
    """p value of an exchange of runs, which takes these cases as given; None unless both have several runs. No verdict
    rests on it."""
    verdict: Verdict
    """The better entry by the corrected p at 5 %."""
    n_needed: int | None
    """Where agents are not told apart, runs of each (else held-out cases) with which every second experiment would
    resolve a difference of this size at the level that Holm's correction leaves; None where unknown or where more do
    not help."""
    reason: str
    """Why there is no interval; empty otherwise."""


class _Draft(msgspec.Struct, kw_only=True):
    samples: tuple[Sample, Sample]
    gap: Estimate | None = None
    common: Matched | None = None
    reason: str = ""

    @property
    def agents(self) -> bool:
        first, second = self.samples
        return len(first.runs) > 1 and (len(second.runs) > 1 or second.is_fixed)

    @property
    def p(self) -> float | None:
        return None if self.gap is None else self.gap.p


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
    corrected = holm([draft.p for draft in drafts])
    n_open = sum(p is not None and p > ALPHA for p in corrected)
    return [_pair(draft, p, n_open) for draft, p in zip(drafts, corrected, strict=True)]


def _draft(samples: tuple[Sample, Sample], resamples: int) -> _Draft:
    first, second = samples
    draft = _Draft(samples=samples)
    if first.scores is None or second.scores is None:
        draft.reason = NO_SCORE
        return draft
    draft.common = matched(samples)
    if draft.common is not None:
        draft.gap = difference(*draft.common.returns, resamples=resamples, fixed=second.is_fixed)
    elif len(first.runs) > 1 and len(second.runs) > 1:
        draft.gap = of_runs(first.scores, second.scores)
    else:
        known = all(run.returns for sample in samples for run in sample.runs)
        gap = float(np.mean(first.scores) - np.mean(second.scores))
        draft.gap = Estimate(value=gap, reason=NO_COMMON_CASES if known else NO_RETURNS)
    draft.reason = draft.gap.reason
    return draft


def _pair(draft: _Draft, p_holm: float | None, n_open: int) -> Pair:
    first, second = draft.samples
    verdict: Verdict = "not comparable"
    if draft.gap is not None and p_holm is not None:
        verdict = "not told apart"
        if p_holm <= ALPHA:
            verdict = "first" if draft.gap.value > 0.0 else "second"
    common = draft.common
    return Pair(
        env=first.env,
        first=first.entry,
        second=second.entry,
        gap=draft.gap,
        compares="agents" if draft.agents else "checkpoints",
        n_runs=(len(first.runs), len(second.runs)),
        n_cases=0 if common is None else common.returns[0].shape[1],
        n_left_out=0 if common is None else common.n_left_out,
        p=draft.p,
        p_holm=p_holm,
        p_these_cases=_these_cases(draft),
        verdict=verdict,
        n_needed=_needed(draft, n_open) if verdict == "not told apart" else None,
        reason=draft.reason,
    )


def _these_cases(draft: _Draft) -> float | None:
    if draft.common is None or min(map(len, draft.common.returns)) < 2:
        return None
    one, other = (matrix.mean(axis=1).tolist() for matrix in draft.common.returns)
    return label_test(one, other)


def _needed(draft: _Draft, n_open: int) -> int | None:
    """`n_open`: pairs of the suite that are not told apart; the smallest p of them must be at most 5 % over their
    number."""
    if draft.gap is None or draft.p is None or draft.common is None or draft.gap.value == 0.0:
        return None
    level, one_and_other = ALPHA / n_open, draft.common.returns
    if draft.agents:
        n = repeats_needed(spread_of(*one_and_other), abs(draft.gap.value), level=level).n
        return (
            None if n is None else max(n, 1 + max(len(matrix) for matrix in one_and_other if len(matrix) > 1))
        )
    if draft.p >= 1.0 - 1e-9:
        return None
    factor = normal_quantile(1.0 - level / 2.0) / normal_quantile(1.0 - draft.p / 2.0)
    n_cases = math.ceil(one_and_other[0].shape[1] * factor**2)
    return n_cases if n_cases <= MAX_CASES else None


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
