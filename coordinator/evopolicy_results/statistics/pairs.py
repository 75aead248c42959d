"""Each pair of entries on every environment: gap, interval, p values, and Holm's correction over all pairs of the
suite; the smallest gap that an experiment resolves at 95 %, and the number of repeats that a given gap would need.

Agents with several runs are distinguished only if two tests agree at the corrected level. The p value of the interval
covers other cases, but relies on the variance that a few runs show: agents that solve a task in some runs may all agree
by chance. The exact test of exchanging runs relies on no variance, but takes the cases as given. The correction is of
the larger p value, so a verdict never contradicts the interval beside it: the interval's own p is at most 0.05 exactly
if the interval excludes 0.

Repeats that returned the same policy, byte for byte, are one sample.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Mapping, Sequence
from statistics import fmean, median
from typing import Literal

import msgspec
import numpy as np
from msgspec.structs import replace

from evopolicy_common.statistics.intervals import (
    ALPHA,
    RESAMPLES,
    Estimate,
    Floats,
    normal_quantile,
    normal_two_sided,
)
from evopolicy_results.scoring.scores import Cell, Scale
from evopolicy_results.statistics import intervals
from evopolicy_results.statistics.intervals import components, difference, holm, of_runs, t_two_sided

Verdict = Literal["first", "second", "not told apart", "too few runs", "not comparable"]

NO_COMMON_CASES = "no common cases"
NO_RETURNS = "returns by case are not known"
NO_SCORE = "a run has no ok submit"
MAX_CASES = 100_000
MAX_REPEATS = 1000
MAX_EXCHANGED = 40
"""Runs of two entries up to which all exchanges are counted."""
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
    """`checkpoints`: an entry has one run here, or one policy from all its runs, so the variation between its runs is
    unknown."""
    n_runs: tuple[int, int]
    """Runs that returned the same policy count as one."""
    n_cases: int
    """Common cases; 0 if runs are compared by their scores alone."""
    n_left_out: int
    """Cases that only some of the runs have; they cannot be paired."""
    p: float | None
    """Two-sided p value of no difference, from the interval's distribution; None without an interval."""
    p_exchange: float | None
    """p value of the exchange of runs on these given cases (`exchange_test`); None unless agents are compared."""
    p_holm: float | None = None
    """The larger of both, corrected over all pairs of the suite, those with the random reference included."""
    verdict: Verdict = "not comparable"
    """The better entry by the corrected p at 5 %. `too few runs`: no returns of so few runs could reach that level."""
    n_needed: int | None = None
    """Where agents are not told apart, runs of each (else held-out cases) with which every second experiment would
    resolve a difference of this size at the level that Holm's correction leaves; None where unknown or where more do
    not help. With too few runs, at least as many as that level needs."""
    reason: str
    """Why there is no interval; empty otherwise."""


class Matched(msgspec.Struct, frozen=True, kw_only=True):
    """Cells on the cases that all their runs have."""

    returns: tuple[Floats, ...]
    """One matrix runs × cases per cell; runs that returned the same policy are one row."""
    n_left_out: int
    """Number of cases that only some of the runs have."""


def matched(cells: Sequence[Cell]) -> Matched | None:
    """The cells' returns on their common cases; None if no case is common to all runs."""
    runs = [run for cell in cells for run in cell.runs]
    if not runs or any(not run.returns or run.score is None for run in runs):
        return None
    if len(runs) > 1 and (len({run.case_set for run in runs}) > 1 or not runs[0].case_set):
        return None
    every = np.full((len(runs), max(len(run.returns) for run in runs)), np.nan)
    for row, run in zip(every, runs, strict=True):
        row[: len(run.returns)] = run.returns
    has = np.isfinite(every)
    common = has.all(axis=0)
    if not common.any():
        return None
    ends = np.cumsum([len(cell.runs) for cell in cells])
    own = np.split(every[:, common], ends[:-1])
    return Matched(
        returns=tuple(clustered(values, cell.samples) for cell, values in zip(cells, own, strict=True)),
        n_left_out=int(has.any(axis=0).sum() - common.sum()),
    )


def returns_in(cell: Cell) -> Floats | None:
    """A matrix runs × cases, of the cases that all of the cell's runs have; None if there are none."""
    common = matched([cell])
    return None if common is None else common.returns[0]


def scores_in(cell: Cell) -> Floats | None:
    """The scores of its samples; None when a run has no ok submit."""
    return None if cell.scores is None else clustered(np.array(cell.scores), cell.samples)


def clustered(values: Floats, samples: Sequence[Sequence[int]]) -> Floats:
    """One row per sample from one row per run. The mean of the rows stays that of all runs, and their variance over
    their number is that of a mean of clusters (Cameron and Miller 2015, with the factor k/(k − 1) of k clusters)."""
    if len(samples) == len(values):
        return values
    mean, factor = values.mean(axis=0), len(samples) / len(values)
    return np.array([mean + factor * (values[one] - mean).sum(axis=0) for one in map(list, samples)])


def pairs(
    samples: Mapping[tuple[str, str], Cell],
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
    corrected = holm(
        [None if pair.p is None else max(pair.p, pair.p_exchange or 0.0) for pair, _ in compared]
    )
    n_open = sum(p is not None and p > ALPHA for p in corrected)
    return [_decided(pair, common, p, n_open) for (pair, common), p in zip(compared, corrected, strict=True)]


def _compared(first: Cell, second: Cell, resamples: int) -> tuple[Pair, Matched | None]:
    """The pair without its correction for all others, and the returns on the common cases."""
    gap, common, p_exchange = None, None, None
    n_runs = len(first.samples), len(second.samples)
    one, other = scores_in(first), scores_in(second)
    if one is not None and other is not None:
        common = matched((first, second))
        if common is not None:
            gap = difference(*common.returns, resamples=resamples)
            one, other = (matrix.mean(axis=1) for matrix in common.returns)
        elif min(n_runs) > 1:
            gap = of_runs(one, other)
        else:
            known = all(run.returns for run in (*first.runs, *second.runs))
            value = float(np.mean(one) - np.mean(other))
            gap = Estimate(value=value, reason=NO_COMMON_CASES if known else NO_RETURNS)
        p_exchange = exchange_test(one, other) if min(n_runs) > 1 else None
    pair = Pair(
        env=first.env,
        first=first.entry,
        second=second.entry,
        gap=gap,
        compares="agents" if min(n_runs) > 1 else "checkpoints",
        n_runs=n_runs,
        n_cases=0 if common is None else common.returns[0].shape[1],
        n_left_out=0 if common is None else common.n_left_out,
        p=None if gap is None else gap.p,
        p_exchange=p_exchange,
        reason=NO_SCORE if gap is None else gap.reason,
    )
    return pair, common


def exchange_test(first: Floats, second: Floats) -> float:
    """Two-sided p value of two groups of run scores from one distribution: the share of all divisions of the runs into
    two groups of these sizes whose means differ at least as much (the exact permutation test). Above `MAX_EXCHANGED`
    runs, its normal approximation (Hoeffding 1951).

    It takes the cases as given. Agents that differ by case therefore differ here even if they are equal on average over
    all cases, and more so with more runs.
    """
    n, values = len(first), np.concatenate([first, second])
    n_all = len(values)
    values = values - values.mean()
    values /= np.abs(values).max() or 1.0
    least = abs(values[:n].sum()) - _CLOSE
    if n_all > MAX_EXCHANGED:
        variance = float((values**2).sum()) * n * (n_all - n) / (n_all * (n_all - 1))
        return normal_two_sided(max(0.0, least) / math.sqrt(variance)) if variance > 0.0 else 1.0
    # Sums of the first group are those of its members in either half of all runs.
    halves = _sums_of_subsets(values[: n_all // 2]), _sums_of_subsets(values[n_all // 2 :])
    reached = 0
    for taken, sums in enumerate(halves[0]):
        if 0 <= n - taken < len(halves[1]):
            others = halves[1][n - taken]
            reached += int((len(others) - np.searchsorted(others, least - sums)).sum())
            reached += int(np.searchsorted(others, -least - sums, side="right").sum())
    return min(1.0, reached / math.comb(n_all, n))


def _sums_of_subsets(values: Floats) -> list[Floats]:
    """The sums of all subsets by their number of members, each sorted."""
    by_size, none = [np.zeros(1)], np.zeros(0)
    for value in values:
        grown = [none, *(sums + value for sums in by_size)]
        by_size = [np.concatenate(both) for both in zip([*by_size, none], grown, strict=True)]
    return [np.sort(sums) for sums in by_size]


def _least_p(n_first: int, n_second: int) -> float:
    """The smallest p value of an exchange of so many runs."""
    return (2.0 if n_first == n_second else 1.0) / math.comb(n_first + n_second, n_first)


def least_runs(level: float) -> int:
    """The fewest runs of each agent whose exchange can reach `level`."""
    return next(n for n in itertools.count(2) if _least_p(n, n) <= level)


def _decided(pair: Pair, common: Matched | None, p_holm: float | None, n_open: int) -> Pair:
    """`n_open`: pairs of the suite that are not told apart, whose smallest p must be at most 5 % over their number."""
    if pair.gap is None or p_holm is None:
        return pair
    if p_holm <= ALPHA:
        return replace(pair, p_holm=p_holm, verdict="first" if pair.gap.value > 0.0 else "second")
    level = ALPHA / n_open
    n_needed = None if common is None else _needed(pair, pair.gap, common, level)
    if pair.compares == "agents" and _least_p(*pair.n_runs) > level:
        n_needed = max(n_needed or 0, least_runs(level))
        return replace(pair, p_holm=p_holm, verdict="too few runs", n_needed=n_needed)
    return replace(pair, p_holm=p_holm, verdict="not told apart", n_needed=n_needed)


def _needed(pair: Pair, gap: Estimate, common: Matched, level: float) -> int | None:
    if gap.value == 0.0:
        return None
    if pair.compares == "agents":
        n = repeats_needed(spread_of(*common.returns), abs(gap.value), level=level)
        return n and max(n, 1 + max(pair.n_runs))
    if gap.p is None or gap.p >= 1.0 - 1e-9:
        return None
    factor = normal_quantile(1.0 - level / 2.0) / normal_quantile(1.0 - gap.p / 2.0)
    n_cases = math.ceil(pair.n_cases * factor**2)
    return n_cases if n_cases <= MAX_CASES else None


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Variances of a difference between two agents on one environment, mean over both, or over all pairs."""

    run: float
    """Variance between runs of one agent, of their held-out means."""
    case: float
    """Variance of the difference that more runs do not reduce: agents differ by case, and these cases are a sample.
    An estimate, which may be below 0."""
    n_cases: int


def spread_of(*returns: Floats) -> Spread:
    """Variances of two agents, from matrices runs × the same cases."""
    parts = [components(matrix) for matrix in returns]
    gaps = components((returns[0].mean(axis=0) - returns[1].mean(axis=0))[None, :])
    return Spread(
        run=sum(part.runs * part.n_runs for part in parts) / 2.0,
        case=gaps.cases - sum(part.residual for part in parts),
        n_cases=gaps.n_cases,
    )


def repeats_needed(spread: Spread, gap: float, *, level: float = ALPHA) -> int | None:
    """The fewest runs per agent whose exchange can reach `level` and whose interval of a difference, at 1 − `level`, is
    no wider than ± `gap`. A true gap of that size is then distinguished from 0 in about half of all experiments. None
    if no number up to `MAX_REPEATS` does: the gap needs more cases. Raises ValueError for a gap that is not above 0."""
    if not gap > 0.0:
        raise ValueError(f"a gap of {gap} cannot be resolved; give one above 0")

    def resolves(n: int) -> bool:
        error, df = standard_error(spread, n)
        return error <= 0.0 or t_two_sided(gap / error, df) <= level

    least = least_runs(level)
    n = least + bisect.bisect_left(range(least, MAX_REPEATS + 1), True, key=resolves)
    return n if n <= MAX_REPEATS else None


def standard_error(spread: Spread, n: int) -> tuple[float, float]:
    """Standard error of a difference between two agents of n ≥ 2 runs each, and its degrees of freedom."""
    by_run, by_case = 2.0 * spread.run / n, max(0.0, spread.case)
    total = by_run + by_case
    if total <= 0.0:
        return 0.0, math.inf
    below = (by_run / total) ** 2 / (2.0 * (n - 1))
    below += (by_case / total) ** 2 / (spread.n_cases - 1) if spread.n_cases > 1 else 0.0
    return math.sqrt(total), round(1.0 / below, 3) if below > 0.0 else math.inf


def cell_mean(cell: Cell, *, resamples: int = RESAMPLES) -> Estimate | None:
    """An entry's held-out mean on one environment; None if a run has no ok submit."""
    if (scores := scores_in(cell)) is None:
        return None
    if (returns := returns_in(cell)) is not None:
        return intervals.mean(returns, resamples=resamples)
    return Estimate(value=float(scores[0]), reason=NO_RETURNS) if len(scores) == 1 else of_runs(scores)


GAPS = (0.05, 0.1, 0.2)
"""Gaps on the random-to-best scale for which a report gives the repeats."""


class Resolution(msgspec.Struct, frozen=True, kw_only=True):
    """The gap that one environment can resolve between agents."""

    env: str
    gap: float | None
    """Half width of the 95 % intervals of the differences, median over the pairs of agents, in returns."""
    scale: float | None
    """Best agent's mean minus the random reference's, in returns; None without such a scale."""
    n_cases: int
    n_runs: tuple[int, int]
    """Fewest and most runs of an agent."""
    spread: Spread | None
    """None unless every agent has two or more runs on the same cases: one run does not show how runs vary."""

    @property
    def normalised_gap(self) -> float | None:
        """`gap` as a share of the scale."""
        return None if self.gap is None or self.scale is None else self.gap / self.scale

    def repeats(self, share: float) -> int | Literal["more cases"] | None:
        """Runs per agent that resolve a gap of `share` of the scale, or that no number does; None if unknown."""
        if self.spread is None or self.scale is None:
            return None
        return repeats_needed(self.spread, share * self.scale) or "more cases"


def resolutions(
    samples: Mapping[tuple[str, str], Cell],
    compared: Sequence[Pair],
    agents: Sequence[str],
    scales: Mapping[str, Scale],
    environments: Sequence[str],
) -> list[Resolution]:
    """One for each environment that two or more agents have played."""
    out: list[Resolution] = []
    for env in environments:
        here = [samples[agent, env] for agent in agents if (agent, env) in samples]
        if len(here) < 2:
            continue
        own = [pair for pair in compared if pair.env == env and {pair.first, pair.second} <= set(agents)]
        gaps = [pair.gap for pair in own if pair.gap is not None]
        halves = [0.5 * (g.high - g.low) for g in gaps if g.low is not None and g.high is not None]
        n_runs = [len(sample.samples) for sample in here]
        out.append(
            Resolution(
                env=env,
                gap=median(halves) if halves else None,
                scale=scales[env].best - scales[env].random if env in scales else None,
                n_cases=max((pair.n_cases for pair in own), default=0),
                n_runs=(min(n_runs), max(n_runs)),
                spread=_spread(here),
            )
        )
    return out


def overall(resolved: Sequence[Resolution]) -> Resolution | None:
    """Resolution of the mean of normalised scores over environments, on which the scale is 1; None unless each
    environment has a scale and a gap. Environments are fixed: the suite is not a sample."""
    n = len(resolved)
    known = [gap for one in resolved if (gap := one.normalised_gap) is not None]
    if not known or len(known) < n:
        return None
    spreads = [(one.spread, one.scale**2) for one in resolved if one.spread and one.scale]
    spread = Spread(
        run=sum(one.run / square for one, square in spreads) / n**2,
        case=sum(one.case / square for one, square in spreads) / n**2,
        n_cases=sum(one.n_cases for one, _ in spreads),
    )
    return Resolution(
        env="",
        gap=math.sqrt(sum(gap**2 for gap in known)) / n,
        scale=1.0,
        n_cases=sum(one.n_cases for one in resolved),
        n_runs=(min(one.n_runs[0] for one in resolved), max(one.n_runs[1] for one in resolved)),
        spread=spread if len(spreads) == n else None,
    )


def _spread(samples: Sequence[Cell]) -> Spread | None:
    common = matched(samples)
    if common is None or any(len(matrix) < 2 for matrix in common.returns):
        return None
    spreads = [spread_of(one, other) for one, other in itertools.combinations(common.returns, 2)]
    return Spread(
        run=fmean(one.run for one in spreads),
        case=fmean(one.case for one in spreads),
        n_cases=spreads[0].n_cases,
    )
