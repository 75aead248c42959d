"""Environments beside their worlds: scores, their difference, and learning curves, all on the known scale
(0 random actions, 1 the best known policy; `catalogue.anchors`).

Environments are given. Worlds are draws: an interval covers repetitions with new worlds, runs, and cases.
So the variance of a mean over an environment's worlds is that of the worlds' means, each of which has its
runs and cases in it, and the unchanged environment's is that of its runs and cases. All are independent:
worlds share neither runs nor cases. The means over a family or a suite sum these variances
(`intervals.stratified`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec
import numpy as np

from evopolicy_common.catalogue import Anchor, anchor
from evopolicy_common.catalogue.worlds import unchanged
from evopolicy_common.statistics.intervals import Estimate, Over
from evopolicy_results.reading.environments import family_of, grouped
from evopolicy_results.scoring.evolution import Evolution
from evopolicy_results.scoring.scores import Cell, ScoreTable, by_policy
from evopolicy_results.statistics.intervals import Stratum, stratified, stratum, stratum_of
from evopolicy_results.statistics.pairs import clustered, returns_in

N_POINTS = 64
"""Intervals of episodes between the points of a curve."""


class Paired(msgspec.Struct, frozen=True, kw_only=True):
    """One entry over some environments and their worlds."""

    entry: str
    scope: str
    """An environment's id, a family's key, or empty for all environments."""
    unchanged: Estimate
    worlds: Estimate
    difference: Estimate
    """`unchanged − worlds`."""
    n_environments: int
    n_worlds: int


class WorldPoint(msgspec.Struct, frozen=True, kw_only=True):
    """The best so far after some episodes, mean over environments; random actions count from the start."""

    episodes: int
    unchanged: Estimate
    worlds: Estimate


class Worlds(msgspec.Struct, frozen=True, kw_only=True):
    """All entries of a report that played environments and worlds of them."""

    paired: tuple[Paired, ...]
    """By entry: all environments, families if there are several, then each environment."""
    curves: dict[str, tuple[WorldPoint, ...]]
    """By agent."""


class _Cell(msgspec.Struct, frozen=True):
    """One entry on one environment and its worlds."""

    env: str
    unchanged: Stratum
    worlds: Stratum
    n_worlds: int


def worlds_of(table: ScoreTable, evolutions: Iterable[Evolution]) -> Worlds | None:
    """None unless some entry has scores in an environment and worlds of it."""
    altered = (env for env in table.environments if unchanged(env) != env and anchor(env) is not None)
    pairs = grouped(altered, unchanged)
    paired: list[Paired] = []
    for entry in table.entries:
        cells = [
            cell
            for env, worlds in pairs.items()
            if (cell := _cell(env, [table.cells.get((entry, each)) for each in (env, *worlds)])) is not None
        ]
        scopes = {"": cells} if len(cells) > 1 else {}
        families = grouped(cells, lambda cell: family_of(cell.env))
        scopes |= families if len(families) > 1 else {}
        scopes |= {cell.env: [cell] for cell in cells}
        paired += [_paired(entry, scope, own) for scope, own in scopes.items()]
    if not paired:
        return None
    by_entry = grouped(evolutions, lambda one: one.entry)
    curves = {entry: _curve(by_entry.get(entry, ()), pairs) for entry in table.agents}
    return Worlds(paired=tuple(paired), curves={entry: curve for entry, curve in curves.items() if curve})


def _cell(env: str, samples: Sequence[Cell | None]) -> _Cell | None:
    """None if the environment, or one of the report's worlds of it, has no score of the entry."""
    scale = anchor(env)
    known = [sample for sample in samples if sample is not None and sample.scores is not None]
    if scale is None or len(known) < len(samples):
        return None
    first, *others = (_stratum(sample, scale) for sample in known)
    return _Cell(env, first, stratum_of([one.value for one in others]), len(others))


def _stratum(sample: Cell, scale: Anchor) -> Stratum:
    if (returns := returns_in(sample)) is None:
        return stratum_of(
            clustered(np.array([scale.normalised(score) for score in sample.scores or ()]), sample.samples)
        )
    return stratum((returns - scale.random.mean) / scale.width)


def _paired(entry: str, scope: str, cells: Sequence[_Cell]) -> Paired:
    before, after = [cell.unchanged for cell in cells], [cell.worlds for cell in cells]
    share = [1.0 / len(cells)] * len(cells)
    over: Over = "worlds, runs, and cases"
    return Paired(
        entry=entry,
        scope=scope,
        unchanged=stratified(before, share, "runs and cases"),
        worlds=stratified(after, share, over),
        difference=stratified(before + after, share + [-each for each in share], over),
        n_environments=len(cells),
        n_worlds=sum(cell.n_worlds for cell in cells),
    )


def _curve(evolutions: Sequence[Evolution], pairs: dict[str, list[str]]) -> tuple[WorldPoint, ...]:
    """The curve over the environments of which the entry has played all of the report's worlds."""
    by_env = grouped(evolutions, lambda one: one.env)
    whole = {env: worlds for env, worlds in pairs.items() if all(each in by_env for each in (env, *worlds))}
    if not whole:
        return ()
    played = [env for base, worlds in whole.items() for env in (base, *worlds)]
    budget = max(one.budget for env in whole for one in by_env[env])
    share = [1.0 / len(whole)] * len(whole)

    def unchanged_at(env: str, levels: list[float]) -> Stratum:
        return stratum_of(clustered(np.array(levels), by_policy([one.policy for one in by_env[env]])))

    def point(episodes: int) -> WorldPoint:
        levels = {env: [_level(one, episodes) for one in by_env[env]] for env in played}
        after = [stratum_of([fmean(levels[each]) for each in worlds]) for worlds in whole.values()]
        return WorldPoint(
            episodes=episodes,
            unchanged=stratified([unchanged_at(env, levels[env]) for env in whole], share, "runs"),
            worlds=stratified(after, share, "worlds, runs, and cases"),
        )

    return tuple(
        point(episodes) for episodes in sorted({round(x) for x in np.linspace(0, budget, N_POINTS + 1)})
    )


def _level(one: Evolution, episodes: int) -> float:
    scale = anchor(one.env)
    assert scale is not None
    return max([0.0, *(scale.normalised(step.best) for step in one.steps if step.consumed <= episodes)])
