"""The number of runs that a given gap between two agents would need."""

from __future__ import annotations

import bisect
import math

import msgspec

from evopolicy_common.statistics.distributions import ALPHA, t_two_sided
from evopolicy_common.statistics.intervals import components
from evopolicy_common.statistics.resampling import Floats

MAX_REPEATS = 1000


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Variances of a difference between two agents on one environment, mean over both, or over all pairs."""

    run: float
    """Variance between runs of one agent, of their held-out means."""
    case: float
    """Variance of the difference that more runs do not reduce: agents differ by case, and these cases are a sample.
    An estimate, which may be below 0."""
    n_cases: int


def spread_of(*returns: Floats) -> Spread:
    """Variances of two agents, from matrices runs × the same cases. A matrix of one row is one fixed policy."""
    parts = [components(matrix) for matrix in returns]
    gaps = components((returns[0].mean(axis=0) - returns[1].mean(axis=0))[None, :])
    return Spread(
        run=sum(part.runs * part.n_runs for part in parts) / 2.0,
        case=gaps.cases - sum(part.residual for part in parts),
        n_cases=gaps.n_cases,
    )


def repeats_needed(spread: Spread, gap: float, *, level: float = ALPHA) -> int | None:
    """The fewest runs per agent, from 2, whose interval of a difference, at 1 − `level`, is no wider than ± `gap`. A
    true gap of that size is then distinguished from 0 in half of all experiments. None if no number up to
    `MAX_REPEATS` does: the gap needs more cases. Raises ValueError for a gap that is not above 0."""
    if not gap > 0.0:
        raise ValueError(f"a gap of {gap} cannot be resolved; give one above 0")

    def resolves(n: int) -> bool:
        error, df = standard_error(spread, n)
        return error <= 0.0 or t_two_sided(gap / error, df) <= level

    n = 2 + bisect.bisect_left(range(2, MAX_REPEATS + 1), True, key=resolves)
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
