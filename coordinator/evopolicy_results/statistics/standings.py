"""Intervals of rank scores and ranks, and tie groups, by drawing the whole suite again.

A rank score depends only on the order of noisy means. Its interval is for the entry's average score over repetitions
of the experiment with as many new runs and cases, on the same environments against the same entries. The observed score
is an estimate of that average too, so the interval includes it. Each draw moves
the entries' means by Student's t noise of their runs and of their cases (the same cases for all entries, as they are
shared), ranks all entries again, and averages. Resampled runs would vary too little: three runs have few resamples. Two
entries are distinguished if the drawn differences of their scores are significant at 5 % after Holm's correction over
all pairs. An entry's rank then lies between 1 + (better distinguished entries) and N − (worse distinguished entries),
as in Mogstad et al. (2024).
"""

from __future__ import annotations

import itertools
import math
import string
from collections.abc import Mapping, Sequence
from functools import lru_cache

import msgspec
import numpy as np

from evopolicy_common.statistics.intervals import ALPHA, RESAMPLES, Floats
from evopolicy_results.reading.environments import by_name
from evopolicy_results.scoring.scores import Cell
from evopolicy_results.statistics.intervals import holm
from evopolicy_results.statistics.pairs import Pair, returns_in, scores_in

_BOUNDS = (ALPHA / 2.0, 1.0 - ALPHA / 2.0)
MAX_GROUPS = 200
"""Above this number of tie groups the letters are omitted: they would not be informative."""


class RankEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """The uncertainty of one row of a leaderboard."""

    entry: str
    score_low: float
    score_high: float
    """95 % interval of the rank score; it includes the observed one."""
    rank_low: int
    rank_high: int
    """Best and worst rank consistent with the comparisons, at 95 % for all pairs together."""
    ties: str
    """Letters of its tie groups: entries that share a letter cannot be distinguished."""


class Standings(msgspec.Struct, frozen=True, kw_only=True):
    """Rank estimates of a suite; entries with a cell without spread are left out."""

    rows: tuple[RankEstimate, ...] = ()
    gap: float | None = None
    """Half width of the 95 % interval of a difference of two agents' rank scores, median over pairs."""
    over: str = ""
    """`cases`, `runs and cases`, or both if cells differ."""

    def of(self, entry: str) -> RankEstimate | None:
        """The row of `entry`; None if it has none."""
        return next((row for row in self.rows if row.entry == entry), None)


@lru_cache(maxsize=8)
def t_weights(n: int, draws: int, seed: int) -> Floats:
    """(draws, n) weights w such that `mean + w @ (values − mean)` is distributed as Student's t with n − 1 degrees of
    freedom about the mean of n values, with its standard error as scale. Values of several variables get a common
    multivariate t. Zeros for n = 1. Read-only."""
    if n == 1:
        return np.zeros((draws, 1))
    generator = np.random.default_rng([13, seed, n])
    drawn: Floats = generator.normal(size=(draws, n))
    drawn /= np.sqrt(n * generator.chisquare(n - 1, size=(draws, 1)))
    drawn.setflags(write=False)
    return drawn


def standings(
    samples: Mapping[tuple[str, str], Cell],
    scores: Mapping[str, float | None],
    environments: Sequence[str],
    *,
    compared: Sequence[Pair] = (),
    resamples: int = RESAMPLES,
) -> Standings:
    """Rank estimates of the entries of `scores` (entry to its observed rank score), best first. All have a sample on
    each environment. On a single one two entries are distinguished only if `compared` tells them apart as well."""
    known = {entry: -math.inf if score is None else score for entry, score in scores.items()}
    entries = sorted(scores, key=lambda entry: (-known[entry], by_name(entry)))
    if len(entries) < 2:
        return Standings()
    n_pairs = len(entries) * (len(entries) - 1) // 2
    resamples = max(resamples, math.ceil(4 * n_pairs / ALPHA))
    drawn = _drawn_scores(samples, entries, environments, resamples)
    sure = [entry for entry in entries if entry in drawn and scores[entry] is not None]
    if len(sure) < 2:
        return Standings()
    apart = _distinguished(drawn, sure)
    if len(environments) == 1:
        told = {frozenset((one.first, one.second)) for one in compared if one.verdict in ("first", "second")}
        failed = {entry for entry in entries if samples[entry, environments[0]].scores is None}
        apart = {both for both in apart if frozenset(both) in told or failed.intersection(both)}
    rows: list[RankEstimate] = []
    for entry, letters in zip(sure, _letters(sure, apart), strict=True):
        low, high = np.quantile(drawn[entry], _BOUNDS)
        observed = scores[entry] or 0.0
        rows.append(
            RankEstimate(
                entry=entry,
                score_low=min(float(low), observed),
                score_high=max(float(high), observed),
                rank_low=1 + sum(worse == entry for _, worse in apart),
                rank_high=len(entries) - sum(better == entry for better, _ in apart),
                ties=letters,
            )
        )
    fixed = {sample.entry for sample in samples.values() if sample.fixed is not None}
    halves = [
        float(np.diff(np.quantile(drawn[one] - drawn[other], _BOUNDS))[0]) / 2.0
        for one, other in itertools.combinations([entry for entry in sure if entry not in fixed], 2)
    ]
    kinds = {len(sample.samples) > 1 for sample in samples.values() if sample.fixed is None}
    over = " or ".join(text for many, text in ((False, "cases"), (True, "runs and cases")) if many in kinds)
    return Standings(rows=tuple(rows), gap=float(np.median(halves)) if halves else None, over=over)


def _drawn_scores(
    samples: Mapping[tuple[str, str], Cell],
    entries: Sequence[str],
    environments: Sequence[str],
    resamples: int,
) -> dict[str, Floats]:
    """Resampled rank scores of the entries that vary on every environment."""
    total = np.zeros((len(entries), resamples))
    varying = set(entries)
    for number, env in enumerate(environments):
        means = np.empty_like(total)
        for i, entry in enumerate(entries):
            sample = samples[entry, env]
            scores = scores_in(sample)
            if scores is None:  # a run without an ok submit has the worst rank in every resample
                means[i] = -math.inf
            elif (drawn := _drawn_mean(sample, scores, i, number, resamples)) is not None:
                means[i] = drawn
            else:
                varying.discard(entry)
                means[i] = np.mean(scores)
        above = np.zeros_like(means)
        for row in means:
            above += row > means
        total += 1.0 - above / (len(entries) - 1)
    mean = total / len(environments)
    return {entry: mean[i] for i, entry in enumerate(entries) if entry in varying}


def _drawn_mean(sample: Cell, scores: Floats, entry: int, env: int, resamples: int) -> Floats | None:
    """Resampled means; None if the sample shows no spread."""
    returns = returns_in(sample)
    if returns is None:
        returns = np.zeros((1, 1))
    else:
        scores = returns.mean(axis=1)
    if len(scores) < 2 and returns.shape[1] < 2:
        return None
    by_case = returns.mean(axis=0)
    seed = 1000 + 97 * entry + 10_007 * env
    drawn: Floats = scores.mean() + t_weights(len(scores), resamples, seed) @ (scores - scores.mean())
    # By `env` alone: all entries play the same cases.
    drawn += t_weights(len(by_case), resamples, env) @ (by_case - by_case.mean())
    return drawn


def _distinguished(drawn: Mapping[str, Floats], entries: Sequence[str]) -> set[tuple[str, str]]:
    """Distinguished pairs of entries, the better one first."""
    places = list(itertools.combinations(entries, 2))
    tails: list[tuple[float, bool]] = []
    for one, other in places:
        gap = drawn[one] - drawn[other]
        n_below, n_above = int((gap <= 1e-12).sum()), int((gap >= -1e-12).sum())
        tails.append((min(1.0, 2.0 * (min(n_below, n_above) + 1) / (len(gap) + 1)), n_below <= n_above))
    corrected = holm([p for p, _ in tails])
    return {
        place if is_first_better else place[::-1]
        for place, (_, is_first_better), p in zip(places, tails, corrected, strict=True)
        if p is not None and p <= ALPHA
    }


def _letters(entries: Sequence[str], apart: set[tuple[str, str]]) -> list[str]:
    """Letters of each entry; two share one exactly if they are not distinguished (Piepho 2004, insert and absorb)."""
    place = {entry: i for i, entry in enumerate(entries)}
    groups: list[frozenset[int]] = [frozenset(place.values())]
    for a, b in sorted((place[better], place[worse]) for better, worse in apart):
        split = [
            part for group in groups for part in ((group - {a}, group - {b}) if {a, b} <= group else (group,))
        ]
        distinct = list(dict.fromkeys(split))
        groups = [group for group in distinct if not any(group < other for other in distinct)]
        if len(groups) > MAX_GROUPS:
            return ["…"] * len(entries)
    groups.sort(key=sorted)
    letters = [string.ascii_lowercase[i % 26] + (str(i // 26) if i >= 26 else "") for i in range(len(groups))]
    return [
        "".join(one for one, group in zip(letters, groups, strict=True) if i in group) for i in place.values()
    ]
