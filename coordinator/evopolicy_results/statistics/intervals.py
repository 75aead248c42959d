"""95 % intervals of means and of paired differences over runs, and the p values of the same distributions: a p value is
at most 0.05 exactly if its interval excludes 0. `docs/explanation/statistics.md` has the measured coverage of each
method.

The method depends on the data, as chosen by measured coverage:

- One run: over cases (`evopolicy_common.statistics.intervals`).
- Several runs: over runs and cases, which are crossed, as every run plays the same cases. A t interval whose variance
  is that of runs plus the part of the cases' variance that runs share, which contains agent × case (random-effects
  analysis of variance). Degrees of freedom are Satterthwaite's, and those of unequal numbers of runs at most twice the
  smaller number's: otherwise a small variance of few runs counts as known.
- Several runs without common cases: Welch's t interval over run means.
- A mean over environments: a t interval from the sum of their variances, with Satterthwaite's degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from scipy.special import stdtr, stdtrit

from evopolicy_common.statistics.intervals import (
    ALPHA,
    RELATIVE_ZERO,
    RESAMPLES,
    TOO_FEW_CASES,
    Estimate,
    Floats,
    Method,
    Over,
    no_spread,
    over_cases,
)
from evopolicy_common.terminal import number

TOO_FEW_RUNS = "too few runs"
TOO_FEW_UNITS = "too few worlds or runs"


def t_quantile(p: float, df: float) -> float:
    """Quantile of Student's t for `df` > 0, perhaps infinite."""
    return float(stdtrit(df, p))


def t_two_sided(t: float, df: float) -> float:
    """P(|T| ≥ t) of Student's t, for t ≥ 0 and `df` > 0, perhaps infinite."""
    return 2.0 * float(stdtr(df, -t))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's step-down correction: adjusted p values in the given order; None stays None."""
    known = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for place, (p, i) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - place) * p))
        adjusted[i] = largest
    return adjusted


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


def difference(first: Floats, second: Floats, *, resamples: int = RESAMPLES) -> Estimate:
    """Estimates `first − second` from matrices runs × the same cases: over runs and cases if both have two or more
    runs, otherwise over cases alone."""
    by_case = first.mean(axis=0) - second.mean(axis=0)
    if len(first) < 2 or len(second) < 2:
        returns = (first, second) if len(first) == len(second) == 1 else ()
        # Few resamples have no small quantiles, so the tail of the p value is that of Student's t, on the scale of the
        # 95 % quantile.
        estimate, n = over_cases(by_case, returns, resamples=resamples), len(by_case)
        if estimate.low is None or estimate.method != "bootstrap-t":
            return estimate
        t = abs(estimate.value) / (estimate.value - estimate.low) * t_quantile(1.0 - ALPHA / 2.0, n - 1)
        return replace(estimate, p=t_two_sided(t, n - 1))
    return _crossed(float(first.mean() - second.mean()), [components(first), components(second)], by_case)


def mean(returns: Floats, *, resamples: int = RESAMPLES) -> Estimate:
    """The mean of a matrix runs × cases: over runs and cases, or over the cases of a single run."""
    if len(returns) == 1:
        return over_cases(returns[0], (returns,), resamples=resamples)
    return _crossed(float(returns.mean()), [components(returns)], returns.mean(axis=0))


def of_runs(first: Sequence[float] | Floats, second: Sequence[float] | Floats = ()) -> Estimate:
    """Mean of `first`, or `first − second`, from run scores alone: Welch's t interval over runs."""
    groups = [np.asarray(one, dtype=np.float64) for one in (first, second) if len(one)]
    value = float(groups[0].mean() - (groups[1].mean() if len(groups) > 1 else 0.0))
    if any(len(group) < 2 for group in groups):
        return Estimate(value=value, reason=TOO_FEW_RUNS)
    variances = [float(group.var(ddof=1)) / len(group) for group in groups]
    total = sum(variances)
    scale = max(float(np.abs(group).max()) for group in groups)
    if total <= (RELATIVE_ZERO * scale) ** 2:
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


def stratum_of(values: Sequence[float] | Floats) -> Stratum:
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
    if total <= (RELATIVE_ZERO * max(1e-300, *(abs(each.value) for each in strata))) ** 2:
        return Estimate(value=value, over=over, reason="no spread")
    shares = [(v / total) ** 2 / each.df for v, each in zip(variances, strata, strict=True) if v > 0.0]
    return _t_interval(value, total, 1.0 / sum(shares), "stratified t", over)


def _crossed(value: float, parts: Sequence[Components], by_case: Floats) -> Estimate:
    """t interval from the runs' variance, which contains the residual, plus the rest of the cases' variance."""
    n_cases = len(by_case)
    if n_cases < 2:
        return Estimate(value=value, over="runs and cases", reason=TOO_FEW_CASES)
    total, df = _variance(parts, components(by_case[None, :]).cases, n_cases)
    if total <= (RELATIVE_ZERO * abs(value)) ** 2:
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


_MAX_DECIMALS = 6
_NOTHING = 1e-9
"""Half width, as a share of the ends, up to which an interval is a rounding error."""
_SYMMETRIC = 0.1
"""Difference of an interval's two sides, as a share of its half width, up to which it is written with `±`."""


def decimals(low: float | None, high: float | None) -> int | None:
    """Decimals that leave two significant digits of the half width; None without bounds, or without a width."""
    if low is None or high is None:
        return None
    half = (high - low) / 2.0
    if not _NOTHING * max(abs(low), abs(high)) < half < math.inf:
        return None
    return min(_MAX_DECIMALS, max(0, 1 - math.floor(math.log10(half))))


def rounded(value: float, digits: int) -> str:
    """Without a minus before a 0; an ASCII minus else, so that numbers can be copied."""
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def bounds_text(value: float, low: float | None, high: float | None) -> str | None:
    """`± 40` for a symmetric interval, else `-144 to -52`; None without bounds."""
    if low is None or high is None:
        return None
    digits = decimals(low, high)
    if digits is None:
        return f"{number(low)} to {number(high)}"
    half = (high - low) / 2.0
    if abs((high - value) - (value - low)) <= _SYMMETRIC * half:
        return f"± {half:.{digits}f}"
    return f"{rounded(low, digits)} to {rounded(high, digits)}"


def valued(estimate: Estimate) -> str:
    """The value with its interval, such as `-104 ± 40`, or `0.92 (0.80 to 1.00)`."""
    digits, interval = (
        decimals(estimate.low, estimate.high),
        bounds_text(estimate.value, estimate.low, estimate.high),
    )
    text = number(estimate.value) if digits is None else rounded(estimate.value, digits)
    if interval is None or digits is None:
        return text
    return f"{text} {interval}" if interval.startswith("±") else f"{text} ({interval})"
