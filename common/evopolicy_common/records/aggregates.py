"""Mean and standard deviation of returns, as the coordinator, `summary.json` and `run.json` have them: whoever checks them needs
the same bits.

Returns beyond `bounds.LARGEST`, which earlier versions stored, have finite results too, although their sums are not finite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

_SCALE = 520
"""Exponent by which such returns are divided, so that their squares are finite."""


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean, correctly rounded, so independent of the order; NaN without values, NaN or infinite if a value is."""
    try:
        return math.fsum(values) / len(values) if values else math.nan
    except (ValueError, OverflowError):
        if not all(map(math.isfinite, values)):
            return float(sum(values))
        from fractions import Fraction

        return float(sum(map(Fraction, values)) / len(values))


def std(values: Sequence[float]) -> float:
    """Population standard deviation (divides by n); NaN without values, or if a value is not finite."""
    centre = mean(values)
    square = mean([(value - centre) * (value - centre) for value in values])
    if math.isinf(square) and math.isfinite(centre):
        return math.ldexp(std([math.ldexp(value, -_SCALE) for value in values]), _SCALE)
    return math.sqrt(square)
