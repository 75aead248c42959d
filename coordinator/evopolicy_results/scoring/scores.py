"""Held-out scores by entry and environment, their ranks, and their place between random and the best.

A *cell* is one entry on one environment with the score of each of its runs. The uniform-random reference is an entry
with a mark: it is ranked, but it is no agent (paper, appendix on scoring). A cell whose runs had no ok submit has the
score None and ranks below every number; a cell that was never run is absent.

Ranks (the same appendix; `statistics` has their uncertainty): within an environment entries are ranked by held-out
mean, descending; equal means share the better rank. With N entries on it, `s = 1 − (rank − 1)/(N − 1)`. A family's
score is the mean of `s` over its environments, a suite's over all of its environments. Wins count rank 1, top-2 rank
≤ 2. Only the order of means matters, never their size. Only entries that played every environment of the table are
ranked: a mean over some environments is not comparable with one over others.

Normalised performance (mechanism section): `norm = clip((R − R_random)/(R_best − R_random), 0, 1)`, where `R_best` is
the best agent on that environment, never the random reference itself. If no agent beats random, or the reference is
missing, there is no scale and the value is None. A diagnostic scale, separate from the rank-based score.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from statistics import fmean

import msgspec
from msgspec.structs import replace

from evopolicy_common.catalogue import anchor
from evopolicy_common.errors import ConfigError
from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.reading.environments import by_name, family_of, grouped, ordered_environments
from evopolicy_results.reading.records import PastRun

RANDOM_ENTRY = "Random policy"
RANDOM_HARNESS = "Uniform"


class RunReturns(msgspec.Struct, frozen=True, kw_only=True):
    """One run's held-out score and the returns behind it. Two runs share a case if they name the same case set and the
    case has the same position in it. A return that is not finite, or missing at the end, is a missing case."""

    score: float | None
    """Mean return; None without an ok submit."""
    returns: tuple[float, ...] = ()
    """By case, in the order of its case set; empty if only the score is known."""
    case_set: str = ""
    """Equal for runs that played the same cases; empty: cases that no other run has."""
    policy: str = ""
    """Digest of the selected policy's bundle; empty if unknown."""


class Cell(msgspec.Struct, frozen=True, kw_only=True):
    """One entry's runs on one environment."""

    entry: str
    env: str
    runs: tuple[RunReturns, ...]
    fixed: float | None = None
    """Of the random reference, which is one given policy: its mean over all splits. None for an agent, whose runs
    vary."""
    rank: int | None = None
    """1 is best; None before the ranking, and for an incomplete entry."""
    score: float | None = None
    """Rank score in [0, 1]; None without a rank, and when the entry is alone on the environment."""

    @property
    def scores(self) -> tuple[float, ...] | None:
        """The score of each run; None when a run has no ok submit, or a score that is not finite."""
        known = tuple(run.score for run in self.runs if run.score is not None and math.isfinite(run.score))
        return known if known and len(known) == len(self.runs) else None

    @property
    def mean(self) -> float | None:
        """Mean over runs; None when any of its runs had no ok submit, which has no number to average."""
        return mean_of_all([run.score for run in self.runs]) if self.fixed is None else self.fixed

    @property
    def n_runs(self) -> int:
        return len(self.runs)

    @property
    def samples(self) -> list[list[int]]:
        """Its runs as `by_policy` groups them."""
        return by_policy([run.policy for run in self.runs])

    @property
    def repeated(self) -> str:
        """Which of its runs returned the same policy, such as `both repeats returned the same policy`; empty if none
        did."""
        sizes = [len(sample) for sample in self.samples if len(sample) > 1]
        if not sizes:
            return ""
        n = self.n_runs
        if sizes == [n]:
            return f"{'both' if n == 2 else f'all {n}'} repeats returned the same policy"
        returned = "the same policy" if len(sizes) == 1 else f"{len(sizes)} policies"
        return f"{sum(sizes)} of {n} repeats returned {returned}"


def by_policy(policies: Sequence[str]) -> list[list[int]]:
    """The places of runs, given the digests of their selected policies. Those whose policies are equal byte for byte
    are together, as one sample of what the agent returns; a run whose policy is not known is a sample of its own."""
    return list(grouped(range(len(policies)), lambda place: policies[place] or str(place)).values())


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
        return sorted(self.harness, key=lambda entry: (entry == self.reference, by_name(entry)))

    @property
    def agents(self) -> list[str]:
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
        cells = {key: cell for key, cell in self.cells.items() if key[1] in environments}
        harness = {entry: self.harness[entry] for entry in self.harness if any(entry == e for e, _ in cells)}
        return ScoreTable(
            cells=cells, harness=harness, reference=self.reference if self.reference in harness else None
        )


def mean_of_all(values: Sequence[float | None]) -> float | None:
    """None unless all are known."""
    known = [value for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None


def score_table(runs: Iterable[PastRun]) -> ScoreTable:
    """Builds the cells of the runs, and the random reference from the runs' own records on their held-out cases."""
    runs = list(runs)
    harness = {
        entry: ", ".join(sorted({run.harness for run in several}))
        for entry, several in grouped(runs, lambda run: run.entry).items()
    }
    name = RANDOM_ENTRY
    while name in harness:  # an operator may have given an agent this name
        name += " (reference)"
    cells: dict[tuple[str, str], Cell] = {}
    for (entry, env), several in grouped(runs, lambda run: (run.entry, run.env)).items():
        several.sort(key=lambda run: (run.record.repeat, run.name))
        cells[entry, env] = Cell(entry=entry, env=env, runs=tuple(map(returns_of, several)))
    means, by_env = references(runs), grouped(runs, lambda run: run.env)
    for env, mean in means.items():
        recorded = [each for run in by_env[env] if (each := _reference_of(run)) is not None]
        sets = [each.case_set for each in recorded]
        # The case set that most runs played.
        most = max(recorded, key=lambda each: (sets.count(each.case_set), each.case_set), default=None)
        cells[name, env] = Cell(entry=name, env=env, runs=(most or RunReturns(score=mean),), fixed=mean)
    if means:
        harness[name] = RANDOM_HARNESS
    return ScoreTable(cells=cells, harness=harness, reference=name if means else None)


def returns_of(run: PastRun) -> RunReturns:
    shared = run.record.experiment_dimensions.hidden_cases == "shared"
    return RunReturns(
        score=run.score,
        returns=run.record.outcome.heldout_returns if run.score is not None else (),
        case_set=run.record.versions.cases_hash("heldout") if shared else "",
        policy=run.policy,
    )


def _reference_of(run: PastRun) -> RunReturns | None:
    """The recorded returns of the random reference on the run's cases; None for cases or actions of its own."""
    recorded, case_set = run.record.outcome.random_reference, returns_of(run).case_set
    if recorded is None or not recorded.returns or not case_set:
        return None
    return RunReturns(score=recorded.mean_return, returns=recorded.returns, case_set=case_set)


def references(runs: Iterable[PastRun]) -> dict[str, float]:
    """Mean held-out return of uniform random actions by environment: one number per held-out split.

    The actions follow from split and case, so all runs on a split record the same number. An environment whose runs
    have several splits gets the mean over the splits.
    """
    by_env: dict[str, dict[str, list[float]]] = {}
    for run in runs:
        reference = run.record.outcome.random_reference
        if reference is not None and math.isfinite(reference.mean_return):
            by_split = by_env.setdefault(run.env, {})
            by_split.setdefault(run.record.versions.cases_hash("heldout"), []).append(reference.mean_return)
    return {env: _one_mean([_one_mean(each) for each in splits.values()]) for env, splits in by_env.items()}


def _one_mean(values: Sequence[float]) -> float:
    """The mean; exactly the common value if all are equal."""
    return values[0] if len(set(values)) == 1 else fmean(values)


def read_score_csv(text: str, *, source: str = "the CSV") -> ScoreTable:
    """Reads a table `entry,harness,<suite id>,…` with one row per entry and one score per cell, empty if missing. The
    row with harness `Uniform` is the reference. Raises ConfigError for a file that is not such a table."""
    reader = csv.reader(io.StringIO(text))
    header = next(reader, [])
    if len(header) < 3 or header[:2] != ["entry", "harness"]:
        raise ConfigError(
            f"{source} does not start with the columns entry,harness,<environment>…: {header[:3]}"
        )
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
        for env, value in zip(header[2:], row[2:], strict=True):
            if value.strip():
                score = _number(value, source, line)
                fixed = score if row[1] == RANDOM_HARNESS else None
                runs = (RunReturns(score=score),)
                cells[row[0], env] = Cell(entry=row[0], env=env, runs=runs, fixed=fixed)
    return ScoreTable(cells=cells, harness=harness, reference=reference)


def _number(value: str, source: str, line: int) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{source}, line {line}: {value!r} is not a score")
    return number


class Standing(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An entry's row in a suite's leaderboard."""

    entry: str
    harness: str
    is_reference: bool
    families: dict[str, float | None]
    """By family key, the mean rank score over the family's environments; empty for an incomplete entry."""
    score: float | None
    """Mean rank score over all environments of the table; None for a single or an incomplete entry."""
    wins: int
    top2: int
    n_environments: int
    n_runs: int
    rank: int | None
    """Rank by `score`; ties share the better rank. None for an incomplete entry."""
    missing: tuple[str, ...] = ()
    """Environments that an incomplete entry has not played."""


class Leaderboard(msgspec.Struct, frozen=True, kw_only=True):
    """Standings by suite score, best first, and the cells behind them."""

    standings: tuple[Standing, ...]
    incomplete: tuple[Standing, ...]
    """Entries that played only some environments of the table."""
    cells: dict[tuple[str, str], Cell]
    """By (entry, env), those of incomplete entries included."""

    @property
    def agents(self) -> list[str]:
        """Ranked entries by name, without the reference."""
        return sorted((row.entry for row in self.standings if not row.is_reference), key=by_name)


def competition_ranks(values: Mapping[str, float | None]) -> dict[str, int]:
    """Descending ranks from 1; equal values share the better rank, None ranks below every number."""
    known = {name: (value is not None, value or 0.0) for name, value in values.items()}
    return {name: 1 + sum(other > own for other in known.values()) for name, own in known.items()}


def rank_score(rank: int, n: int) -> float | None:
    """`1 − (rank − 1)/(n − 1)`; None for n = 1, which has no order."""
    return 1.0 - (rank - 1) / (n - 1) if n > 1 else None


def leaderboard(table: ScoreTable) -> Leaderboard:
    envs = table.environments
    played = {entry: [env for env in envs if (entry, env) in table.cells] for entry in table.entries}
    complete = [entry for entry in table.entries if len(played[entry]) == len(envs)]
    cells: dict[tuple[str, str], Cell] = {}
    for env in envs:
        means = table.column(env)
        places = competition_ranks({entry: means[entry] for entry in complete})
        for entry in means:
            place = places.get(entry)
            score = None if place is None else rank_score(place, len(places))
            cells[entry, env] = replace(table.cells[entry, env], rank=place, score=score)
    scores = {entry: _mean(cells[entry, env].score for env in envs) for entry in complete}
    ranks = competition_ranks(scores)
    rows = []
    for entry in table.entries:
        own = [cells[entry, env] for env in played[entry]]
        families = grouped(own if entry in ranks else (), lambda cell: family_of(cell.env))
        counted = [cell.rank for cell in own if cell.score is not None and cell.mean is not None]
        rows.append(
            Standing(
                entry=entry,
                harness=table.harness[entry],
                is_reference=entry == table.reference,
                families={name: _mean(cell.score for cell in some) for name, some in families.items()},
                score=scores.get(entry),
                wins=counted.count(1),
                top2=counted.count(1) + counted.count(2),
                n_environments=len(own),
                n_runs=sum(cell.n_runs for cell in own),
                rank=ranks.get(entry),
                missing=tuple(env for env in envs if env not in played[entry]),
            )
        )
    ranked = [row for row in rows if row.rank is not None]
    return Leaderboard(
        standings=tuple(sorted(ranked, key=lambda row: row.rank or 0)),  # otherwise in order of name
        incomplete=tuple(row for row in rows if row.rank is None),
        cells=cells,
    )


def _mean(values: Iterable[float | None]) -> float | None:
    """The mean, rounded to remove float differences of equal rank sums, so that equal standings stay ties."""
    known = [value for value in values if value is not None]
    return round(fmean(known), 12) if known else None


DEMANDS = ("synthesis", "tuning")


class Scale(msgspec.Struct, frozen=True, kw_only=True):
    """The ends of one environment's scale, in returns; `best` is above `random`."""

    random: float
    best: float

    def clipped(self, score: float) -> float:
        return min(1.0, max(0.0, (score - self.random) / (self.best - self.random)))


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

    cells: dict[tuple[str, str], float | None]
    """By (entry, env), agents only, in [0, 1]; None without a scale, or when the agent has no score."""
    groups: tuple[GroupMean, ...]


def scale_between(random: float | None, best: float | None) -> Scale | None:
    """None when an end is missing or `best` is not above `random`."""
    return None if random is None or best is None or best <= random else Scale(random=random, best=best)


def scales_of(table: ScoreTable) -> dict[str, Scale]:
    """Scales by environment, in the table's order; environments without a scale are absent."""
    out: dict[str, Scale] = {}
    for env in table.environments:
        column = table.column(env)
        random = column.pop(table.reference, None) if table.reference is not None else None
        best = max((value for value in column.values() if value is not None), default=None)
        if (scale := scale_between(random, best)) is not None:
            out[env] = scale
    return out


def on_known_scale(score: float | None, env: str) -> float | None:
    """The score with random actions at 0 and the best known policy at 1, not clipped: a scale of the catalogue, the
    same in all reports. None without a score or a scale."""
    known = anchor(env)
    return None if score is None or known is None else known.normalised(score)


def normalised(table: ScoreTable) -> Normalised:
    """Normalises every agent of `table` on every environment that it played, and averages over both demand groups."""
    scales = scales_of(table)
    cells = {
        (entry, env): scales[env].clipped(score) if env in scales and score is not None else None
        for env in table.environments
        for entry, score in table.column(env).items()
        if entry != table.reference
    }
    groups: list[GroupMean] = []
    for demand in DEMANDS:
        for entry in table.agents:
            own = [cells.get((entry, env)) for env in scales if demand_of(env) == demand]
            values = [value for value in own if value is not None]
            mean = fmean(values) if values and len(values) == len(own) else None
            groups.append(GroupMean(entry=entry, demand=demand, value=mean, n_environments=len(values)))
    return Normalised(cells=cells, groups=tuple(groups))


def paper_text(name: str) -> str:
    """The CSV text of one of the paper's own tables, by its file's name without the ending; `data/SOURCE.md` names the
    source of each."""
    return files("evopolicy_results").joinpath("data", f"{name}.csv").read_text(encoding="utf-8")


def heldout_returns() -> ScoreTable:
    """The paper's table of held-out returns: four agents and the random reference on Core16, one run per cell."""
    return read_score_csv(paper_text("table1_heldout_returns"), source="table1_heldout_returns.csv")
