"""Numbers with as many digits as their interval supports."""

from __future__ import annotations

import math

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_common.terminal import number

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
