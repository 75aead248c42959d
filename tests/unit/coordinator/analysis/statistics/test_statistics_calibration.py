"""Intervals and verdicts are right as often as they say: small seeded versions of tests/bench/coverage.py."""

from __future__ import annotations

import numpy as np
import pytest
from invented.simulated_entries import (
    CASE_SHAPES,
    RUN_SHAPES,
    Rate,
    case_coverage,
    coverage,
    false_gaps_by_holm,
    iqm_coverage,
    rank_rates,
    run_coverage,
    runs_of,
)

from evopolicy_coordinator.analysis.statistics.intervals import components, difference
from evopolicy_coordinator.analysis.statistics.resolution import Spread, half_width

TRIALS = 300
# Four standard errors of a share of 0.95 in 300 trials are 5 %.
SLACK = 0.05


def assert_covers(rate: Rate, low: float = 0.93, high: float = 0.97) -> None:
    assert rate.given == rate.trials
    assert low - SLACK <= rate.share <= high + SLACK


@pytest.mark.parametrize("shape", [name for name in CASE_SHAPES if not name.startswith("very")])
def test_interval_of_one_run_covers_from_32_cases(shape: str) -> None:
    assert_covers(case_coverage(shape, 32, TRIALS))


@pytest.mark.parametrize("kind", RUN_SHAPES)
@pytest.mark.parametrize("n_runs", [2, 5, 10])
def test_interval_over_runs_covers(kind: str, n_runs: int) -> None:
    found = run_coverage(kind, n_runs, TRIALS, resamples=800)
    assert found.given >= 0.97 * found.trials  # two runs of 0/1 returns may have equal means
    assert 0.92 - SLACK <= found.share <= 0.98


def test_an_interval_that_forgot_the_runs_would_not_cover() -> None:
    """The check can fail: cases alone miss the gap between agents whose runs vary."""

    def one_run_each(g: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
        return runs_of("normal", g, 1, 32)

    assert coverage(one_run_each, TRIALS).share < 0.75


def test_equal_entries_are_told_apart_as_rarely_as_stated() -> None:
    equal = rank_rates(0.0, 60)
    assert equal.false_gap.share <= 0.15
    assert equal.score.share >= 0.9
    assert false_gaps_by_holm(1, 60).share <= 0.15
    assert false_gaps_by_holm(10, 20, n_environments=3).share <= 0.25


def test_unequal_entries_are_told_apart_and_ranks_hold() -> None:
    unequal = rank_rates(1.0, 20)
    assert unequal.pairs_apart > 0.6
    assert unequal.rank.share >= 0.85
    assert unequal.false_gap.share <= 0.15
    assert unequal.score.share >= 0.85


def test_interval_of_an_iqm_covers() -> None:
    assert_covers(iqm_coverage(5, TRIALS), low=0.9, high=0.98)


def test_a_gap_of_the_stated_size_is_resolved_every_second_time() -> None:
    generator = np.random.default_rng(3)
    spread = Spread(run=0.5**2 + 1.0 / 32, case=2 * 0.5**2 / 32, n_cases=32)
    gap = half_width(spread, 5)
    resolved = 0
    for _ in range(TRIALS):
        one, other, _ = runs_of("normal", generator, 5, 32, gap)
        found = difference(one, other)
        assert found.low is not None
        resolved += found.low > 0.0
    assert 0.4 <= resolved / TRIALS <= 0.6


def test_components_find_the_variances_that_made_the_returns() -> None:
    generator = np.random.default_rng(4)
    found = [
        components(
            generator.normal(0, 0.5, (8, 1)) + generator.normal(0, 2, 16) + generator.normal(0, 1, (8, 16))
        )
        for _ in range(400)
    ]
    assert np.mean([one.runs for one in found]) == pytest.approx((0.25 + 1 / 16) / 8, rel=0.1)
    assert np.mean([one.cases for one in found]) == pytest.approx((4 + 1 / 8) / 16, rel=0.1)
    assert np.mean([one.residual for one in found]) == pytest.approx(1 / (8 * 16), rel=0.1)
