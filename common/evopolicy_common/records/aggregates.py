"""Mean and standard deviation of returns, and the selection by them, as the coordinator, `summary.json` and `run.json`
have them: whoever checks them needs the same bits.

Returns beyond `bounds.LARGEST`, which other programs' files may have, have finite results too, although their sums are
not finite.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from evopolicy_common.messages.gateway import Profile

_SCALE = 520
"""Exponent by which such returns are divided, so that their squares are finite."""


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean, correctly rounded, in any order; NaN without values, NaN or infinite if a value is."""
    try:
        return math.fsum(values) / len(values) if values else math.nan
    except (ValueError, OverflowError):
        if not all(map(math.isfinite, values)):
            return float(sum(values))
        from fractions import Fraction

        return float(sum(map(Fraction, values)) / len(values))


def best_validated(means: Mapping[int, float], profile: Profile) -> int | None:
    """Index of the submit with the highest validation mean, the later one on a tie; None without a submit.

    `means`: submit index to mean. In the published profiles a mean counts with 1e-12 times its index added, as in the
    published software v0.1.0, so that a later submit also wins against a mean that is higher by less than this.
    """
    step = 0.0 if profile == "own" else 1e-12
    return max(means, key=lambda index: (means[index] + step * index, index), default=None)


def std(values: Sequence[float]) -> float:
    """Population standard deviation (divides by n); NaN without values, or if a value is not finite."""
    centre = mean(values)
    square = mean([(value - centre) * (value - centre) for value in values])
    if math.isinf(square) and math.isfinite(centre):
        return math.ldexp(std([math.ldexp(value, -_SCALE) for value in values]), _SCALE)
    return math.sqrt(square)
