"""Held-out scores by entry and environment: the input of ranking and normalisation.

A *cell* is one entry on one environment with the score of each of its runs. The uniform-random reference is an entry
with a mark: it is ranked, but it is no agent (paper, appendix on scoring). A cell whose runs had no ok submit has the
score None and ranks below every number; a cell that was never run is absent.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_results.reading.environments import ordered_environments
from evopolicy_results.reading.records import Run

RANDOM_ENTRY = "Random policy"
RANDOM_HARNESS = "Uniform"


class Cell(msgspec.Struct, frozen=True, kw_only=True):
    """One entry's runs on one environment."""

    entry: str
    env: str
    scores: tuple[float | None, ...]
    """Held-out mean return of each run; None for a run without an ok submit."""

    @property
    def mean(self) -> float | None:
        """Mean over runs; None when any of its runs had no ok submit, which has no number to average."""
        known = [score for score in self.scores if score is not None]
        return fmean(known) if known and len(known) == len(self.scores) else None


class ScoreTable(msgspec.Struct, frozen=True, kw_only=True):
    """All cells. Entries are in order of name, the reference last; environments in catalogue order, others by name."""

    cells: dict[tuple[str, str], Cell]
    """By (entry, env)."""
    harness: dict[str, str]
    """By entry."""
    reference: str | None
    """The entry of the uniform-random reference; None when it is missing."""

    @property
    def entries(self) -> list[str]:
        """All entries by name, the reference last."""
        return sorted(self.harness, key=lambda entry: (entry == self.reference, entry.casefold(), entry))

    @property
    def agents(self) -> list[str]:
        """Entries without the reference."""
        return [entry for entry in self.entries if entry != self.reference]

    @property
    def environments(self) -> list[str]:
        """All environments with a cell, in the catalogue's order."""
        return ordered_environments(env for _, env in self.cells)

    def column(self, env: str) -> dict[str, float | None]:
        """Mean of every entry that has a cell for `env`."""
        return {entry: self.cells[entry, env].mean for entry in self.entries if (entry, env) in self.cells}

    def restricted(self, environments: Sequence[str]) -> ScoreTable:
        """A table with only the cells of `environments`, and the entries that have any."""
        wanted = set(environments)
        cells = {key: cell for key, cell in self.cells.items() if key[1] in wanted}
        left = {entry for entry, _ in cells}
        return ScoreTable(
            cells=cells,
            harness={entry: harness for entry, harness in self.harness.items() if entry in left},
            reference=self.reference if self.reference in left else None,
        )


def score_table(runs: Iterable[Run]) -> ScoreTable:
    """Builds the cells of the runs, and the random reference from the runs' own records on their held-out cases."""
    runs = list(runs)
    scores: dict[tuple[str, str], list[float | None]] = {}
    harness: dict[str, set[str]] = {}
    for run in runs:
        scores.setdefault((run.entry, run.env), []).append(run.score)
        harness.setdefault(run.entry, set()).add(run.harness)
    reference = references(runs)
    name = RANDOM_ENTRY
    while name in harness:  # an operator may have given an agent this name
        name += " (reference)"
    cells = {
        key: Cell(
            entry=key[0], env=key[1], scores=tuple(sorted(found, key=lambda one: (one is not None, one)))
        )
        for key, found in scores.items()
    }
    for env, mean in reference.items():
        cells[name, env] = Cell(entry=name, env=env, scores=(mean,))
    named = {entry: ", ".join(sorted(found)) for entry, found in harness.items()}
    if reference:
        named[name] = RANDOM_HARNESS
    return ScoreTable(cells=cells, harness=named, reference=name if reference else None)


def references(runs: Iterable[Run]) -> dict[str, float]:
    """Mean held-out return of uniform random actions by environment: one number per held-out split.

    The actions follow from split and case, so all runs on a split record the same number. Runs of earlier versions
    each drew their own: they count only for a split that no newer run has played, with the mean of their numbers. An
    environment whose runs have several splits gets the mean over the splits.
    """
    by_env: dict[str, dict[str, dict[str, list[float]]]] = {}
    for run in runs:
        found = run.record.outcome.random_reference
        if found is not None and math.isfinite(found.mean_return):
            by_seeding = by_env.setdefault(run.env, {}).setdefault(
                run.record.versions.cases_hash("heldout"), {}
            )
            by_seeding.setdefault(found.seeded_by, []).append(found.mean_return)
    return {
        env: _one_mean(
            _one_mean(by_seeding.get("case") or by_seeding["run"]) for by_seeding in splits.values()
        )
        for env, splits in by_env.items()
    }


def _one_mean(values: Iterable[float]) -> float:
    """The mean; exactly the common value if all are equal."""
    found = list(values)
    return found[0] if len(set(found)) == 1 else fmean(found)


def read_score_csv(text: str, *, source: str = "the CSV") -> ScoreTable:
    """Reads a table `entry,harness,<suite id>,…` with one row per entry and one score per cell, empty if missing.

    The row with harness `Uniform` is the reference. Raises ConfigError for a file that is not such a table.
    """
    reader = csv.reader(io.StringIO(text))
    header = next(reader, [])
    if len(header) < 3 or header[:2] != ["entry", "harness"]:
        raise ConfigError(
            f"{source} does not start with the columns entry,harness,<environment>…: {header[:3]}"
        )
    environments = header[2:]
    cells: dict[tuple[str, str], Cell] = {}
    harness: dict[str, str] = {}
    reference: str | None = None
    for line, row in enumerate(reader, start=2):
        if not row:
            continue
        if len(row) != len(header) or row[0] in harness:
            raise ConfigError(
                f"{source}, line {line}: {len(row)} columns of {len(header)}, or a repeated entry"
            )
        harness[row[0]] = row[1]
        if row[1] == RANDOM_HARNESS:
            reference = row[0]
        for env, value in zip(environments, row[2:], strict=True):
            if value.strip():
                cells[row[0], env] = Cell(entry=row[0], env=env, scores=(_number(value, source, line),))
    return ScoreTable(cells=cells, harness=harness, reference=reference)


def _number(value: str, source: str, line: int) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{source}, line {line}: {value!r} is not a score")
    return number
