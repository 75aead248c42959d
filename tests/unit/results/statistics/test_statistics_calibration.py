"""Intervals and verdicts are right as often as they say: small seeded versions of tests/bench/coverage.py."""

from __future__ import annotations

import numpy as np
import pytest
from invented.simulated_entries import (
    CASE_SHAPES,
    RUN_SHAPES,
    Rate,
    World,
    aggregate_rates,
    case_coverage,
    coverage,
    false_gaps,
    rank_rates,
    resolved,
    run_coverage,
    runs_of,
)

from evopolicy_results.statistics.intervals import components

TRIALS = 300
# Four standard errors of a share of 0.95 in 300 trials are 5 %.
SLACK = 0.05
FEW = 4
"""Environments of a suite: of 24 uncorrected comparisons of equal entries, one is significant in 71 % of suites."""


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
    # Two runs have few degrees of freedom; Satterthwaite's are then too few rather than too many.
    assert 0.92 - SLACK <= found.share <= (1.0 if n_runs == 2 else 0.98)


def test_an_interval_that_forgot_the_runs_would_not_cover() -> None:
    """The check can fail: cases alone miss the gap between agents whose runs vary."""

    def one_run_each(g: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
        return runs_of("normal", g, 1, 32)

    assert coverage(one_run_each, TRIALS).share < 0.75


@pytest.mark.parametrize("n_runs", [pytest.param((4,), marks=pytest.mark.system), (10,), (2, 10, 3, 5)])
@pytest.mark.parametrize("interaction", [0.5, pytest.param(1.0, marks=pytest.mark.system)])
def test_agents_that_differ_by_case_are_told_apart_as_rarely_as_stated(
    n_runs: tuple[int, ...], interaction: float
) -> None:
    found = false_gaps(World(n_runs=n_runs, interaction=interaction, n_environments=FEW), 40)
    # Four standard errors of the stated 5 % in 40 suites are 14 %.
    assert found.holm.share <= 0.19
    assert found.ties.share <= 0.19
    assert found.raw.share <= 0.07


@pytest.mark.parametrize("effect", [3.0, pytest.param(1.0, marks=pytest.mark.system)])
@pytest.mark.parametrize("n_runs", [2, 3, pytest.param(4, marks=pytest.mark.system), 7])
def test_agents_that_solve_a_task_sometimes_are_rarely_told_apart(n_runs: int, effect: float) -> None:
    """A few runs that agree by chance leave no variance between runs."""
    found = false_gaps(World(n_runs=(n_runs,), run=0.0, solved=(0.5,), effect=effect, n_environments=FEW), 40)
    assert found.holm.share <= 0.19
    assert found.ties.share <= 0.19


def test_four_runs_in_a_single_comparison_are_rarely_told_apart() -> None:
    """Four runs of two agents on one environment reach the level, and must not exceed it."""
    world = World(n_runs=(4,), run=0.0, solved=(0.5,), effect=3.0, n_entries=2, n_environments=1)
    assert false_gaps(world, TRIALS).holm.share <= 0.05 + SLACK


@pytest.mark.parametrize("shape", ["normal", "0/1"])
def test_equal_checkpoints_are_told_apart_as_rarely_as_stated(shape: str) -> None:
    found = false_gaps(World(n_runs=(1,), shape=shape, n_environments=FEW), 60)
    assert found.holm.share <= 0.05 + 0.12
    assert found.raw.share <= 0.07


def test_equal_entries_keep_their_rank_scores() -> None:
    equal = rank_rates(World(n_runs=(1,), n_entries=5, n_environments=16), 60)
    assert equal.false_gap.share <= 0.15
    assert equal.score.share >= 0.9


def test_unequal_entries_are_told_apart_and_ranks_hold() -> None:
    unequal = rank_rates(World(n_runs=(1,), n_entries=5, n_environments=16, spread=1.0), 20)
    assert unequal.pairs_apart.share > 0.6
    assert unequal.rank.share >= 0.85
    assert unequal.false_gap.share <= 0.15
    assert unequal.score.share >= 0.85


def test_intervals_of_aggregates_cover_on_a_scale_of_the_same_runs() -> None:
    found = aggregate_rates(5, (1.0, 2.0, 3.0, 4.0), 60, n_environments=8)
    for rate in found:
        assert rate.share >= 0.85


def test_a_gap_of_the_stated_size_is_resolved_every_second_time() -> None:
    assert 0.4 <= resolved(5, TRIALS).share <= 0.6
    assert 0.4 <= resolved(0, TRIALS, level=0.001).share <= 0.75


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
