"""95 % intervals of means and of paired differences, and the p values of the same distributions: a p value is at most
0.05 exactly if its interval excludes 0. Reports use them, and so do the ends of `run` and `local`.
`docs/explanation/statistics.md` has the measured coverage of each method.

The method depends on the data, as chosen by measured coverage:

- One run: over cases. Differences of returns with two values (such as 0 and 1) get Tango's (1998) score interval, all
  others the symmetric studentised bootstrap (Hall 1988). Fewer than `LEAST_CASES` cases get no interval.
- Several runs: over runs and cases, which are crossed, as every run plays the same cases. A t interval whose variance
  is that of runs plus the part of the cases' variance that runs share, which contains agent × case (random-effects
  analysis of variance). Degrees of freedom are Satterthwaite's, and those of unequal numbers of runs at most twice the
  smaller number's: otherwise a small variance of few runs counts as known.
- Several runs without common cases: Welch's t interval over run means.
- A mean over environments: a t interval from the sum of their variances, with Satterthwaite's degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_common.statistics.distributions import (
    ALPHA,
    CONFIDENCE,
    normal_quantile,
    normal_two_sided,
    t_quantile,
    t_two_sided,
)
from evopolicy_common.statistics.resampling import RESAMPLES, Floats, weights

LEAST_CASES = 5
"""With fewer cases no method reaches its coverage."""
_RELATIVE_ZERO = 1e-9
"""Relative bound: a smaller spread is rounding error."""

Method = Literal["bootstrap-t", "adjusted Wald", "score", "crossed t", "Welch t", "stratified t", "none"]
Over = Literal["cases", "runs and cases", "runs", "worlds, runs, and cases", "nothing"]

TOO_FEW_CASES = "too few cases"
TOO_FEW_RUNS = "too few runs"
TOO_FEW_UNITS = "too few worlds or runs"


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """A number with its 95 % interval."""

    value: float
    low: float | None = None
    high: float | None = None
    """Both None if no method applies; `reason` explains it."""
    method: Method = "none"
    over: Over = "nothing"
    """The units that a repetition of the experiment would draw again."""
    p: float | None = None
    """Two-sided p value of the true value 0, from the interval's own distribution; None without an interval."""
    reason: str = ""


def no_spread(n: int, unit: str = "repeats") -> str:
    """Why there is no interval where all of `n` units are equal: their variance cannot be estimated."""
    return f"no spread: {n} identical {unit}"


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
    by_case = first.mean(axis=0) - second.mean(axis=0)
    if len(first) < 2 or (len(second) < 2 and not fixed):
        returns = (first, second) if len(first) == len(second) == 1 else ()
        return over_cases(by_case, returns, resamples=resamples)
    parts = [components(one) for one in (first, second) if len(one) > 1]
    return _crossed(float(first.mean() - second.mean()), parts, by_case)


def mean(returns: Floats, *, resamples: int = RESAMPLES) -> Estimate:
    """The mean of a matrix runs × cases: over runs and cases, or over the cases of a single run."""
    if len(returns) == 1:
        return over_cases(returns[0], (returns,), resamples=resamples)
    return _crossed(float(returns.mean()), [components(returns)], returns.mean(axis=0))


def of_runs(first: Sequence[float], second: Sequence[float] = ()) -> Estimate:
    """Mean of `first`, or `first − second`, from run scores alone: Welch's t interval over runs."""
    groups = [np.asarray(one, dtype=np.float64) for one in (first, second) if len(one)]
    value = float(groups[0].mean() - (groups[1].mean() if len(groups) > 1 else 0.0))
    if any(len(group) < 2 for group in groups):
        return Estimate(value=value, reason=TOO_FEW_RUNS)
    variances = [float(group.var(ddof=1)) / len(group) for group in groups]
    total = sum(variances)
    scale = max(float(np.abs(group).max()) for group in groups)
    if total <= (_RELATIVE_ZERO * scale) ** 2:
        return Estimate(value=value, reason=no_spread(min(map(len, groups))))
    return _t_interval(value, total, _runs_df(variances, [len(one) for one in groups]), "Welch t", "runs")


class Stratum(NamedTuple):
    """A mean, such as that of one environment, with the variance of this mean and its degrees of freedom."""

    value: float
    variance: float
    """NaN if it cannot be estimated."""
    df: float


def stratum(returns: Floats) -> Stratum:
    """The mean of a matrix runs × cases: over runs and cases, or over the cases of a single run."""
    n_runs, n_cases = returns.shape
    parts, value = components(returns), float(returns.mean())
    if n_cases < 2:
        return Stratum(value, math.nan, 1.0)
    if n_runs < 2:
        return Stratum(value, parts.cases, n_cases - 1.0)
    return Stratum(value, *_variance([parts], parts.cases, n_cases))


def stratum_of(values: Sequence[float]) -> Stratum:
    """The mean of units of one kind, such as worlds."""
    n = len(values)
    return Stratum(float(np.mean(values)), float(np.var(values, ddof=1)) / n if n > 1 else math.nan, n - 1.0)


def stratified(strata: Sequence[Stratum], weights: Sequence[float], over: Over) -> Estimate:
    """The weighted sum of independent means."""
    value = float(sum(w * each.value for w, each in zip(weights, strata, strict=True)))
    variances = [w * w * each.variance for w, each in zip(weights, strata, strict=True)]
    total = sum(variances)
    if not math.isfinite(total):
        return Estimate(value=value, over=over, reason=TOO_FEW_UNITS)
    if total <= (_RELATIVE_ZERO * max(1e-300, *(abs(each.value) for each in strata))) ** 2:
        return Estimate(value=value, over=over, reason="no spread")
    shares = [(v / total) ** 2 / each.df for v, each in zip(variances, strata, strict=True) if v > 0.0]
    return _t_interval(value, total, 1.0 / sum(shares), "stratified t", over)


def over_cases(values: Floats, returns: Sequence[Floats] = (), *, resamples: int = RESAMPLES) -> Estimate:
    """The mean of one value per case. `returns`: those of single episodes; two-valued ones are counted."""
    n = len(values)
    value = float(values.mean())
    if n < LEAST_CASES:
        return Estimate(value=value, method="none", over="cases", reason=TOO_FEW_CASES)
    levels: NDArray[np.float64] = np.unique(np.concatenate([one.ravel() for one in returns] or [np.zeros(0)]))
    if len(levels) == 2:
        least, step = float(levels[0]), float(levels[1] - levels[0])
        if len(returns) > 1:
            return score_interval(values, step)
        # Agresti and Coull 1998.
        z = normal_quantile(1.0 - ALPHA / 2.0)
        total = n + z * z
        centre = (float((values - least > 0.5 * step).sum()) + 0.5 * z * z) / total
        width = z * math.sqrt(centre * (1.0 - centre) / total)
        low, high = (least + step * bound for bound in (max(0.0, centre - width), min(1.0, centre + width)))
        return Estimate(value=value, low=low, high=high, method="adjusted Wald", over="cases")
    half = float(bootstrap_t(values[:, None], resamples=resamples)[0])
    if not math.isfinite(half):
        is_constant = float(np.ptp(values)) <= _RELATIVE_ZERO * float(np.abs(values).max(initial=0.0))
        return Estimate(
            value=value, over="cases", reason=no_spread(n, "cases") if is_constant else TOO_FEW_CASES
        )
    # Few resamples have no small quantiles, so the tail is that of Student's t, on the scale of the 95 % quantile.
    p = t_two_sided(abs(value) / half * t_quantile(1.0 - ALPHA / 2.0, n - 1), n - 1)
    return Estimate(value=value, low=value - half, high=value + half, method="bootstrap-t", over="cases", p=p)


def bootstrap_t(columns: Floats, *, resamples: int = RESAMPLES, seed: int = 0) -> Floats:
    """Half widths of symmetric studentised bootstrap intervals of each column's mean, all resampled with the
    same draws; infinite if too few values differ. `columns` is (cases, m)."""
    n = len(columns)
    centre, spread = columns.mean(axis=0), columns.std(axis=0, ddof=1)
    varies = spread > _RELATIVE_ZERO * np.maximum(1e-300, np.abs(columns).max(axis=0))
    scaled = np.where(varies, (columns - centre) / np.where(varies, spread, 1.0), 0.0)
    drawn = weights(n, n, resamples, seed) / n
    means = drawn @ scaled
    variances = np.maximum(0.0, drawn @ scaled**2 - means**2) / (n - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.abs(means) / np.sqrt(variances)
    t = np.where(variances > _RELATIVE_ZERO**2, t, np.inf)
    quantile = np.quantile(t, CONFIDENCE, axis=0, method="inverted_cdf")
    half: Floats = np.where(varies, np.where(varies, quantile, 0.0) * spread / math.sqrt(n), np.inf)
    return half


def score_interval(values: Floats, step: float) -> Estimate:
    """Mean of paired differences −`step`, 0 or `step` of two-valued returns: Tango's (1998) score interval. Its p value
    is McNemar's. All differences 0 have no spread."""
    n = len(values)
    up, down = int((values > 0.5 * step).sum()), int((values < -0.5 * step).sum())
    if up + down == 0:
        return Estimate(value=0.0, over="cases", reason=no_spread(n, "cases"))
    z = normal_quantile(1.0 - ALPHA / 2.0)
    value = (up - down) / n

    def beyond(delta: float) -> bool:
        """Whether the data are further than z from a true difference of `delta`."""
        b = -up - down + (2 * n - up + down) * delta
        c = -down * delta * (1.0 - delta)
        q = (math.sqrt(max(0.0, b * b - 8.0 * n * c)) - b) / (4.0 * n)
        variance = n * (2.0 * q + delta * (1.0 - delta))
        return (up - down - n * delta) ** 2 > z * z * variance

    low, high = (_edge(value, end, beyond) for end in (-1.0, 1.0))
    p = normal_two_sided(abs(up - down) / math.sqrt(up + down))
    return Estimate(value=step * value, low=step * low, high=step * high, method="score", over="cases", p=p)


def _edge(inside: float, outside: float, beyond: Callable[[float], bool]) -> float:
    """The point between both where `beyond` becomes true; `outside` if it never does."""
    if not beyond(outside):
        return outside
    for _ in range(60):
        middle = 0.5 * (inside + outside)
        inside, outside = (inside, middle) if beyond(middle) else (middle, outside)
    return inside


def _crossed(value: float, parts: Sequence[Components], by_case: Floats) -> Estimate:
    """t interval from the runs' variance, which contains the residual, plus the rest of the cases' variance."""
    n_cases = len(by_case)
    if n_cases < 2:
        return Estimate(value=value, over="runs and cases", reason=TOO_FEW_CASES)
    total, df = _variance(parts, components(by_case[None, :]).cases, n_cases)
    if total <= (_RELATIVE_ZERO * abs(value)) ** 2:
        reason = no_spread(min(part.n_runs for part in parts))
        return Estimate(value=value, over="runs and cases", reason=reason)
    return _t_interval(value, total, df, "crossed t", "runs and cases")


def _variance(parts: Sequence[Components], shared: float, n_cases: int) -> tuple[float, float]:
    """Variance of a mean over runs and crossed cases, and its degrees of freedom, at least 1.

    The cases' part is a difference of mean squares, so its own are those of all of them.
    """
    beyond = max(0.0, shared - sum(part.residual for part in parts))
    runs = sum(part.runs for part in parts)
    total = runs + beyond
    if total <= 0.0:
        return 0.0, 1.0
    below = 0.0
    if runs > 0.0:
        df = _runs_df([part.runs for part in parts], [part.n_runs for part in parts])
        below += (runs / total) ** 2 / df
    if beyond > 0.0:
        below += (shared / total) ** 2 / (n_cases - 1)
        below += sum((part.residual / total) ** 2 / ((part.n_runs - 1) * (n_cases - 1)) for part in parts)
    return total, max(1.0, 1.0 / below)


def _runs_df(variances: Sequence[float], n_runs: Sequence[int]) -> float:
    """Degrees of freedom (Welch, Satterthwaite) of a sum of variances, bounded by the fewest runs."""
    total = sum(variances)
    welch = 1.0 / sum((v / total) ** 2 / (n - 1) for v, n in zip(variances, n_runs, strict=True))
    return min(welch, len(n_runs) * (min(n_runs) - 1.0))


def _t_interval(value: float, variance: float, df: float, method: Method, over: Over) -> Estimate:
    df, error = round(df, 6), math.sqrt(variance)
    half = t_quantile(1.0 - ALPHA / 2.0, df) * error
    p = t_two_sided(abs(value) / error, df)
    return Estimate(value=value, low=value - half, high=value + half, method=method, over=over, p=p)
