"""Aggregates against rliable (Agarwal et al. 2021) on generated scores, where it is installed."""

from __future__ import annotations

import numpy as np
import pytest

from evopolicy_results.scoring.normalised import Scale
from evopolicy_results.statistics.aggregates import TAUS, aggregates, iqm, probability_of_improvement, profile
from evopolicy_results.statistics.samples import RunReturns, Sample

library = pytest.importorskip("rliable.library", reason="needs rliable, which is opt-in: pip install rliable")
metrics = pytest.importorskip("rliable.metrics", reason="needs rliable, which is opt-in: pip install rliable")


@pytest.mark.parametrize(("n_runs", "n_envs"), [(5, 3), (8, 16), (10, 1)])
def test_aggregates_of_generated_scores_are_those_of_rliable(n_runs: int, n_envs: int) -> None:
    generator = np.random.default_rng(n_runs)
    first = generator.normal(0.6, 0.3, (n_runs, n_envs))
    second = generator.normal(0.5, 0.3, (n_runs, n_envs)).round(1)
    assert iqm(first.ravel()) == pytest.approx(metrics.aggregate_iqm(first))
    ours = np.mean([probability_of_improvement(first[:, e], second[:, e]) for e in range(n_envs)])
    assert ours == pytest.approx(metrics.probability_of_improvement(first, second))
    shares = [library.run_score_deviation(first, tau) for tau in TAUS]
    assert profile(first.ravel()) == pytest.approx(shares)


def test_intervals_of_generated_scores_are_those_of_rliable() -> None:
    generator = np.random.default_rng(0)
    n_runs, n_envs = 10, 8
    scores = {name: generator.normal(mean, 0.3, (n_runs, n_envs)) for name, mean in (("A", 0.6), ("B", 0.5))}
    samples = {
        (name, f"e{e}"): Sample(
            entry=name, env=f"e{e}", runs=tuple(RunReturns(score=float(x)) for x in matrix[:, e])
        )
        for name, matrix in scores.items()
        for e in range(n_envs)
    }
    scales = {f"e{e}": Scale(random=0.0, best=1.0) for e in range(n_envs)}
    found, (improvement,) = aggregates(samples, ["A", "B"], scales, resamples=20_000)
    _, theirs = library.get_interval_estimates(
        scores, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=5000
    )
    for one in found:
        assert one.iqm.low is not None
        # Ours are wider by the root of n/(n - 1).
        low, high = (
            one.iqm.value + np.sqrt(10 / 9) * (bound - one.iqm.value) for bound in theirs[one.entry].ravel()
        )
        assert (one.iqm.low, one.iqm.high) == pytest.approx((low, high), abs=0.02)
    pair = {"A,B": (scores["A"], scores["B"])}
    _, theirs = library.get_interval_estimates(pair, metrics.probability_of_improvement, reps=5000)
    assert (improvement.probability.low, improvement.probability.high) == pytest.approx(
        theirs["A,B"].ravel(), abs=0.02
    )
