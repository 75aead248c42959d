"""Quantiles of the normal and Student's t distribution, and Holm's correction, without scipy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from statistics import NormalDist

CONFIDENCE = 0.95
ALPHA = 1.0 - CONFIDENCE


def normal_quantile(p: float) -> float:
    """Quantile of the standard normal distribution, 0 < p < 1."""
    return NormalDist().inv_cdf(p)


def normal_two_sided(z: float) -> float:
    """P(|Z| ≥ z) of a standard normal Z, for z ≥ 0."""
    return math.erfc(z / math.sqrt(2.0))


def t_two_sided(t: float, df: float) -> float:
    """P(|T| ≥ t) of Student's t, for t ≥ 0 and any `df` > 0."""
    return normal_two_sided(t) if math.isinf(df) else 2.0 * _t_upper(t, df)


@lru_cache(maxsize=65536)
def t_quantile(p: float, df: float) -> float:
    """Quantile of Student's t for 0.5 ≤ p < 1 and `df` > 0, perhaps infinite, to about 1e-10. Raises
    ValueError."""
    if not 0.5 <= p < 1.0 or not df > 0.0:
        raise ValueError(
            f"t quantile of p = {p} with {df} degrees of freedom; p is in [0.5, 1) and df above 0"
        )
    if math.isinf(df):
        return normal_quantile(p)
    # Newton's method from below: the tail is convex, so it never steps past the quantile.
    log_scale = math.lgamma(0.5 * (df + 1.0)) - math.lgamma(0.5 * df) - 0.5 * math.log(df * math.pi)
    t = normal_quantile(p)
    for _ in range(200):
        density = math.exp(log_scale - 0.5 * (df + 1.0) * math.log1p(t * t / df))
        step = (_t_upper(t, df) - (1.0 - p)) / density
        t += step
        if abs(step) <= 1e-13 * t:
            break
    return t


def _t_upper(t: float, df: float) -> float:
    """P(T > t) for t ≥ 0: half the regularised incomplete beta function at df/(df + t²)."""
    return 0.5 * _incomplete_beta(0.5 * df, 0.5, df / (df + t * t))


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """Regularised incomplete beta function: Abramowitz and Stegun's fraction 26.5.8 with Lentz's method."""
    if x <= 0.0 or x >= 1.0:
        return 0.0 if x <= 0.0 else 1.0
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _incomplete_beta(b, a, 1.0 - x)
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    c, d = 1.0, 1.0 / _away_from_0(1.0 - (a + b) * x / (a + 1.0))
    value = d
    for m in range(1, 500):
        for numerator in (
            m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0)),
        ):
            d = 1.0 / _away_from_0(1.0 + numerator * d)
            c = _away_from_0(1.0 + numerator / c)
            value *= d * c
        if abs(d * c - 1.0) < 1e-15:
            break
    return math.exp(log_front) * value / a


def _away_from_0(value: float) -> float:
    return value if abs(value) > 1e-300 else 1e-300


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's step-down correction: adjusted p values in the given order; None stays None."""
    known = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for place, (p, i) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - place) * p))
        adjusted[i] = largest
    return adjusted
