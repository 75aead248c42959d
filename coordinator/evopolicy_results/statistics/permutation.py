"""Permutation test about *these cases*: whether runs of two agents could have been exchanged.

It takes the cases as given. Agents that differ by case therefore differ here even if they are equal on average over all
cases, and more so with more runs: no verdict of a report rests on it. The statistic is Welch's t, so that entries of
equal mean and unequal spread are not reported as different when there are many runs (Janssen 1997). All patterns are
tried if they are few, otherwise a random sample plus the observed pattern.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evopolicy_common.statistics.resampling import Floats, label_patterns

N_RANDOM = 1999
_CHUNK = 20_000
_CLOSE = 1e-9
"""Relative tolerance: statistics that differ only by rounding count as equal."""


def label_test(first: Sequence[float], second: Sequence[float], n_random: int = N_RANDOM) -> float:
    """p value of two groups of run scores, of two or more runs each, coming from one distribution."""
    n_first, n_second = len(first), len(second)
    pooled = np.array([*first, *second])
    pooled = pooled - pooled.mean()
    patterns, exact = label_patterns(n_first, n_second, n_random)
    own = np.repeat([[1.0, 0.0]], [n_first, n_second], axis=1)
    observed = float(_welch(own, pooled, n_first, n_second)[0])
    reached = 0
    for start in range(0, len(patterns), _CHUNK):
        found = _welch(patterns[start : start + _CHUNK], pooled, n_first, n_second)
        reached += int((found >= observed * (1.0 - _CLOSE)).sum())
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
