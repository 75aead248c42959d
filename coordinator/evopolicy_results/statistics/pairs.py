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
from msgspec.structs import replace

from evopolicy_common.statistics import intervals
from evopolicy_common.statistics.distributions import ALPHA, holm, normal_quantile
from evopolicy_common.statistics.intervals import Estimate, difference, of_runs
from evopolicy_common.statistics.resampling import RESAMPLES, Floats, label_patterns
from evopolicy_results.statistics.repeats import repeats_needed, spread_of
from evopolicy_results.statistics.samples import Matched, Sample, matched

Verdict = Literal["first", "second", "not told apart", "not comparable"]

NO_COMMON_CASES = "no common cases"
NO_RETURNS = "returns by case are not known"
NO_SCORE = "a run has no ok submit"
MAX_CASES = 100_000
_CHUNK = 20_000
_CLOSE = 1e-9
"""Relative tolerance: statistics that differ only by rounding count as equal."""


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
    p_holm: float | None = None
    """Corrected over all pairs of the suite, those with the random reference included."""
    p_these_cases: float | None
    """p value of an exchange of runs, which takes these cases as given; None unless both have several runs. No verdict
    rests on it."""
    verdict: Verdict = "not comparable"
    """The better entry by the corrected p at 5 %."""
    n_needed: int | None = None
    """Where agents are not told apart, runs of each (else held-out cases) with which every second experiment would
    resolve a difference of this size at the level that Holm's correction leaves; None where unknown or where more do
    not help."""
    reason: str
    """Why there is no interval; empty otherwise."""


def pairs(
    samples: Mapping[tuple[str, str], Sample],
    entries: Sequence[str],
    environments: Sequence[str],
    *,
    resamples: int = RESAMPLES,
) -> list[Pair]:
    """All pairs of `entries` (the reference last) that both have a sample on an environment."""
    compared = [
        _compared(samples[one, env], samples[other, env], resamples)
        for env in environments
        for one, other in itertools.combinations(entries, 2)
        if (one, env) in samples and (other, env) in samples
    ]
    corrected = holm([pair.p for pair, _ in compared])
    n_open = sum(p is not None and p > ALPHA for p in corrected)
    return [_decided(pair, common, p, n_open) for (pair, common), p in zip(compared, corrected, strict=True)]


def _compared(first: Sample, second: Sample, resamples: int) -> tuple[Pair, Matched | None]:
    """The pair without its correction for all others, and the returns on the common cases."""
    gap, common = None, None
    if first.scores is not None and second.scores is not None:
        common = matched((first, second))
        if common is not None:
            gap = difference(*common.returns, resamples=resamples, fixed=second.is_fixed)
        elif len(first.runs) > 1 and len(second.runs) > 1:
            gap = of_runs(first.scores, second.scores)
        else:
            known = all(run.returns for run in (*first.runs, *second.runs))
            value = float(np.mean(first.scores) - np.mean(second.scores))
            gap = Estimate(value=value, reason=NO_COMMON_CASES if known else NO_RETURNS)
    p_these_cases = None
    if common is not None and min(map(len, common.returns)) > 1:
        p_these_cases = label_test(*(matrix.mean(axis=1).tolist() for matrix in common.returns))
    of_agents = len(first.runs) > 1 and (len(second.runs) > 1 or second.is_fixed)
    pair = Pair(
        env=first.env,
        first=first.entry,
        second=second.entry,
        gap=gap,
        compares="agents" if of_agents else "checkpoints",
        n_runs=(len(first.runs), len(second.runs)),
        n_cases=0 if common is None else common.returns[0].shape[1],
        n_left_out=0 if common is None else common.n_left_out,
        p=None if gap is None else gap.p,
        p_these_cases=p_these_cases,
        reason=NO_SCORE if gap is None else gap.reason,
    )
    return pair, common


def label_test(first: Sequence[float], second: Sequence[float], n_random: int = 1999) -> float:
    """p value of two groups of run scores, of two or more runs each, coming from one distribution.

    It takes the cases as given. Agents that differ by case therefore differ here even if they are equal on average over
    all cases, and more so with more runs. The statistic is Welch's t, so that entries of equal mean and unequal spread
    are not reported as different when there are many runs (Janssen 1997). All patterns are tried if they are few,
    otherwise a random sample plus the observed pattern.
    """
    n_first, n_second = len(first), len(second)
    pooled = np.array([*first, *second])
    pooled = pooled - pooled.mean()
    patterns, exact = label_patterns(n_first, n_second, n_random)
    own = np.repeat([[1.0, 0.0]], [n_first, n_second], axis=1)
    observed = float(_welch(own, pooled, n_first, n_second)[0])
    reached = 0
    for start in range(0, len(patterns), _CHUNK):
        t = _welch(patterns[start : start + _CHUNK], pooled, n_first, n_second)
        reached += int((t >= observed * (1.0 - _CLOSE)).sum())
    return reached / len(patterns) if exact else (reached + 1.0) / (len(patterns) + 1.0)


def _welch(labels: Floats, pooled: Floats, n_first: int, n_second: int) -> Floats:
    """t| of each pattern: 0 without spread and difference, infinite for a difference without spread."""
    scale = float(np.abs(pooled).max(initial=0.0))
    if scale == 0.0:
        return np.zeros(len(labels))
    values = pooled / scale
    sums, squares = labels @ values, labels @ values**2
    first, second = sums / n_first, (values.sum() - sums) / n_second
    v_first = np.maximum(0.0, squares / n_first - first**2) / (n_first - 1)
    v_second = np.maximum(0.0, ((values**2).sum() - squares) / n_second - second**2) / (n_second - 1)
    gap, error = np.abs(first - second), np.sqrt(v_first + v_second)
    error = np.where(error < _CLOSE, 0.0, error)
    with np.errstate(divide="ignore", invalid="ignore"):
        t: Floats = np.where(gap < _CLOSE, 0.0, gap / error)
    return t


def _decided(pair: Pair, common: Matched | None, p_holm: float | None, n_open: int) -> Pair:
    if pair.gap is None or p_holm is None:
        return pair
    if p_holm <= ALPHA:
        return replace(pair, p_holm=p_holm, verdict="first" if pair.gap.value > 0.0 else "second")
    n_needed = None if common is None or pair.gap.value == 0.0 else _needed(pair, common, n_open)
    return replace(pair, p_holm=p_holm, verdict="not told apart", n_needed=n_needed)


def _needed(pair: Pair, common: Matched, n_open: int) -> int | None:
    """`n_open`: pairs of the suite that are not told apart; the smallest p of them must be at most 5 % over their
    number."""
    assert pair.gap is not None
    assert pair.p is not None
    level = ALPHA / n_open
    if pair.compares == "agents":
        n = repeats_needed(spread_of(*common.returns), abs(pair.gap.value), level=level)
        return n and max(n, 1 + max(len(matrix) for matrix in common.returns if len(matrix) > 1))
    if pair.p >= 1.0 - 1e-9:
        return None
    factor = normal_quantile(1.0 - level / 2.0) / normal_quantile(1.0 - pair.p / 2.0)
    n_cases = math.ceil(pair.n_cases * factor**2)
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
