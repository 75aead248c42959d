"""Ranks, rank scores and wins (paper, appendix on scoring); `statistics` has their uncertainty.

Within an environment entries are ranked by held-out mean, descending; equal means share the better rank. With N
entries on it, `s = 1 − (rank − 1)/(N − 1)`. A family's score is the mean of `s` over its environments, a suite's over
all of its environments. Wins count rank 1, top-2 rank ≤ 2. Only the order of means matters, never their size.

Only entries that played every environment of the table are ranked: a mean over some environments is not comparable
with one over others. The rest are listed with the environments that they lack.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

import msgspec

from evopolicy_results.reading.environments import family_of
from evopolicy_results.scoring.scores import ScoreTable


class CellResult(msgspec.Struct, frozen=True, kw_only=True):
    """One entry on one environment."""

    entry: str
    env: str
    n_runs: int
    mean: float | None
    """Held-out mean return over runs; None without an ok submit."""
    rank: int | None
    """1 is best; None for an incomplete entry."""
    score: float | None
    """Rank score in [0, 1]; None when the entry is alone on the environment, or incomplete."""


class Standing(msgspec.Struct, frozen=True, kw_only=True):
    """One row of a suite's leaderboard."""

    entry: str
    harness: str
    is_reference: bool
    families: dict[str, float | None]
    """By family key, the mean rank score over the family's environments."""
    score: float | None
    """Mean rank score over all environments of the table; None for a single entry."""
    wins: int
    top2: int
    n_environments: int
    n_runs: int
    rank: int
    """Rank by `score`; ties share the better rank."""


class Incomplete(msgspec.Struct, frozen=True, kw_only=True):
    """An entry that played only some environments of the table, and is not ranked."""

    entry: str
    harness: str
    is_reference: bool
    missing: tuple[str, ...]
    """Environments that it has not played."""
    n_environments: int
    n_runs: int


class Leaderboard(msgspec.Struct, frozen=True, kw_only=True):
    """Standings by suite score, best first, and the cells behind them."""

    environments: tuple[str, ...]
    standings: tuple[Standing, ...]
    cells: dict[tuple[str, str], CellResult]
    """By (entry, env), those of incomplete entries included."""
    incomplete: tuple[Incomplete, ...] = ()

    @property
    def agents(self) -> list[str]:
        """Ranked entries by name, without the reference."""
        found = [row.entry for row in self.standings if not row.is_reference]
        return sorted(found, key=lambda entry: (entry.casefold(), entry))


def competition_ranks(values: Mapping[str, float | None]) -> dict[str, int]:
    """Descending ranks from 1; equal values share the better rank, None ranks below every number."""
    known = {name: (value is not None, value or 0.0) for name, value in values.items()}
    return {name: 1 + sum(other > own for other in known.values()) for name, own in known.items()}


def rank_score(rank: int, n: int) -> float | None:
    """`1 − (rank − 1)/(n − 1)`; None for n = 1, which has no order."""
    return 1.0 - (rank - 1) / (n - 1) if n > 1 else None


def leaderboard(table: ScoreTable) -> Leaderboard:
    """Ranks `table` as one suite."""
    played = {entry: [env for e, env in table.cells if e == entry] for entry in table.entries}
    ranked = [entry for entry in table.entries if len(played[entry]) == len(table.environments)]
    cells = _rank_cells(table, ranked)
    own = {entry: [cells[entry, env] for env in table.environments] for entry in ranked}
    scores = {entry: _mean([cell.score for cell in found]) for entry, found in own.items()}
    standings = []
    for entry, rank in competition_ranks(scores).items():
        families: dict[str, list[float | None]] = {}
        for cell in own[entry]:
            families.setdefault(family_of(cell.env), []).append(cell.score)
        places = [cell.rank for cell in own[entry] if cell.score is not None and cell.mean is not None]
        standings.append(
            Standing(
                entry=entry,
                harness=table.harness[entry],
                is_reference=entry == table.reference,
                families={family: _mean(values) for family, values in families.items()},
                score=scores[entry],
                wins=places.count(1),
                top2=places.count(1) + places.count(2),
                n_environments=len(own[entry]),
                n_runs=sum(cell.n_runs for cell in own[entry]),
                rank=rank,
            )
        )
    standings.sort(key=lambda row: (row.rank, row.is_reference, row.entry.casefold(), row.entry))
    incomplete = tuple(
        Incomplete(
            entry=entry,
            harness=table.harness[entry],
            is_reference=entry == table.reference,
            missing=tuple(env for env in table.environments if env not in played[entry]),
            n_environments=len(played[entry]),
            n_runs=sum(len(table.cells[entry, env].scores) for env in played[entry]),
        )
        for entry in table.entries
        if entry not in ranked
    )
    return Leaderboard(
        environments=tuple(table.environments), standings=tuple(standings), cells=cells, incomplete=incomplete
    )


def _rank_cells(table: ScoreTable, ranked: Sequence[str]) -> dict[tuple[str, str], CellResult]:
    out: dict[tuple[str, str], CellResult] = {}
    for env in table.environments:
        column = table.column(env)
        ranks = competition_ranks({entry: column[entry] for entry in ranked})
        for entry, mean in column.items():
            rank = ranks.get(entry)
            out[entry, env] = CellResult(
                entry=entry,
                env=env,
                n_runs=len(table.cells[entry, env].scores),
                mean=mean,
                rank=rank,
                score=None if rank is None else rank_score(rank, len(ranks)),
            )
    return out


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean, rounded to remove float differences of equal rank sums, so that equal standings stay ties."""
    known = [value for value in values if value is not None]
    return round(fmean(known), 12) if known else None
