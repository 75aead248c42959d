"""Held-out performance on the random-to-best scale (paper, mechanism section, formula of `norm`).

`norm = clip((R − R_random)/(R_best − R_random), 0, 1)`, where `R_best` is the best agent on that environment, never
the random reference itself. If no agent beats random, or the reference is missing, there is no scale and the value is
None. A diagnostic scale, separate from the rank-based score.
"""

from __future__ import annotations

from statistics import fmean

import msgspec

from evopolicy_common.catalogue.anchors import anchor
from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.scoring.scores import ScoreTable

DEMANDS = ("synthesis", "tuning")


class NormalisedCell(msgspec.Struct, frozen=True, kw_only=True):
    """One agent on one environment."""

    entry: str
    env: str
    value: float | None
    """In [0, 1]; None without a scale, or when the agent has no score."""


class GroupMean(msgspec.Struct, frozen=True, kw_only=True):
    """Macro mean of one agent over the environments of one demand group."""

    entry: str
    demand: str
    value: float | None
    """None unless the agent has a value on each environment of the group that has a scale."""
    n_environments: int
    """Number of environments on which the agent has a value."""


class Normalised(msgspec.Struct, frozen=True, kw_only=True):
    """Normalised performance of a set of agents."""

    cells: dict[tuple[str, str], NormalisedCell]
    """By (entry, env), agents only."""
    groups: tuple[GroupMean, ...]


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """The ends of one environment's scale, in returns; `best` is above `random`."""

    random: float
    best: float


def scales_of(table: ScoreTable) -> dict[str, Scale]:
    """Scales by environment, in the table's order; environments without a scale are absent."""
    out: dict[str, Scale] = {}
    for env in table.environments:
        column = table.column(env)
        anchor = column.pop(table.reference, None) if table.reference is not None else None
        best = max((value for value in column.values() if value is not None), default=None)
        if anchor is not None and best is not None and best > anchor:
            out[env] = Scale(random=anchor, best=best)
    return out


def normalise(score: float | None, random: float | None, best: float | None) -> float | None:
    """Applies the formula; returns None when a value is missing or `best ≤ random`."""
    if score is None or random is None or best is None or best <= random:
        return None
    return min(1.0, max(0.0, (score - random) / (best - random)))


def on_known_scale(score: float | None, env: str) -> float | None:
    """The score with random actions at 0 and the best known policy at 1, not clipped: a scale of the catalogue, the
    same in all reports. None without a score or a scale."""
    known = anchor(env)
    return None if score is None or known is None else known.normalised(score)


def normalised(table: ScoreTable) -> Normalised:
    """Normalises every agent of `table` on every environment that it played, and averages over both demand groups."""
    cells: dict[tuple[str, str], NormalisedCell] = {}
    scales = scales_of(table)
    for env in table.environments:
        scale = scales.get(env)
        ends = (None, None) if scale is None else (scale.random, scale.best)
        for entry, value in table.column(env).items():
            if entry != table.reference:
                cells[entry, env] = NormalisedCell(entry=entry, env=env, value=normalise(value, *ends))
    groups: list[GroupMean] = []
    for demand in DEMANDS:
        for entry in table.agents:
            own = [cells.get((entry, env)) for env in scales if demand_of(env) == demand]
            values = [cell.value for cell in own if cell is not None and cell.value is not None]
            mean = fmean(values) if values and len(values) == len(own) else None
            groups.append(GroupMean(entry=entry, demand=demand, value=mean, n_environments=len(values)))
    return Normalised(cells=cells, groups=tuple(groups))
