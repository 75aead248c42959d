"""Means and deviations of returns: correctly rounded, and finite wherever the true value is."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.records.aggregates import mean, std

returns = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=8)


@given(returns)
def test_a_mean_of_finite_returns_is_finite_and_exact(values: list[float]) -> None:
    exact = sum(map(Fraction, values)) / len(values)
    assert mean(values) == pytest.approx(float(exact), rel=1e-15, abs=1e-320)
    assert mean(values) == mean(values[::-1])


@given(returns)
def test_a_deviation_of_finite_returns_is_finite(values: list[float]) -> None:
    found = std(values)
    assert 0.0 <= found <= max(abs(value) for value in values) * (1 + 1e-12)


def test_returns_near_the_largest_float_have_a_mean_and_a_deviation() -> None:
    assert mean([1.7e308, 1.7e308, -1.7e308]) == pytest.approx(1.7e308 / 3)
    assert std([1.7e308, -1.7e308]) == 1.7e308
    assert std([1.7e308] * 9 + [-1.7e308]) == pytest.approx(0.6 * 1.7e308)


def test_what_is_not_finite_stays_so() -> None:
    assert math.isnan(mean([]))
    assert math.isnan(std([]))
    assert mean([math.inf, 1.0]) == math.inf
    assert math.isnan(mean([math.inf, -math.inf]))
    assert math.isnan(std([math.inf, 1.0]))
