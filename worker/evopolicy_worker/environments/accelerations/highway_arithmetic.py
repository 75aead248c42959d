"""Scalar arithmetic with the results of the numpy calls that highway-env makes for single numbers, bit for bit.

Sums, products, quotients, square roots, remainders and comparisons of doubles are the same in Python as in numpy, being
exactly defined. Not so trigonometric functions and powers, for which numpy has its own, and dot products, for which
its BLAS may use fused multiply-adds: those stay numpy's, everywhere in these accelerations.
"""

from __future__ import annotations

import math

PI = math.pi
TWO_PI = 2 * math.pi


def clip(value: float, low: float, high: float) -> float:
    """`np.clip` of one number: NaN stays, and so does a zero at a limit of zero, with its sign."""
    if value < low:
        return low
    return high if value > high else value


def wrap(angle: float) -> float:
    """`highway_env.utils.wrap_to_pi`."""
    return ((angle + PI) % TWO_PI) - PI


def not_zero(value: float) -> float:
    """`highway_env.utils.not_zero`."""
    if abs(value) > 1e-2:
        return value
    return 1e-2 if value >= 0 else -1e-2
