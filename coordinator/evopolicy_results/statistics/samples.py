"""The input of all statistics: the held-out returns of each run, by case, for one environment.

Two runs share a case if they name the same case set (the hash of the held-out split) and the case has the same
position in it. A return that is not finite, or missing at the end, is a missing case of that run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from evopolicy_common.statistics.resampling import Floats
from evopolicy_results.reading.records import Run
from evopolicy_results.scoring.scores import ScoreTable


class RunReturns(msgspec.Struct, frozen=True, kw_only=True):
    """One run's score and the returns behind it."""

    score: float | None
    """Held-out mean return; None without an ok submit."""
    returns: tuple[float, ...] = ()
    """By case, in the order of its case set; empty if only the score is known."""
    case_set: str = ""
    """Equal for runs that played the same cases; empty: cases that no other run has."""


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """One entry's runs on one environment."""

    entry: str
    env: str
    runs: tuple[RunReturns, ...]
    is_fixed: bool = False
    """Whether the entry is one given policy (the random reference), not an agent whose runs vary."""

    @property
    def scores(self) -> list[float] | None:
        """The score of each run; None when a run has no ok submit, or a score that is not finite."""
        known = [run.score for run in self.runs if run.score is not None and np.isfinite(run.score)]
        return known if known and len(known) == len(self.runs) else None


class Matched(msgspec.Struct, frozen=True, kw_only=True):
    """Samples on the cases that all their runs have."""

    returns: tuple[Floats, ...]
    """One matrix runs × cases per sample."""
    n_left_out: int
    """Number of cases that only some of the runs have."""


def matched(samples: Sequence[Sample]) -> Matched | None:
    """The samples' returns on their common cases; None if no case is common to all runs."""
    runs = [run for sample in samples for run in sample.runs]
    if not runs or any(not run.returns or run.score is None for run in runs):
        return None
    if len(runs) > 1 and (len({run.case_set for run in runs}) > 1 or not runs[0].case_set):
        return None
    n_cases = max(len(run.returns) for run in runs)
    every = np.full((len(runs), n_cases), np.nan)
    for row, run in zip(every, runs, strict=True):
        row[: len(run.returns)] = run.returns
    has = np.isfinite(every)
    common = has.all(axis=0)
    if not common.any():
        return None
    ends = np.cumsum([len(sample.runs) for sample in samples])
    return Matched(
        returns=tuple(np.split(every[:, common], ends[:-1])),
        n_left_out=int(has.any(axis=0).sum() - common.sum()),
    )


def returns_of(run: Run) -> RunReturns:
    """What the statistics use of a run."""
    shared = run.record.experiment_dimensions.hidden_cases == "shared"
    return RunReturns(
        score=run.score,
        returns=run.record.outcome.heldout_returns if run.score is not None else (),
        case_set=run.record.versions.cases_hash("heldout") if shared else "",
    )


def samples_of(runs: Iterable[Run], table: ScoreTable) -> dict[tuple[str, str], Sample]:
    """A sample for each cell of `table`, by (entry, env): the runs' own returns, or only scores if nothing else is
    known.

    The random reference has the returns recorded by the runs on the case set that most of them played.
    """
    played: dict[tuple[str, str], list[RunReturns]] = {}
    random: dict[str, list[RunReturns]] = {}
    for run in runs:
        own, recorded = returns_of(run), run.record.outcome.random_reference
        played.setdefault((run.entry, run.env), []).append(own)
        if recorded is not None and recorded.returns and recorded.seeded_by == "case" and own.case_set:
            random.setdefault(run.env, []).append(
                RunReturns(score=recorded.mean_return, returns=recorded.returns, case_set=own.case_set)
            )
    out: dict[tuple[str, str], Sample] = {}
    for (entry, env), cell in table.cells.items():
        is_reference = entry == table.reference
        several = played.get((entry, env), [])
        if is_reference and env in random:
            sets = [one.case_set for one in random[env]]
            several = [max(random[env], key=lambda one: (sets.count(one.case_set), one.case_set))]
        out[entry, env] = Sample(
            entry=entry,
            env=env,
            runs=tuple(several or (RunReturns(score=score) for score in cell.scores)),
            is_fixed=is_reference,
        )
    return out
