"""Entries whose true gaps are known, and how often the statistics of a report are right about them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_coordinator.analysis.scoring.normalised import Scale
from evopolicy_coordinator.analysis.statistics.aggregates import aggregates
from evopolicy_coordinator.analysis.statistics.intervals import difference
from evopolicy_coordinator.analysis.statistics.pairs import pairs
from evopolicy_coordinator.analysis.statistics.resampling import RESAMPLES
from evopolicy_coordinator.analysis.statistics.samples import RunReturns, Sample
from evopolicy_coordinator.analysis.statistics.standings import standings

Floats = NDArray[np.float64]
Generator = np.random.Generator


class Rate(msgspec.Struct, frozen=True, kw_only=True):
    """How often something held."""

    held: int
    given: int
    """Trials in which there was an interval or a verdict."""
    trials: int
    methods: tuple[str, ...] = ()

    @property
    def share(self) -> float:
        return self.held / self.given if self.given else math.nan


def _normal(g: Generator, n: int) -> tuple[Floats, Floats, float]:
    case = g.normal(0, 2, n)
    return case + g.normal(0.3, 1, n), case + g.normal(0, 1, n), 0.3


def _heavy(g: Generator, n: int) -> tuple[Floats, Floats, float]:
    case = g.normal(0, 2, n)
    return case + 0.3 + g.standard_t(3, n), case, 0.3


def _skewed(g: Generator, n: int) -> tuple[Floats, Floats, float]:
    case = g.gamma(2, 1, n)
    return case + g.exponential(1, n), case + 0.5, 0.5


def _scaled(g: Generator, n: int) -> tuple[Floats, Floats, float]:
    case = g.gamma(2, 1, n)
    return case * g.gamma(2, 0.5, n), case * g.gamma(2, 0.4, n), 0.4


def _very_skewed(g: Generator, n: int) -> tuple[Floats, Floats, float]:
    return np.exp(g.normal(0, 1, n)), np.ones(n), math.exp(0.5) - 1.0


def _goal(g: Generator, n: int) -> tuple[Floats, Floats, float]:
    """As MiniGrid pays: nothing, or 0.7 to 1 at the goal."""
    case = g.random(n)

    def played(p: float) -> Floats:
        reached = np.where(g.random(n) < 0.5, case, g.random(n)) < p
        return np.where(reached, g.uniform(0.7, 1.0, n), 0.0)

    return played(0.8), played(0.5), 0.3 * 0.85


def _binary(p: float, q: float) -> Callable[[Generator, int], tuple[Floats, Floats, float]]:
    def drawn(g: Generator, n: int) -> tuple[Floats, Floats, float]:
        case = g.random(n)
        one = np.where(g.random(n) < 0.5, case, g.random(n)) < p
        other = np.where(g.random(n) < 0.5, case, g.random(n)) < q
        return one.astype(float), other.astype(float), p - q

    return drawn


CASE_SHAPES: Mapping[str, Callable[[Generator, int], tuple[Floats, Floats, float]]] = {
    "normal": _normal,
    "heavy tails (t, 3 df)": _heavy,
    "skewed (exponential)": _skewed,
    "skewed, by case (gamma)": _scaled,
    "very skewed (log-normal)": _very_skewed,
    "0 or 0.7–1": _goal,
    "0/1: 0.7 and 0.5": _binary(0.7, 0.5),
    "0/1: 0.9 and 0.8": _binary(0.9, 0.8),
    "0/1: equal 0.5": _binary(0.5, 0.5),
}
"""Returns of two checkpoints on the same cases, and the true gap."""


def _run_effects(kind: str, g: Generator, n: int) -> Floats:
    if kind == "skewed":
        return g.exponential(0.5, n) - 0.5
    if kind == "found or not":
        return 0.5 * np.where(g.random(n) < 0.3, -1.5275, 0.6547)
    return g.normal(0, 0.5, n)


_LOGIT_GAP = 0.185083  # E 1/(1 + exp(−1 − z)) − E 1/(1 + exp(−z)), z normal of variance 1.49, by quadrature


def _by_logit(g: Generator, n_runs: int, n_cases: int, case: Floats, shift: float) -> Floats:
    chance = 1.0 / (1.0 + np.exp(-(shift + g.normal(0, 0.7, (n_runs, 1)) + case)))
    return (g.random((n_runs, n_cases)) < chance).astype(float)


def runs_of(
    kind: str, g: Generator, n_runs: int, n_cases: int, gap: float = 0.5
) -> tuple[Floats, Floats, float]:
    """Matrices runs × cases of two agents; agents differ by case, and runs of an agent differ."""
    case = g.normal(0, 1, n_cases)
    if kind == "0/1":
        one, other = (_by_logit(g, n_runs, n_cases, case, shift) for shift in (1.0, 0.0))
        return one, other, _LOGIT_GAP

    def agent(mean: float) -> Floats:
        by_case = case + g.normal(0, 0.5, n_cases)
        return mean + _run_effects(kind, g, n_runs)[:, None] + by_case + g.normal(0, 1, (n_runs, n_cases))

    return agent(gap), agent(0.0), gap


RUN_SHAPES = ("normal", "skewed", "found or not", "0/1")


def coverage(
    draw: Callable[[Generator], tuple[Floats, Floats, float]],
    trials: int,
    *,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Rate:
    """How often the interval of a difference holds the true gap."""
    generator = np.random.default_rng(seed)
    held = given = 0
    methods: dict[str, int] = {}
    for _ in range(trials):
        one, other, gap = draw(generator)
        found = difference(np.atleast_2d(one), np.atleast_2d(other), resamples=resamples)
        if found.low is None or found.high is None:
            continue
        methods[found.method] = methods.get(found.method, 0) + 1
        given += 1
        held += found.low - 1e-9 <= gap <= found.high + 1e-9
    return Rate(
        held=held, given=given, trials=trials, methods=tuple(sorted(methods, key=lambda m: -methods[m]))
    )


def case_coverage(shape: str, n_cases: int, trials: int, *, seed: int = 0) -> Rate:
    return coverage(lambda g: CASE_SHAPES[shape](g, n_cases), trials, seed=seed)


def run_coverage(
    kind: str, n_runs: int, trials: int, *, n_cases: int = 32, seed: int = 0, resamples: int = RESAMPLES
) -> Rate:
    return coverage(lambda g: runs_of(kind, g, n_runs, n_cases), trials, seed=seed, resamples=resamples)


def suite_samples(g: Generator, means: Floats, n_runs: int, n_cases: int) -> dict[tuple[str, str], Sample]:
    """Samples of a suite; `means` is environments × entries, noise by case has variance 1, by run 0.04."""
    found: dict[tuple[str, str], Sample] = {}
    for place, row in enumerate(means):
        env, case = f"env-{place:02d}", g.normal(0, 1, n_cases)
        for number, mean in enumerate(row):
            spread = 0.2 * g.normal(size=(n_runs, 1)) if n_runs > 1 else 0.0
            returns = mean + case + spread + g.normal(size=(n_runs, n_cases))
            runs = tuple(
                RunReturns(score=float(one.mean()), returns=tuple(one.tolist()), case_set=env)
                for one in returns
            )
            found[f"entry-{number}", env] = Sample(entry=f"entry-{number}", env=env, runs=runs)
    return found


def rank_scores(means: Floats) -> Floats:
    """(…, environments, entries) means to (…, entries) rank scores."""
    above = (means[..., None, :] > means[..., :, None]).sum(axis=-1)
    found: Floats = (1.0 - above / (means.shape[-1] - 1)).mean(axis=-2)
    return found


class RankRates(msgspec.Struct, frozen=True, kw_only=True):
    """Of simulated suites."""

    score: Rate
    """Intervals of rank scores that hold the score which a repetition gives on average."""
    rank: Rate
    """Suites in which every entry's rank interval holds its rank by that average score."""
    false_gap: Rate
    """Suites in which some pair is told apart the wrong way round, or although its average scores are equal."""
    pairs_apart: float
    """Share of the pairs with unequal average scores that are told apart."""


def rank_rates(
    spread: float,
    trials: int,
    *,
    n_runs: int = 1,
    n_entries: int = 5,
    n_environments: int = 16,
    n_cases: int = 32,
    seed: int = 0,
) -> RankRates:
    """`spread`: standard deviation of the entries' true means, in standard deviations of a return; 0: all are equal."""
    g = np.random.default_rng(seed)
    names = [f"entry-{i}" for i in range(n_entries)]
    held = ranks_held = false_gaps = apart = unequal = 0
    for _ in range(trials):
        level = g.normal(0, spread, n_entries)
        means = level + g.normal(0, 0.5 * spread, (n_environments, n_entries))
        noise = math.sqrt(1.0 / (n_runs * n_cases) + (0.04 / n_runs if n_runs > 1 else 0.0))
        average = np.full(n_entries, 0.5)
        if spread:
            average = rank_scores(means + g.normal(0, noise, (2000, n_environments, n_entries))).mean(axis=0)
        samples = suite_samples(g, means, n_runs, n_cases)
        observed = rank_scores(
            np.array(
                [
                    [np.mean(samples[name, f"env-{e:02d}"].scores) for name in names]
                    for e in range(n_environments)
                ]
            )
        )
        environments = [f"env-{e:02d}" for e in range(n_environments)]
        found = standings(
            samples, dict(zip(names, observed.tolist(), strict=True)), environments, resamples=800
        )
        all_ranks = True
        for name, true in zip(names, average, strict=True):
            row = found.of(name)
            assert row is not None
            held += row.score_low - 1e-9 <= true <= row.score_high + 1e-9
            rank = 1 + int((average > true + 1e-12).sum())
            worst = n_entries - int((average < true - 1e-12).sum())
            all_ranks = all_ranks and row.rank_low <= worst and rank <= row.rank_high
        ranks_held += all_ranks
        wrong = False
        for i in range(n_entries):
            for j in range(n_entries):
                one, other = found.of(names[i]), found.of(names[j])
                assert one is not None
                assert other is not None
                distinguished = not set(one.ties) & set(other.ties) and observed[i] > observed[j]
                unequal += average[i] > average[j]
                apart += distinguished and average[i] > average[j]
                wrong = wrong or (distinguished and average[i] <= average[j])
        false_gaps += wrong
    return RankRates(
        score=Rate(held=held, given=trials * n_entries, trials=trials * n_entries),
        rank=Rate(held=ranks_held, given=trials, trials=trials),
        false_gap=Rate(held=false_gaps, given=trials, trials=trials),
        pairs_apart=apart / unequal if unequal else math.nan,
    )


def false_gaps_by_holm(
    n_runs: int, trials: int, *, n_entries: int = 4, n_environments: int = 8, seed: int = 0
) -> Rate:
    """How often suites of equal entries have any pair that the corrected tests tell apart."""
    g = np.random.default_rng(seed)
    names, environments = (
        [f"entry-{i}" for i in range(n_entries)],
        [f"env-{e:02d}" for e in range(n_environments)],
    )
    wrong = 0
    for _ in range(trials):
        samples = suite_samples(g, np.zeros((n_environments, n_entries)), n_runs, 32)
        wrong += any(
            pair.verdict in ("first", "second") for pair in pairs(samples, names, environments, resamples=50)
        )
    return Rate(held=wrong, given=trials, trials=trials)


def iqm_coverage(n_runs: int, trials: int, *, n_environments: int = 16, seed: int = 0) -> Rate:
    """How often the interval of an IQM holds the IQM of infinitely many runs."""
    g = np.random.default_rng(seed)
    levels = np.linspace(0.0, 1.0, n_environments)
    many = np.sort((levels + 0.2 * np.random.default_rng(99).normal(size=(200_000, n_environments))).ravel())
    true = float(many[len(many) // 4 : -(len(many) // 4)].mean())
    held = 0
    for _ in range(trials):
        samples = {
            ("A", f"env-{e:02d}"): Sample(
                entry="A", env=f"env-{e:02d}",
                runs=tuple(RunReturns(score=float(level + 0.2 * g.normal())) for _ in range(n_runs)),
            )
            for e, level in enumerate(levels)
        }  # fmt: skip
        scales = {env: Scale(random=0.0, best=1.0) for _, env in samples}
        (found,), _ = aggregates(samples, ["A"], scales, resamples=1000)
        assert found.iqm is not None
        assert found.iqm.low is not None
        assert found.iqm.high is not None
        held += found.iqm.low <= true <= found.iqm.high
    return Rate(held=held, given=trials, trials=trials)
