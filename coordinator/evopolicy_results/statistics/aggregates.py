"""Interquartile mean, performance profiles and probability of improvement over normalised scores (Agarwal et al.
2021).

The scores of single runs are normalised to the random-to-best scale of their environment, not clipped. A run without
an ok submit counts as below every number. Intervals are percentiles of a stratified bootstrap that resamples runs and
their common cases within each environment, and the scale with them, as it is estimated from the same runs. If an entry
has one run per cell, only cases are resampled, which gives the spread of these checkpoints' scores. Resamples of few
runs vary too little, by the factor (n − 1)/n. For the IQM and the scale they are therefore stretched about their mean;
profiles and probabilities have no interval if a cell has two or more runs but fewer than `LEAST_RUNS`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from evopolicy_common.statistics.intervals import ALPHA, RESAMPLES, Floats, no_spread, weights
from evopolicy_results.scoring.scores import Cell, Scale
from evopolicy_results.statistics.pairs import returns_in

LEAST_RUNS = 5
NO_SCALE = "no scale: agents do not clearly beat random"

TAUS = tuple(round(0.05 * i, 2) for i in range(21))
"""Normalised scores at which a profile is evaluated."""


class Bounded(msgspec.Struct, frozen=True, kw_only=True):
    """A number and its 95 % interval; no bounds where nothing can be resampled or a bound is not finite."""

    value: float
    low: float | None = None
    high: float | None = None
    reason: str = ""
    """Why an interval that could be resampled has no bounds."""


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
    """Resampled units: `runs and cases`, `runs` if their cases are not known, `cases` of single runs, or `nothing`."""


class Improvement(msgspec.Struct, frozen=True, kw_only=True):
    """Probability that a run of the first entry beats one of the second; mean over the environments of both."""

    first: str
    second: str
    probability: Bounded
    n_environments: int


def iqm(scores: Floats) -> Floats:
    """Interquartile mean along the last axis: without the lowest and highest ⌊n/4⌋ of n values."""
    n = scores.shape[-1]
    cut = n // 4
    middle = np.sort(scores, axis=-1)[..., cut : n - cut]
    with np.errstate(invalid="ignore"):  # the mean of both infinities
        return np.asarray(middle.mean(axis=-1), dtype=np.float64)


def profile(scores: Floats, taus: Sequence[float] = TAUS) -> Floats:
    """Share of `scores` (last axis) above each of `taus`, which become the last axis."""
    return np.stack([(scores > tau).mean(axis=-1) for tau in taus], axis=-1)


def probability_of_improvement(first: Floats, second: Floats) -> Floats:
    """P(X > Y) + P(X = Y)/2 for scores of runs along the last axes: Mann and Whitney's U over the number of pairs."""
    above = (first[..., :, None] > second[..., None, :]).mean(axis=(-2, -1))
    equal = (first[..., :, None] == second[..., None, :]).mean(axis=(-2, -1))
    return np.asarray(above + 0.5 * equal, dtype=np.float64)


class _Cell(msgspec.Struct, frozen=True, kw_only=True):
    """Scores of one entry's runs on one environment, and resamples of them, (resamples, runs)."""

    scores: Floats
    returns: Floats | None = None
    """None if nothing can be resampled; of a normalised cell, also if resampled from too few runs. Never normalised:
    only the order matters for a probability of improvement."""
    counted: Floats | None = None
    """`returns` of a normalised cell, normalised."""
    n_samples: int = 1
    """Runs that returned the same policy are one."""
    stretched: Floats | None = None
    """Stretched to the variance of that many runs; None if nothing can be resampled."""
    over: str = ""


def aggregates(
    samples: Mapping[tuple[str, str], Cell],
    agents: Sequence[str],
    scales: Mapping[str, Scale],
    *,
    resamples: int = RESAMPLES,
) -> tuple[list[Aggregate], list[Improvement]]:
    """Aggregates of all agents, and improvements of each pair; environments without a scale are left out."""
    by_entry: dict[str, dict[str, _Cell]] = {agent: {} for agent in agents}
    for place, (env, scale) in enumerate(scales.items()):
        here = [sample for (_, e), sample in samples.items() if e == env]
        drawn = {one.entry: _drawn(one, (place, number), resamples) for number, one in enumerate(here)}
        low, width = _drawn_scale(here, drawn, scale)
        for agent in drawn.keys() & by_entry.keys():
            by_entry[agent][env] = _normalised(drawn[agent], scale, low, width)
    alone = [_aggregate(agent, list(own.values())) for agent, own in by_entry.items() if own]
    against = [
        _improvement(one, other, [(by_entry[one][env], by_entry[other][env]) for env in common])
        for one, other in itertools.combinations(agents, 2)
        if (common := [env for env in by_entry[one] if env in by_entry[other]])
    ]
    return alone, against


def _drawn(sample: Cell, seed: tuple[int, int], resamples: int) -> _Cell:
    """Resamples of runs about the mean of resampled cases."""
    scores = np.array([-np.inf if run.score is None else run.score for run in sample.runs], dtype=np.float64)
    n, known, shift = len(sample.samples), returns_in(sample), np.zeros((resamples, 1))
    if known is not None and (n_cases := known.shape[1]) > 1:
        # All entries share the draws of cases, as they share the cases.
        by_case = known.mean(axis=0)
        drawn = weights(n_cases, resamples, seed[0]) @ (by_case - by_case.mean()) / n_cases
        shift = drawn[:, None]
    elif n == 1 and np.isfinite(scores[0]):
        return _Cell(scores=scores)
    if n == 1:
        return _Cell(scores=scores, returns=scores + shift, stretched=scores + shift, over="cases")
    places = np.random.default_rng([21, *seed]).integers(0, len(scores), (resamples, n))
    stretched = returns = scores[places] + shift
    if np.isfinite(scores).all():
        middle = scores.mean() + shift
        stretched = middle + np.sqrt(n / (n - 1)) * (returns - middle)
    over = "runs" if known is None else "runs and cases"
    return _Cell(scores=scores, returns=returns, stretched=stretched, n_samples=n, over=over)


def _drawn_scale(here: Sequence[Cell], cells: Mapping[str, _Cell], scale: Scale) -> tuple[Floats, Floats]:
    """Resampled low end and width of a scale, (resamples, 1). The best agent stays the observed one, and an end that
    cannot be resampled stays fixed. A width that is not above 0 becomes 0."""
    ends = {False: np.array([[scale.best]]), True: np.array([[scale.random]])}
    for sample in here:
        is_fixed = sample.fixed is not None
        known, end = sample.scores, scale.random if is_fixed else scale.best
        drawn = cells[sample.entry].stretched
        if drawn is not None and known is not None and np.isclose(np.mean(known), end, rtol=1e-12, atol=0.0):
            ends[is_fixed] = drawn.mean(axis=1, keepdims=True)
    return ends[True], np.maximum(0.0, ends[False] - ends[True])


def _normalised(cell: _Cell, scale: Scale, low: Floats, width: Floats) -> _Cell:
    def normalised(drawn: Floats | None) -> Floats | None:
        if drawn is None:
            return None
        # Without a width, a resample's scores are infinite: the interval of an aggregate that rests on them has no
        # bounds.
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num((drawn - low) / width, nan=0.0, posinf=np.inf, neginf=-np.inf)

    returns = None if 1 < cell.n_samples < LEAST_RUNS else cell.returns
    return _Cell(
        scores=(cell.scores - scale.random) / (scale.best - scale.random),
        returns=returns,
        counted=normalised(returns),
        stretched=normalised(cell.stretched),
        over=cell.over,
    )


def _aggregate(entry: str, cells: Sequence[_Cell]) -> Aggregate:
    scores = np.concatenate([cell.scores for cell in cells])
    n, middle = len(scores), float(iqm(scores))
    drawn = _together([cell.stretched for cell in cells])
    counted = _together([cell.counted for cell in cells])
    shares = [None] * len(TAUS) if counted is None else list(profile(counted).T)
    drawn_middle = None if drawn is None else iqm(drawn)
    return Aggregate(
        entry=entry,
        iqm=_bounded(middle, drawn_middle, n) if np.isfinite(middle) else None,
        profile=tuple(
            _bounded(float(share), one, n) for share, one in zip(profile(scores), shares, strict=True)
        ),
        n_runs=n,
        n_environments=len(cells),
        over="nothing" if drawn is None else " or ".join(sorted({cell.over for cell in cells})),
    )


def _together(drawn: Sequence[Floats | None]) -> Floats | None:
    parts = [one for one in drawn if one is not None]
    return np.concatenate(parts, axis=1) if len(parts) == len(drawn) else None


def _improvement(first: str, second: str, cells: Sequence[tuple[_Cell, _Cell]]) -> Improvement:
    value = float(np.mean([probability_of_improvement(one.scores, other.scores) for one, other in cells]))
    drawn = [
        probability_of_improvement(one.returns, other.returns)
        for one, other in cells
        if one.returns is not None and other.returns is not None
    ]
    n_runs = sum(len(one.scores) + len(other.scores) for one, other in cells)
    return Improvement(
        first=first,
        second=second,
        probability=_bounded(value, np.mean(drawn, axis=0) if len(drawn) == len(cells) else None, n_runs),
        n_environments=len(cells),
    )


def _bounded(value: float, drawn: Floats | None, n: int) -> Bounded:
    if drawn is None:
        return Bounded(value=value)
    # As an order statistic, a bound is not the mean of a finite and an infinite number.
    drawn = np.where(np.isnan(drawn), -np.inf, drawn)
    low, high = np.quantile(drawn, [ALPHA / 2.0, 1.0 - ALPHA / 2.0], method="nearest")
    if not np.isfinite([low, high]).all():
        return Bounded(value=value, reason=NO_SCALE)
    if low == high:
        return Bounded(value=value, reason=no_spread(n))
    return Bounded(value=value, low=float(low), high=float(high))
