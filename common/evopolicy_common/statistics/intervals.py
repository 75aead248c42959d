"""Intervals over cases: of a mean, or of differences between two checkpoints that played the same cases. Reports use
them, and so do the ends of `run` and `local`, which need no scipy (`evopolicy_results.statistics.intervals` has those
over runs). `docs/explanation/statistics.md` has the measured coverage of each method.

Differences of returns with two values (such as 0 and 1) get Tango's (1998) score interval, all others the symmetric
studentised bootstrap (Hall 1988). Fewer than `LEAST_CASES` cases get no interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from statistics import NormalDist
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
ALPHA = 1.0 - CONFIDENCE
RESAMPLES = 2000
LEAST_CASES = 5
"""With fewer cases no method reaches its coverage."""
RELATIVE_ZERO = 1e-9
"""Relative bound: a smaller spread is rounding error."""
_CANCELLED = 1e-13
"""A smaller variance of values with variance 1, as a difference of squares, is rounding error."""

Method = Literal["bootstrap-t", "adjusted Wald", "score", "crossed t", "Welch t", "stratified t", "none"]
Over = Literal["cases", "runs and cases", "runs", "worlds, runs, and cases", "nothing"]

TOO_FEW_CASES = "too few cases"


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
    """Two-sided p value of the true value 0, from the interval's own distribution; None without an interval, and of a
    single bootstrap outside reports."""
    reason: str = ""


def normal_quantile(p: float) -> float:
    """Quantile of the standard normal distribution, 0 < p < 1."""
    return NormalDist().inv_cdf(p)


def normal_two_sided(z: float) -> float:
    """P(|Z| ≥ z) of a standard normal Z, for z ≥ 0."""
    return math.erfc(z / math.sqrt(2.0))


@lru_cache(maxsize=8)
def weights(n: int, resamples: int, seed: int = 0) -> Floats:
    """(resamples, n): how often each resample draws each of n units, with replacement; read-only."""
    drawn = np.random.default_rng([seed, n, n]).multinomial(n, np.full(n, 1.0 / n), resamples)
    counts: Floats = drawn.astype(np.float64)
    counts.setflags(write=False)
    return counts


def no_spread(n: int, unit: str = "repeats") -> str:
    """Why there is no interval where all of `n` units are equal: their variance cannot be estimated."""
    return f"no spread: {n} identical {unit}"


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
    half = _bootstrap_t(values, resamples)
    if not math.isfinite(half):
        is_constant = float(np.ptp(values)) <= RELATIVE_ZERO * float(np.abs(values).max(initial=0.0))
        return Estimate(
            value=value, over="cases", reason=no_spread(n, "cases") if is_constant else TOO_FEW_CASES
        )
    return Estimate(value=value, low=value - half, high=value + half, method="bootstrap-t", over="cases")


def _bootstrap_t(values: Floats, resamples: int) -> float:
    """Half width of the symmetric studentised bootstrap interval of a mean; infinite if too few values differ."""
    n, spread = len(values), float(values.std(ddof=1))
    if spread <= RELATIVE_ZERO * float(np.abs(values).max()):
        return math.inf
    scaled = (values - values.mean()) / spread
    drawn = weights(n, resamples) / n
    means = drawn @ scaled
    variances = np.maximum(0.0, drawn @ scaled**2 - means**2) / (n - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(variances > _CANCELLED, np.abs(means) / np.sqrt(variances), np.inf)
    return float(np.quantile(t, CONFIDENCE, method="inverted_cdf")) * spread / math.sqrt(n)


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
