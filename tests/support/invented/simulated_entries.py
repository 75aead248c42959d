"""Entries whose true gaps are known, and how often the statistics of a report are right about them."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from statistics import NormalDist
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_common.statistics.intervals import RESAMPLES, Estimate
from evopolicy_results.scoring.scores import Cell, RunReturns, Scale
from evopolicy_results.statistics.aggregates import Bounded, aggregates
from evopolicy_results.statistics.intervals import difference, mean, of_runs, t_quantile
from evopolicy_results.statistics.pairs import Spread, exchange_test, pairs, repeats_needed, standard_error
from evopolicy_results.statistics.standings import standings

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


def rated(outcomes: Iterable[bool | None]) -> Rate:
    """None: no interval or verdict."""
    listed = list(outcomes)
    given = [one for one in listed if one is not None]
    return Rate(held=sum(given), given=len(given), trials=len(listed))


def holds(estimate: Estimate | Bounded, true: float) -> bool | None:
    if estimate.low is None or estimate.high is None:
        return None
    return estimate.low - 1e-9 <= true <= estimate.high + 1e-9


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


SOLVED: Mapping[str, tuple[float, float]] = {
    f"solved in {share:g} of runs, effect {effect:g}": (share, effect)
    for share in (0.3, 0.5, 0.7)
    for effect in (1.0, 3.0)
}
"""Agents that solve a task in a share of their runs, which are then better by an effect, in standard deviations of an
episode."""


def _run_effects(kind: str, g: Generator, n: int) -> Floats:
    if kind in SOLVED:
        share, effect = SOLVED[kind]
        return effect * ((g.random(n) < share) - share)
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
    """Matrices runs × cases of two agents; runs of an agent differ, and agents differ by case unless they are of
    `SOLVED`."""
    case = g.normal(0, 1, n_cases)
    if kind == "0/1":
        one, other = (_by_logit(g, n_runs, n_cases, case, shift) for shift in (1.0, 0.0))
        return one, other, _LOGIT_GAP

    def agent(mean: float) -> Floats:
        by_case = case + g.normal(0, 0.5 * (kind not in SOLVED), n_cases)
        return mean + _run_effects(kind, g, n_runs)[:, None] + by_case + g.normal(0, 1, (n_runs, n_cases))

    return agent(gap), agent(0.0), gap


RUN_SHAPES = ("normal", "skewed", "found or not", "0/1")


def coverage(
    draw: Callable[[Generator], tuple[Floats, Floats, float]], trials: int, *, resamples: int = RESAMPLES
) -> Rate:
    """How often the interval of a difference holds the true gap."""
    generator = np.random.default_rng(0)
    outcomes: list[bool | None] = []
    methods: Counter[str] = Counter()
    for _ in range(trials):
        one, other, gap = draw(generator)
        found = difference(np.atleast_2d(one), np.atleast_2d(other), resamples=resamples)
        outcomes.append(holds(found, gap))
        methods[found.method] += found.low is not None
    used = tuple(method for method, n in methods.most_common() if n)
    return msgspec.structs.replace(rated(outcomes), methods=used)


def case_coverage(shape: str, n_cases: int, trials: int) -> Rate:
    return coverage(lambda g: CASE_SHAPES[shape](g, n_cases), trials)


def run_coverage(kind: str, n_runs: int, trials: int, *, resamples: int = RESAMPLES) -> Rate:
    return coverage(lambda g: runs_of(kind, g, n_runs, 32), trials, resamples=resamples)


class World(msgspec.Struct, frozen=True, kw_only=True):
    """Suites of entries whose means are equal unless `spread` is above 0. Noise by case has variance 1."""

    n_runs: tuple[int, ...] = (4,)
    """Of each entry; repeated."""
    interaction: float = 0.0
    """Standard deviation of agent × case: a deviation of one agent on one case, common to its runs."""
    run: float = 0.2
    """Standard deviation between runs of an agent; 0 for entries of one run, whose checkpoints are compared."""
    noise: tuple[float, ...] = (1.0,)
    """Factor of an entry's deviations by run and episode; repeated."""
    spread: float = 0.0
    """Standard deviation of the entries' true means; half of it varies by environment."""
    n_entries: int = 4
    n_environments: int = 8
    n_cases: int = 32
    shape: str = "normal"
    """`normal`, `skewed` (exponential), or `0/1` (thresholds at the normal values)."""
    solved: tuple[float, ...] = (1.0,)
    """Share of an entry's runs that solve the task; repeated. All entries have the same mean."""
    effect: float = 0.0
    """By how much a run that solves the task is better than one that does not."""

    @property
    def names(self) -> list[str]:
        return [f"entry-{i:02d}" for i in range(self.n_entries)]

    @property
    def environments(self) -> list[str]:
        return [f"env-{i:02d}" for i in range(self.n_environments)]

    def means(self, g: Generator) -> Floats:
        """Environments × entries."""
        size = (self.n_environments, self.n_entries)
        return g.normal(0, self.spread, self.n_entries) + g.normal(0, 0.5 * self.spread, size)

    def returns(self, g: Generator, means: Floats) -> dict[tuple[str, str], Floats]:
        """Matrices runs × cases by (entry, env)."""

        def drawn(*size: int) -> Floats:
            found: Floats = g.exponential(1, size) - 1.0 if self.shape == "skewed" else g.normal(size=size)
            return found

        found = {}
        for env, row in zip(self.environments, means, strict=True):
            case = g.normal(0, 1, self.n_cases)
            for number, (name, level) in enumerate(zip(self.names, row, strict=True)):
                n = self.n_runs[number % len(self.n_runs)]
                noise = self.noise[number % len(self.noise)]
                own = noise * (self.run * drawn(n, 1) * (n > 1) + drawn(n, self.n_cases))
                found[name, env] = level + case + self.interaction * drawn(self.n_cases) + own
                if self.effect:
                    share = self.solved[number % len(self.solved)]
                    found[name, env] += self.effect * ((g.random((n, 1)) < share) - share)
                if self.shape == "0/1":
                    found[name, env] = (found[name, env] > 0.0).astype(np.float64)
        return found


def suite_samples(returns: Mapping[tuple[str, str], Floats]) -> dict[tuple[str, str], Cell]:
    """Samples of matrices runs × cases; runs of an environment share its cases."""
    return {
        (entry, env): Cell(
            entry=entry,
            env=env,
            runs=tuple(
                RunReturns(score=float(one.mean()), returns=tuple(one.tolist()), case_set=env)
                for one in matrix
            ),
        )
        for (entry, env), matrix in returns.items()
    }


def rank_scores(means: Floats) -> Floats:
    """(…, environments, entries) means to (…, entries) rank scores."""
    above = (means[..., None, :] > means[..., :, None]).sum(axis=-1)
    found: Floats = (1.0 - above / (means.shape[-1] - 1)).mean(axis=-2)
    return found


class FalseGaps(NamedTuple):
    """Of simulated suites of equal entries."""

    raw: Rate
    """Pairs with an uncorrected p of at most 5 %."""
    holm: Rate
    """Suites in which the corrected p of some pair tells it apart."""
    ties: Rate
    """Suites in which tie groups tell some pair apart."""


def false_gaps(world: World, trials: int) -> FalseGaps:
    g = np.random.default_rng(0)
    raw: list[bool] = []
    wrong: list[bool] = []
    split: list[bool] = []
    for _ in range(trials):
        samples = suite_samples(world.returns(g, world.means(g)))
        found = pairs(samples, world.names, world.environments, resamples=1000)
        raw += [pair.p <= 0.05 for pair in found if pair.p is not None]
        wrong.append(any(pair.verdict in ("first", "second") for pair in found))
        rows = standings(samples, observed_scores(world, samples), world.environments, resamples=800).rows
        split.append(any(not set(one.ties) & set(other.ties) for one in rows for other in rows))
    return FalseGaps(rated(raw), rated(wrong), rated(split))


def observed_scores(world: World, samples: Mapping[tuple[str, str], Cell]) -> dict[str, float]:
    """Rank scores by entry."""
    means = [[np.mean(samples[name, env].scores or ()) for name in world.names] for env in world.environments]
    return dict(zip(world.names, rank_scores(np.array(means)).tolist(), strict=True))


class RankRates(NamedTuple):
    """Of simulated suites."""

    score: Rate
    """Intervals of rank scores that hold the score which a repetition gives on average."""
    rank: Rate
    """Suites in which every entry's rank interval holds its rank by that average score."""
    false_gap: Rate
    """Suites in which some pair is told apart the wrong way round, or although its average scores are equal."""
    pairs_apart: Rate
    """Pairs with unequal average scores that are told apart."""


def rank_rates(world: World, trials: int) -> RankRates:
    g = np.random.default_rng(0)
    n_runs, n_cases = world.n_runs[0], world.n_cases
    noise = (1.0 / n_runs + world.interaction**2) / n_cases + world.run**2 / n_runs * (n_runs > 1)
    outcomes: tuple[list[bool], ...] = ([], [], [], [])
    held, ranks_held, wrong, apart = outcomes
    for _ in range(trials):
        means = world.means(g)
        average = np.full(world.n_entries, 0.5)
        if world.spread:
            drawn = means + g.normal(0, math.sqrt(noise), (2000, *means.shape))
            average = rank_scores(drawn).mean(axis=0)
        samples = suite_samples(world.returns(g, means))
        scores = observed_scores(world, samples)
        found = standings(samples, scores, world.environments, resamples=800)
        true = dict(zip(world.names, average.tolist(), strict=True))
        rows = {row.entry: row for row in found.rows}
        assert set(rows) == set(true)
        ranks = []
        for name, row in rows.items():
            held.append(row.score_low - 1e-9 <= true[name] <= row.score_high + 1e-9)
            rank = 1 + sum(other > true[name] + 1e-12 for other in true.values())
            worst = len(true) - sum(other < true[name] - 1e-12 for other in true.values())
            ranks.append(row.rank_low <= worst and rank <= row.rank_high)
        ranks_held.append(all(ranks))
        told = {
            (one, other): not set(rows[one].ties) & set(rows[other].ties) and scores[one] > scores[other]
            for one, other in itertools.permutations(world.names, 2)
        }
        apart += [is_told for (one, other), is_told in told.items() if true[one] > true[other]]
        wrong.append(any(is_told and true[one] <= true[other] for (one, other), is_told in told.items()))
    return RankRates(*map(rated, outcomes))


def mean_coverage(n_runs: int, shape: str, trials: int) -> Rate:
    """How often the interval of one entry's mean on 32 cases holds the true mean."""
    g = np.random.default_rng(0)
    world = World(n_runs=(n_runs,), interaction=0.5, n_entries=1, n_environments=1, shape=shape)
    if shape in SOLVED:
        share, effect = SOLVED[shape]
        world = World(
            n_runs=(n_runs,), run=0.0, n_entries=1, n_environments=1, solved=(share,), effect=effect
        )
    true = 0.5 if shape == "0/1" else 0.0

    def trial() -> bool | None:
        (returns,) = world.returns(g, np.zeros((1, 1))).values()
        return holds(mean(returns), true)

    return rated(trial() for _ in range(trials))


def welch_coverage(kind: str, n_runs: int, trials: int) -> Rate:
    """How often the interval over runs with cases of their own holds the true gap of 0.5."""
    g = np.random.default_rng(0)
    return rated(
        holds(of_runs(_run_effects(kind, g, n_runs) + 0.5, 2.0 * _run_effects(kind, g, n_runs)), 0.5)
        for _ in range(trials)
    )


class AggregateRates(NamedTuple):
    """Coverage of the true values with infinitely many runs and cases, on the true scale."""

    iqm: Rate
    """Of the agents below the best."""
    profile: Rate
    """Share of the lowest agent's runs above 0.5."""
    improvement: Rate
    """Of the lowest agent over the second."""


def aggregate_rates(
    n_runs: int, levels: tuple[float, ...], trials: int, *, n_environments: int = 16
) -> AggregateRates:
    """`levels`: true means of agents on each environment, the best last, in standard deviations of a return; random has
    0. Runs vary with a standard deviation of 0.5."""
    g, best, run = np.random.default_rng(0), max(levels), 0.5
    world = World(
        n_runs=(n_runs,), interaction=0.3, run=run, n_entries=len(levels), n_environments=n_environments
    )
    held: dict[str, list[bool | None]] = {name: [] for name in AggregateRates._fields}
    phi = NormalDist().cdf
    above = phi((levels[0] - 0.5 * best) / run)
    better = phi((levels[0] - levels[1]) / (run * math.sqrt(2.0)))
    for _ in range(trials):
        returns = world.returns(g, np.tile(levels, (n_environments, 1)))
        samples = suite_samples(returns)
        scales = {}
        for env in world.environments:
            reference = g.normal(0, 0.5, (1, world.n_cases))
            (fixed,) = suite_samples({("R", env): reference}).values()
            samples["R", env] = msgspec.structs.replace(fixed, fixed=fixed.mean)
            scales[env] = Scale(
                random=float(np.mean(fixed.scores or ())),
                best=max(float(np.mean(samples[name, env].scores or ())) for name in world.names),
            )
        found, against = aggregates(samples, world.names, scales, resamples=600)
        held["iqm"] += [
            holds(one.iqm, level / best)
            for level, one in zip(levels[:-1], found, strict=False)
            if one.iqm is not None
        ]
        held["profile"].append(holds(found[0].profile[10], above))
        held["improvement"].append(holds(against[0].probability, better))
    return AggregateRates(**{name: rated(outcomes) for name, outcomes in held.items()})


def half_width(spread: Spread, n: int) -> float:
    """Half width of the 95 % interval of a difference between two agents of n ≥ 2 runs each."""
    error, df = standard_error(spread, n)
    return t_quantile(0.975, df) * error if error > 0.0 else 0.0


def resolved(n_runs: int, trials: int, *, level: float = 0.05) -> Rate:
    """How often the interval of a true gap as large as the smallest difference of `n_runs` runs excludes 0; for 0 runs,
    how often both tests resolve a gap of 1 at `level`, with the runs that it needs."""
    g, is_planned = np.random.default_rng(0), n_runs == 0
    spread = Spread(run=0.5**2 + 1.0 / 32, case=2 * 0.5**2 / 32, n_cases=32)
    if n_runs:
        gap = half_width(spread, n_runs)
    else:
        gap, needed = 1.0, repeats_needed(spread, 1.0, level=level)
        assert needed is not None
        n_runs = needed

    def trial() -> bool:
        one, other, _ = runs_of("normal", g, n_runs, 32, gap)
        found = difference(one, other)
        exchange = exchange_test(one.mean(axis=1), other.mean(axis=1)) if is_planned else 0.0
        return found.p is not None and max(found.p, exchange) <= level and found.value > 0.0

    return rated(trial() for _ in range(trials))


def optimism_rates(trials: int, *, n_submits: int = 10) -> tuple[Rate, Rate]:
    """Of agents whose submits are all equally good: how often the mean optimism over 16 environments is above 0, and
    how often its interval holds the true one."""
    g = np.random.default_rng(0)
    true = float(np.random.default_rng(1).normal(0, 1, (200_000, n_submits)).max(axis=1).mean())
    found = [
        of_runs((g.normal(0, 1, (16, n_submits)).max(axis=1) - g.normal(0, 1, 16)).tolist())
        for _ in range(trials)
    ]
    return rated(one.value > 0.0 for one in found), rated(holds(one, true) for one in found)
