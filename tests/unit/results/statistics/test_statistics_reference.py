"""Statistics against values computed once with rliable 1.2 (Agarwal et al. 2021) and scipy 1.17, and against small
cases by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from invented.simulated_entries import half_width
from scipy.stats import permutation_test

from evopolicy_common.statistics.intervals import over_cases
from evopolicy_results.scoring.scores import Cell, RunReturns, Scale
from evopolicy_results.statistics import pairs
from evopolicy_results.statistics.aggregates import TAUS, aggregates, iqm, probability_of_improvement, profile
from evopolicy_results.statistics.intervals import difference, holm, of_runs, t_quantile
from evopolicy_results.statistics.pairs import Spread, exchange_test, least_runs, repeats_needed

A = np.array([[0.1, 0.9, 0.35], [0.2, 0.7, 0.5], [0.15, 1.1, 0.45], [0.05, 0.8, 0.65], [0.3, 0.95, 0.2]])
B = np.array([[0.12, 0.6, 0.55], [0.25, 0.65, 0.5], [0.1, 0.75, 0.7], [0.2, 0.85, 0.4]])
"""Normalised scores, runs × environments."""


def sample(entry: str, env: str, scores: np.ndarray) -> Cell:
    return Cell(entry=entry, env=env, runs=tuple(RunReturns(score=float(score)) for score in scores))


def test_iqm_profile_and_improvement_are_those_of_rliable() -> None:
    assert iqm(A.ravel()) == pytest.approx(0.46111111111111114)
    assert iqm(B.ravel()) == pytest.approx(0.4916666666666667)
    assert profile(A.ravel(), (0.1, 0.25, 0.5, 0.75, 0.9)) == pytest.approx(
        [0.86666667, 0.66666667, 0.4, 0.26666667, 0.13333333]
    )
    by_env = [probability_of_improvement(A[:, e], B[:, e]) for e in range(3)]
    assert np.mean(by_env) == pytest.approx(0.525)


def test_stratified_bootstrap_intervals_are_those_of_rliable() -> None:
    envs = ("x", "y", "z")
    samples = {
        (entry, env): sample(entry, env, scores[:, e])
        for entry, scores in (("A", A), ("B", B))
        for e, env in enumerate(envs)
    }
    scales = {env: Scale(random=0.0, best=1.0) for env in envs}
    (a, b), (improvement,) = aggregates(samples, ["A", "B"], scales, resamples=20_000)
    assert a.iqm is not None
    assert b.iqm is not None
    # rliable: 0.38333 to 0.54444 and 0.43333 to 0.56667; ours are wider by √(n/(n − 1)), n = 5 and 4 runs.
    for found, n, low, high in ((a.iqm, 5, 0.38333, 0.54444), (b.iqm, 4, 0.43333, 0.56667)):
        stretch = math.sqrt(n / (n - 1))
        expected = [found.value + stretch * (bound - found.value) for bound in (low, high)]
        assert (found.low, found.high) == pytest.approx(expected, abs=0.012)
    assert improvement.probability.value == pytest.approx(0.525)
    # Four runs are too few for a probability's interval. With a fifth rliable gives 0.36 to 0.72.
    assert improvement.probability.low is None
    samples |= {("B", env): sample("B", env, np.append(B[:, e], B[0, e])) for e, env in enumerate(envs)}
    (_, b), (improvement,) = aggregates(samples, ["A", "B"], scales, resamples=20_000)
    assert (improvement.probability.low, improvement.probability.high) == pytest.approx(
        (0.36, 0.72), abs=0.01
    )
    half = a.profile[TAUS.index(0.5)]
    assert (half.low, half.high) == pytest.approx((0.33333, 0.53333), abs=0.001)
    assert (a.n_runs, a.n_environments, a.over) == (15, 3, "runs")


def _mean_gap(first: np.ndarray, second: np.ndarray, axis: int) -> np.ndarray:
    return np.abs(first.mean(axis=axis) - second.mean(axis=axis))


@pytest.mark.parametrize(("n_first", "n_second"), [(2, 2), (2, 7), (3, 4), (6, 6)])
def test_the_exchange_of_runs_is_the_exact_permutation_test_of_scipy(n_first: int, n_second: int) -> None:
    generator = np.random.default_rng(n_first)
    for values in (generator.normal(size=9 + 3), generator.integers(0, 2, 12).astype(float), np.ones(12)):
        first, second = values[:n_first], values[n_first : n_first + n_second]
        expected = permutation_test((first, second), _mean_gap, n_resamples=10_000, alternative="greater")
        assert exchange_test(first, second) == pytest.approx(expected.pvalue)


def test_many_runs_are_exchanged_by_the_normal_approximation(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(0).normal(size=40) + np.repeat([1.0, 0.0], 20)
    exact = exchange_test(values[:20], values[20:])
    assert 0.001 < exact < 0.2
    monkeypatch.setattr(pairs, "MAX_EXCHANGED", 39)
    assert exchange_test(values[:20], values[20:]) == pytest.approx(exact, rel=0.3)
    assert exchange_test(np.ones(30), np.ones(30)) == 1.0


def test_welch_interval_of_run_scores_is_that_of_scipy() -> None:
    found = of_runs([1.0, 2.0, 3.0, 7.0], [2.0, 6.0, 8.0, 9.0])
    assert (found.low, found.high) == pytest.approx((-8.001337394427164, 2.001337394427165))


def test_holm_is_as_computed_by_hand() -> None:
    assert holm([0.01, 0.04, None, 0.03, 0.005]) == pytest.approx([0.03, 0.06, None, 0.06, 0.02])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_score_interval_is_that_of_tango_and_its_p_mcnemars() -> None:
    values = np.array([1.0] * 12 + [-1.0] * 2 + [0.0] * 36)
    found = over_cases(values, ((values > 0).astype(float)[None], (values < 0).astype(float)[None]))
    assert found.p == pytest.approx(math.erfc(10 / math.sqrt(14) / math.sqrt(2)))
    assert found.method == "score"
    # At a bound the score statistic, its variance from the restricted maximum likelihood, is the normal quantile.
    for bound in (found.low, found.high):
        assert bound is not None
        a, b, c = 100, -14 + (100 - 10) * bound, -2 * bound * (1 - bound)
        q = (math.sqrt(b * b - 4 * a * c) - b) / (2 * a)
        z = (10 - 50 * bound) / math.sqrt(50 * (2 * q + bound * (1 - bound)))
        assert abs(z) == pytest.approx(1.959963984540054)


def test_crossed_interval_is_the_analysis_of_variance_by_hand() -> None:
    first, second = np.array([[1.0, 3.0], [2.0, 6.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    # Run means 2, 4 and 0.5, 0.5; residuals ±0.5 each: variances of means 1 and 0, residual 0.25 and 0.25.
    # Case differences 1 and 4: variance 4.5/2, of which 0.5 is residual.
    found = difference(first, second)
    total, below = 1.0 + 1.75, 1.0 + 2.25**2 + 0.25**2 + 0.25**2
    half = t_quantile(0.975, round(max(1.0, total**2 / below), 6)) * math.sqrt(total)
    assert (found.value, found.method, found.over) == (2.5, "crossed t", "runs and cases")
    assert (found.low, found.high) == pytest.approx((2.5 - half, 2.5 + half))


def test_repeats_are_the_fewest_whose_interval_is_narrow_enough() -> None:
    spread = Spread(run=1.0, case=0.01, n_cases=32)
    for gap in (0.25, 0.5, 1.0):
        n = repeats_needed(spread, gap)
        assert half_width(spread, n) <= gap < half_width(spread, n - 1)
    assert repeats_needed(spread, 0.19) is None  # the cases alone leave ±0.2
    # No exchange of three runs each is as rare as 5 %.
    assert repeats_needed(Spread(run=0.0, case=0.0, n_cases=32), 0.1) == least_runs(0.05) == 4
    assert [least_runs(level) for level in (0.34, 0.1, 0.05 / 48, 0.05 / 160)] == [2, 3, 7, 8]
    with pytest.raises(ValueError, match="above 0"):
        repeats_needed(spread, 0.0)
