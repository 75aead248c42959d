"""Interquartile mean, performance profiles and probability of improvement over normalised scores (Agarwal et al.
2021).

The scores of single runs are normalised to the random-to-best scale of their environment, not clipped. A run without
an ok submit counts as below every number. Intervals are percentiles of a stratified bootstrap that resamples runs
within each environment. If an entry has one run per cell, its cases are resampled instead, which gives the spread of
these checkpoints' scores. Resamples of few runs vary too little, by the factor (n − 1)/n. For the IQM they are
therefore stretched about their mean; profiles and probabilities have no interval if a cell has two or more runs but
fewer than `LEAST_RUNS`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from evopolicy_coordinator.analysis.scoring.normalised import Scale
from evopolicy_coordinator.analysis.statistics.distributions import ALPHA
from evopolicy_coordinator.analysis.statistics.resampling import RESAMPLES, weights
from evopolicy_coordinator.analysis.statistics.samples import Floats, Sample, matched

LEAST_RUNS = 5

TAUS = tuple(round(0.05 * i, 2) for i in range(21))
"""Normalised scores at which a profile is evaluated."""


class Bounded(msgspec.Struct, frozen=True, kw_only=True):
    """A number and its 95 % interval; no bounds if a cell shows no spread, or a bound is not finite."""

    value: float
    low: float | None = None
    high: float | None = None


class Aggregate(msgspec.Struct, frozen=True, kw_only=True):
    """One entry over the environments that have a scale."""

    entry: str
    iqm: Bounded | None
    """Mean of the middle half of all its runs' normalised scores; None if that half has a run without an ok submit."""
    profile: tuple[Bounded, ...]
    """Share of its runs with a normalised score above each of `TAUS`."""
    n_runs: int
    n_environments: int
    over: str
    """Resampled units: `runs`, `cases` if every cell has one run, or `nothing`."""


class Improvement(msgspec.Struct, frozen=True, kw_only=True):
    """Probability that a run of the first entry beats one of the second; mean over the environments that both have
    played."""

    first: str
    second: str
    probability: Bounded
    n_environments: int


def iqm(scores: Floats) -> Floats:
    """Interquartile mean along the last axis: without the lowest and highest ⌊n/4⌋ of n values."""
    n = scores.shape[-1]
    cut = n // 4
    middle = np.sort(scores, axis=-1)[..., cut : n - cut]
    found: Floats = np.asarray(middle.mean(axis=-1), dtype=np.float64)
    return found


def profile(scores: Floats, taus: Sequence[float] = TAUS) -> Floats:
    """Share of `scores` (last axis) above each of `taus`, which become the last axis."""
    return np.stack([(scores > tau).mean(axis=-1) for tau in taus], axis=-1)


def probability_of_improvement(first: Floats, second: Floats) -> Floats:
    """P(X > Y) + P(X = Y)/2 for scores of runs along the last axes: Mann and Whitney's U over the number of pairs."""
    above = (first[..., :, None] > second[..., None, :]).mean(axis=(-2, -1))
    equal = (first[..., :, None] == second[..., None, :]).mean(axis=(-2, -1))
    found: Floats = above + 0.5 * equal
    return found


class _Cell(msgspec.Struct, frozen=True, kw_only=True):
    scores: Floats
    drawn: Floats | None
    """(resamples, runs); None if nothing can be resampled."""
    n_runs: int

    @property
    def stretched(self) -> Floats | None:
        """`drawn`, stretched to the variance of that many runs."""
        if self.drawn is None or self.n_runs < 2 or not np.isfinite(self.scores).all():
            return self.drawn
        middle = self.scores.mean()
        wider: Floats = middle + np.sqrt(self.n_runs / (self.n_runs - 1)) * (self.drawn - middle)
        return wider

    @property
    def counted(self) -> Floats | None:
        """`drawn`, unless it is drawn from too few runs."""
        return None if 1 < self.n_runs < LEAST_RUNS else self.drawn


def aggregates(
    samples: Mapping[tuple[str, str], Sample],
    agents: Sequence[str],
    scales: Mapping[str, Scale],
    *,
    resamples: int = RESAMPLES,
) -> tuple[list[Aggregate], list[Improvement]]:
    """Aggregates of all agents, and improvements of each pair; environments without a scale are left out."""
    cells = {
        (agent, env): _cell(sample, scale, (place, number), resamples)
        for place, (env, scale) in enumerate(scales.items())
        for number, agent in enumerate(agents)
        if (sample := samples.get((agent, env))) is not None
    }
    by_entry = {
        agent: {env: cells[agent, env] for env in scales if (agent, env) in cells} for agent in agents
    }
    found = [_aggregate(agent, list(own.values())) for agent, own in by_entry.items() if own]
    against = [
        _improvement(one, other, [(by_entry[one][env], by_entry[other][env]) for env in common])
        for one, other in itertools.combinations(agents, 2)
        if (common := [env for env in by_entry[one] if env in by_entry[other]])
    ]
    return found, against


def _cell(sample: Sample, scale: Scale, seed: tuple[int, int], resamples: int) -> _Cell:
    width = scale.best - scale.random
    known = [-np.inf if run.score is None else (run.score - scale.random) / width for run in sample.runs]
    scores = np.array(known, dtype=np.float64)
    n = len(scores)
    drawn: Floats | None = None
    if n > 1:
        drawn = scores[np.random.default_rng([21, *seed]).integers(0, n, (resamples, n))]
    elif (common := matched([sample])) is not None and common.returns[0].shape[1] > 1:
        # All entries share the draws of cases, as they share the cases.
        returns = (common.returns[0][0] - scale.random) / width
        drawn = (weights(len(returns), len(returns), resamples, seed[0]) @ returns / len(returns))[:, None]
    elif sample.runs[0].score is None:
        drawn = np.broadcast_to(scores, (resamples, 1))
    return _Cell(scores=scores, drawn=drawn, n_runs=n)


def _aggregate(entry: str, cells: Sequence[_Cell]) -> Aggregate:
    scores = np.concatenate([cell.scores for cell in cells])
    drawn, counted = (
        _together([cell.stretched for cell in cells]),
        _together([cell.counted for cell in cells]),
    )
    middle = float(iqm(scores))
    shares = profile(scores)
    drawn_shares = None if counted is None else profile(counted)
    many = {cell.n_runs > 1 for cell in cells}
    return Aggregate(
        entry=entry,
        iqm=_bounded(middle, None if drawn is None else iqm(drawn)) if np.isfinite(middle) else None,
        profile=tuple(
            _bounded(float(share), None if drawn_shares is None else drawn_shares[:, i])
            for i, share in enumerate(shares)
        ),
        n_runs=len(scores),
        n_environments=len(cells),
        over="nothing"
        if drawn is None
        else " or ".join(sorted({"runs" if one else "cases" for one in many})),
    )


def _together(drawn: Sequence[Floats | None]) -> Floats | None:
    parts = [one for one in drawn if one is not None]
    return np.concatenate(parts, axis=1) if len(parts) == len(drawn) else None


def _improvement(first: str, second: str, cells: Sequence[tuple[_Cell, _Cell]]) -> Improvement:
    value = float(np.mean([probability_of_improvement(one.scores, other.scores) for one, other in cells]))
    drawn: list[Floats] = []
    for one, other in cells:
        if one.counted is None or other.counted is None:
            return Improvement(
                first=first, second=second, probability=Bounded(value=value), n_environments=len(cells)
            )
        drawn.append(probability_of_improvement(one.counted, other.counted))
    return Improvement(
        first=first,
        second=second,
        probability=_bounded(value, np.mean(drawn, axis=0)),
        n_environments=len(cells),
    )


def _bounded(value: float, drawn: Floats | None) -> Bounded:
    if drawn is None or not np.isfinite(drawn).all():
        return Bounded(value=value)
    low, high = np.quantile(drawn, [ALPHA / 2.0, 1.0 - ALPHA / 2.0])
    return Bounded(value=value, low=float(low), high=float(high))
