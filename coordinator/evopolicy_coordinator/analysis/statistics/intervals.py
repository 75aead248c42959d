"""95 % intervals of means and of paired differences. `docs/explanation/statistics.md` has the measured coverage of
each method.

The method depends on the data, as chosen by measured coverage:

- One run: over cases. Differences of returns with two values (such as 0 and 1) get Bonett and Price's (2012) adjusted
  Wald interval, all others the symmetric studentised bootstrap (Hall 1988). Fewer than `LEAST_CASES` cases get no
  interval.
- Several runs: over runs and cases, which are crossed, as every run plays the same cases. From `BOOTSTRAP_RUNS` runs
  on, the percentiles of a hierarchical bootstrap with runs as the unit. Below that, a t interval whose variance is
  that of runs plus the part of the cases' variance that runs share (random-effects analysis of variance,
  Satterthwaite's degrees of freedom).
- Several runs without common cases: Welch's t interval over run means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_coordinator.analysis.statistics.distributions import (
    ALPHA,
    CONFIDENCE,
    normal_quantile,
    t_quantile,
)
from evopolicy_coordinator.analysis.statistics.resampling import RESAMPLES, weights
from evopolicy_coordinator.analysis.statistics.samples import Floats

LEAST_CASES = 5
"""With fewer cases no method reaches its coverage."""
BOOTSTRAP_RUNS = 10
"""Runs per entry from which the hierarchical bootstrap reaches its coverage."""
_NOUGHT = 1e-9
"""Relative bound: a smaller spread is rounding error."""

Method = Literal["bootstrap-t", "adjusted Wald", "hierarchical bootstrap", "crossed t", "Welch t", "none"]
Over = Literal["cases", "runs and cases", "runs", "nothing"]

TOO_FEW_CASES = "too few cases"
NO_SPREAD = "no spread"
TOO_FEW_RUNS = "too few runs"


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """A number with its 95 % interval."""

    value: float
    low: float | None = None
    high: float | None = None
    """Both None if no method applies; `reason` explains it."""
    method: Method = "none"
    over: Over = "nothing"
    """The units that a repetition of the experiment would draw again."""
    reason: str = ""


class Components(msgspec.Struct, frozen=True, kw_only=True):
    """Variance components of a mean over runs and crossed cases; each is a variance of that mean."""

    runs: float
    """Variance of run means over the number of runs, residual included."""
    residual: float
    """Its part that neither run nor case explains; 0 for one run."""
    cases: float
    """Variance of case means over the number of cases, residual included."""
    n_runs: int
    n_cases: int


def components(returns: Floats) -> Components:
    """Variance components of a matrix runs × cases without missing values."""
    n_runs, n_cases = returns.shape
    by_run, by_case = returns.mean(axis=1), returns.mean(axis=0)
    residual = 0.0
    if n_runs > 1 and n_cases > 1:
        rest = returns - by_run[:, None] - by_case + returns.mean()
        residual = float((rest**2).sum()) / ((n_runs - 1) * (n_cases - 1)) / (n_runs * n_cases)
    return Components(
        runs=float(by_run.var(ddof=1)) / n_runs if n_runs > 1 else 0.0,
        residual=residual,
        cases=float(by_case.var(ddof=1)) / n_cases if n_cases > 1 else 0.0,
        n_runs=n_runs,
        n_cases=n_cases,
    )


def difference(first: Floats, second: Floats, *, resamples: int = RESAMPLES, fixed: bool = False) -> Estimate:
    """Estimates `first − second` from matrices runs × the same cases.

    Over runs and cases if both have two or more runs; with `fixed`, if `first` has, as `second` is one given policy.
    Otherwise over cases alone.
    """
    value = float(first.mean() - second.mean())
    over_runs = len(first) > 1 and (len(second) > 1 or fixed)
    if not over_runs:
        return over_cases(
            first.mean(axis=0) - second.mean(axis=0),
            (first, second) if len(first) == len(second) == 1 else (),
            resamples=resamples,
        )
    parts = [components(one) for one in (first, second) if len(one) > 1]
    shared = components((first.mean(axis=0) - second.mean(axis=0))[None, :]).cases
    groups = [one for one in (first, second) if len(one) > 1]
    if min(map(len, groups)) < BOOTSTRAP_RUNS:
        return _crossed(value, parts, shared, first.shape[1])
    return _hierarchical(value, groups, parts, first.mean(axis=0) - second.mean(axis=0), resamples)


def mean(returns: Floats, *, resamples: int = RESAMPLES) -> Estimate:
    """The mean of a matrix runs × cases: over runs and cases, or over the cases of a single run."""
    if len(returns) == 1:
        return over_cases(returns[0], (returns,), resamples=resamples)
    value = float(returns.mean())
    part = components(returns)
    if len(returns) < BOOTSTRAP_RUNS:
        return _crossed(value, [part], part.cases, returns.shape[1])
    return _hierarchical(value, [returns], [part], returns.mean(axis=0), resamples)


def of_runs(first: Sequence[float], second: Sequence[float] = ()) -> Estimate:
    """Mean of `first`, or `first − second`, from run scores alone: Welch's t interval over runs."""
    groups = [np.asarray(one, dtype=np.float64) for one in (first, second) if len(one)]
    value = float(groups[0].mean() - (groups[1].mean() if len(groups) > 1 else 0.0))
    if any(len(group) < 2 for group in groups):
        return Estimate(value=value, reason=TOO_FEW_RUNS)
    variances = [float(group.var(ddof=1)) / len(group) for group in groups]
    total = sum(variances)
    if _is_nought(total, groups):
        return Estimate(value=value, reason=NO_SPREAD)
    df = 1.0 / sum((v / total) ** 2 / (len(g) - 1) for v, g in zip(variances, groups, strict=True))
    return _t_interval(value, total, df, "Welch t", "runs")


def over_cases(values: Floats, returns: Sequence[Floats] = (), *, resamples: int = RESAMPLES) -> Estimate:
    """The mean of one value per case. `returns` are the returns behind the values if these are single episodes:
    two-valued returns are counted, not averaged."""
    n = len(values)
    value = float(values.mean())
    if n < LEAST_CASES:
        return Estimate(value=value, method="none", over="cases", reason=TOO_FEW_CASES)
    levels = _two_levels(returns)
    if levels is not None:
        low, high = adjusted_wald(values, levels[1] - levels[0], paired=len(returns) > 1)
        if len(returns) == 1:
            low, high = low + levels[0], high + levels[0]
        return Estimate(value=value, low=low, high=high, method="adjusted Wald", over="cases")
    half = float(bootstrap_t(values[:, None], resamples=resamples)[0])
    if not math.isfinite(half):
        return Estimate(value=value, over="cases", reason=NO_SPREAD if _constant(values) else TOO_FEW_CASES)
    return Estimate(value=value, low=value - half, high=value + half, method="bootstrap-t", over="cases")


def bootstrap_t(columns: Floats, *, resamples: int = RESAMPLES, seed: int = 0) -> Floats:
    """Half widths of symmetric studentised bootstrap intervals of each column's mean; infinite if too few values
    differ.

    `columns` is (cases, m); each column is its own sample, resampled with the same draws.
    """
    n = len(columns)
    centre, spread = columns.mean(axis=0), columns.std(axis=0, ddof=1)
    varies = spread > _NOUGHT * np.maximum(1e-300, np.abs(columns).max(axis=0))
    scaled = np.where(varies, (columns - centre) / np.where(varies, spread, 1.0), 0.0)
    drawn = weights(n, n, resamples, seed) / n
    means = drawn @ scaled
    variances = np.maximum(0.0, drawn @ scaled**2 - means**2) / (n - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.abs(means) / np.sqrt(variances)
    t = np.where(variances > _NOUGHT**2, t, np.inf)
    quantile = np.quantile(t, CONFIDENCE, axis=0, method="inverted_cdf")
    half: Floats = np.where(varies, np.where(varies, quantile, 0.0) * spread / math.sqrt(n), np.inf)
    return half


def adjusted_wald(values: Floats, step: float, *, paired: bool) -> tuple[float, float]:
    """Interval of the mean of two-valued returns (0 or `step`), or of the paired difference of two such.

    Paired: Bonett and Price (2012), one case added to each kind of disagreement. One sample: Agresti and Coull
    (1998).
    """
    z = normal_quantile(1.0 - ALPHA / 2.0)
    n = len(values)
    up = float((values > 0.5 * step).sum())
    if paired:
        down = float((values < -0.5 * step).sum())
        up, down, n = up + 1.0, down + 1.0, n + 2
        centre = (up - down) / n
        half = z * math.sqrt(max(0.0, (up + down) / n - centre**2) / n)
        return step * max(-1.0, centre - half), step * min(1.0, centre + half)
    total = n + z * z
    centre = (up + 0.5 * z * z) / total
    half = z * math.sqrt(centre * (1.0 - centre) / total)
    return step * max(0.0, centre - half), step * min(1.0, centre + half)


def resampled_means(
    returns: Floats, resamples: int, seed: int, *, unbiased: bool = False, cases_seed: int = 0
) -> Floats:
    """(resamples,) means of a matrix runs × cases.

    Cases are drawn by `cases_seed` alone, so runs on the same cases share their draws; runs are drawn by `seed`, and
    a single run is kept. `unbiased` draws one unit fewer: the variance over resamples is then that of the mean
    without the factor (n − 1)/n, which matters for few runs (McCarthy and Snowden 1985).
    """
    n_runs, n_cases = returns.shape
    fewer = int(unbiased)
    n_drawn = n_cases - fewer if n_cases > 1 else n_cases
    by_run = returns @ (weights(n_cases, n_drawn, resamples, cases_seed) / n_drawn).T
    if n_runs == 1:
        single: Floats = by_run[0]
        return single
    n_drawn = n_runs - fewer
    found: Floats = (weights(n_runs, n_drawn, resamples, seed) * by_run.T).sum(axis=1) / n_drawn
    return found


def _hierarchical(
    value: float, groups: Sequence[Floats], parts: Sequence[Components], by_case: Floats, resamples: int
) -> Estimate:
    """Percentile interval over draws of runs, and of cases, which all runs share.

    Run means already contain the residual of their cases, so the draw of cases is shrunk to the part of its variance
    that is not residual. With one draw fewer than units, both variances are unbiased (Davison and Hinkley 1997,
    section 3.8).
    """
    drawn = np.full(resamples, value)
    for number, group in enumerate(groups):
        by_run = group.mean(axis=1)
        n = len(by_run)
        change = weights(n, n - 1, resamples, 1 + number) @ (by_run - by_run.mean()) / (n - 1)
        drawn += -change if number else change
    n = len(by_case)
    shared = components(by_case[None, :]).cases
    beyond = max(0.0, shared - sum(part.residual for part in parts))
    if beyond > 0.0:
        change = weights(n, n - 1, resamples, 0) @ (by_case - by_case.mean()) / (n - 1)
        drawn += math.sqrt(beyond / shared) * change
    if _constant(drawn):
        return Estimate(value=value, over="runs and cases", reason=NO_SPREAD)
    # Percentiles are too narrow by the ratio of normal to t quantile (Hesterberg 2015, expanded percentile interval).
    tail = 1.0 - NormalDist().cdf(t_quantile(1.0 - ALPHA / 2.0, round(_variance(parts, shared, n)[1], 6)))
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return Estimate(
        value=value, low=float(low), high=float(high), method="hierarchical bootstrap", over="runs and cases"
    )


def _crossed(value: float, parts: Sequence[Components], shared: float, n_cases: int) -> Estimate:
    """t interval from the runs' variance, which contains the residual, plus the rest of the cases' variance."""
    total, df = _variance(parts, shared, n_cases)
    if total <= (_NOUGHT * abs(value)) ** 2:
        return Estimate(value=value, over="runs and cases", reason=NO_SPREAD)
    return _t_interval(value, total, df, "crossed t", "runs and cases")


def _variance(parts: Sequence[Components], shared: float, n_cases: int) -> tuple[float, float]:
    """Variance of a mean over runs and crossed cases, with Satterthwaite's degrees of freedom, at least 1."""
    beyond = max(0.0, shared - sum(part.residual for part in parts))
    total = sum(part.runs for part in parts) + beyond
    if total <= 0.0:
        return 0.0, 1.0
    below = sum((part.runs / total) ** 2 / (part.n_runs - 1) for part in parts)
    below += (beyond / total) ** 2 / (n_cases - 1) if n_cases > 1 else 0.0
    return total, max(1.0, 1.0 / below) if below > 0.0 else 1.0


def _t_interval(value: float, variance: float, df: float, method: Method, over: Over) -> Estimate:
    half = t_quantile(1.0 - ALPHA / 2.0, round(df, 6)) * math.sqrt(variance)
    return Estimate(value=value, low=value - half, high=value + half, method=method, over=over)


def _two_levels(returns: Sequence[Floats]) -> tuple[float, float] | None:
    """The two values that all returns take; None if they take one, or more than two."""
    if not returns:
        return None
    found: NDArray[np.float64] = np.unique(np.concatenate([one.ravel() for one in returns]))
    return (float(found[0]), float(found[1])) if len(found) == 2 else None


def _constant(values: Floats) -> bool:
    return float(np.ptp(values)) <= _NOUGHT * float(np.abs(values).max(initial=0.0))


def _is_nought(variance: float, groups: Sequence[Floats]) -> bool:
    scale = max(float(np.abs(group).max()) for group in groups)
    return variance <= (_NOUGHT * scale) ** 2
