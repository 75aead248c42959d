"""Mean and standard deviation of returns, as `summary.json` and `run.json` have them: whoever checks them needs the same bits."""

from __future__ import annotations

import math
from collections.abc import Sequence


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean, correctly rounded; NaN without values, NaN or infinite if a value is."""
    return _exact_sum(values) / len(values) if values else math.nan


def std(values: Sequence[float]) -> float:
    """Population standard deviation (divides by n); NaN without values."""
    centre = mean(values)
    return math.sqrt(mean([(value - centre) * (value - centre) for value in values]))


def _exact_sum(values: Sequence[float]) -> float:
    try:
        return math.fsum(values)
    except (ValueError, OverflowError):  # infinities of both signs, or a sum beyond the range of floats
        return float(sum(values))
