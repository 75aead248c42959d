"""Ranks, rank scores and wins (paper, appendix on scoring); `statistics` has their uncertainty.

Within an environment entries are ranked by held-out mean, descending; equal means share the better rank. With N
entries on it, `s = 1 − (rank − 1)/(N − 1)`. A family's score is the mean of `s` over its environments, a suite's over
all of its environments. Wins count rank 1, top-2 rank ≤ 2. Only the order of means matters, never their size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

import msgspec

from evopolicy_coordinator.analysis.scoring.scores import ScoreTable, family_of


class CellResult(msgspec.Struct, frozen=True, kw_only=True):
    """One entry on one environment."""

    entry: str
    env: str
    n_runs: int
    mean: float | None
    """Held-out mean return over runs; None without an ok submit."""
    rank: int
    """1 is best."""
    score: float | None
    """Rank score in [0, 1]; None when the entry is alone on the environment."""


class Standing(msgspec.Struct, frozen=True, kw_only=True):
    """One row of a suite's leaderboard."""

    entry: str
    harness: str
    is_reference: bool
    families: dict[str, float | None]
    """By family key, the mean rank score over the family's environments that the entry has played."""
    score: float | None
    """Mean rank score over the suite's environments that the entry has played."""
    wins: int
    top2: int
    n_environments: int
    """Number of environments played; compare scores only if it is the whole suite."""
    n_runs: int
    rank: int
    """Rank by `score`; ties share the better rank."""


class Leaderboard(msgspec.Struct, frozen=True, kw_only=True):
    """Standings by suite score, best first, and the cells behind them."""

    environments: tuple[str, ...]
    standings: tuple[Standing, ...]
    cells: dict[tuple[str, str], CellResult]
    """By (entry, env)."""

    def marks(self, env: str) -> dict[str, int]:
        """Entry to 1 for the best and 2 for the second-best of `env`; ties share a mark, others are absent."""
        ranks = {
            entry: cell.rank for (entry, e), cell in self.cells.items() if e == env and cell.mean is not None
        }
        return {entry: rank for entry, rank in ranks.items() if rank <= 2}


def competition_ranks(values: Mapping[str, float | None]) -> dict[str, int]:
    """Descending ranks from 1; equal values share the better rank, None ranks below every number."""
    return {
        name: 1 + sum(_above(other, value) for other in values.values()) for name, value in values.items()
    }


def _above(other: float | None, value: float | None) -> bool:
    if other is None:
        return False
    return value is None or other > value


def rank_score(rank: int, n: int) -> float | None:
    """`1 − (rank − 1)/(n − 1)`; None for n = 1, which has no order."""
    return 1.0 - (rank - 1) / (n - 1) if n > 1 else None


def leaderboard(table: ScoreTable) -> Leaderboard:
    """Ranks `table` as one suite."""
    cells = _rank_cells(table)
    suite_scores = {entry: _mean(_scores(cells, table, entry)) for entry in table.entries}
    ranks = competition_ranks(suite_scores)
    standings = [_standing(table, cells, entry, suite_scores[entry], ranks[entry]) for entry in table.entries]
    standings.sort(key=lambda row: (row.rank, row.is_reference, row.entry.casefold(), row.entry))
    return Leaderboard(environments=tuple(table.environments), standings=tuple(standings), cells=cells)


def _rank_cells(table: ScoreTable) -> dict[tuple[str, str], CellResult]:
    out: dict[tuple[str, str], CellResult] = {}
    for env in table.environments:
        column = table.column(env)
        for entry, rank in competition_ranks(column).items():
            cell = table.cells[entry, env]
            out[entry, env] = CellResult(
                entry=entry,
                env=env,
                n_runs=len(cell.scores),
                mean=column[entry],
                rank=rank,
                score=rank_score(rank, len(column)),
            )
    return out


def _scores(cells: Mapping[tuple[str, str], CellResult], table: ScoreTable, entry: str) -> list[float | None]:
    return [cells[entry, env].score for env in table.environments if (entry, env) in cells]


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean, rounded to remove float differences of equal rank sums, so that equal standings stay ties."""
    known = [value for value in values if value is not None]
    return round(fmean(known), 12) if known else None


def _standing(
    table: ScoreTable,
    cells: Mapping[tuple[str, str], CellResult],
    entry: str,
    score: float | None,
    rank: int,
) -> Standing:
    own = [cells[entry, env] for env in table.environments if (entry, env) in cells]
    families: dict[str, list[float | None]] = {}
    for env in table.environments:
        family = families.setdefault(family_of(env), [])
        if (entry, env) in cells:
            family.append(cells[entry, env].score)
    scored = [cell for cell in own if cell.score is not None and cell.mean is not None]
    return Standing(
        entry=entry,
        harness=table.harness[entry],
        is_reference=entry == table.reference,
        families={family: _mean(values) for family, values in families.items()},
        score=score,
        wins=sum(cell.rank == 1 for cell in scored),
        top2=sum(cell.rank <= 2 for cell in scored),
        n_environments=len(own),
        n_runs=sum(cell.n_runs for cell in own),
        rank=rank,
    )
