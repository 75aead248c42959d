"""All results of a report on a set of runs, as one typed record: the notebook's entry point."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.statistics.intervals import RESAMPLES, Estimate
from evopolicy_results.behaviour.audit import TokenUse, mean_phases, token_use
from evopolicy_results.behaviour.edits import (
    EditRates,
    EditSizeBin,
    StructureMean,
    edit_rates,
    edit_size_bins,
    structure_means,
)
from evopolicy_results.reading.comparability import MixedRunsError, Mixture, mixtures
from evopolicy_results.reading.environments import (
    by_name,
    learn_names,
    ordered_environments,
    suite_title,
    suites_of,
)
from evopolicy_results.reading.parallel import Processes
from evopolicy_results.reading.reader import load_runs, rescored
from evopolicy_results.reading.records import LeftOut, PastRun
from evopolicy_results.scoring.evolution import Evolution, evolutions
from evopolicy_results.scoring.scores import (
    Leaderboard,
    Normalised,
    ScoreTable,
    leaderboard,
    normalised,
    scales_of,
    score_table,
)
from evopolicy_results.statistics.aggregates import Aggregate, Improvement, aggregates
from evopolicy_results.statistics.generalisation import Generalisation, generalisation, optimism
from evopolicy_results.statistics.pairs import Pair, Resolution, cell_mean, overall, pairs, resolutions
from evopolicy_results.statistics.standings import Standings, standings
from evopolicy_results.statistics.starts import VARIED, StartGroup, by_state, start_groups
from evopolicy_results.statistics.worlds import Worlds, worlds_of


class SuiteStatistics(msgspec.Struct, frozen=True, kw_only=True):
    means: dict[tuple[str, str], Estimate]
    """Held-out mean by (entry, env); cells without a mean are absent."""
    pairs: tuple[Pair, ...]
    standings: Standings
    resolutions: tuple[Resolution, ...]
    overall: Resolution | None
    """Resolution of the mean of normalised scores over all environments."""
    aggregates: tuple[Aggregate, ...]
    improvements: tuple[Improvement, ...]
    generalisation: tuple[Generalisation, ...]
    optimism: dict[str, Estimate]
    """By entry, the mean normalised optimism over its environments; absent where there is none."""


class SuiteStudy(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    table: ScoreTable
    board: Leaderboard
    normalised: Normalised
    statistics: SuiteStatistics

    @property
    def title(self) -> str:
        """Displayed title; it tells how much of the suite was played."""
        return suite_title(self.name, self.table.environments)

    @property
    def is_ranked(self) -> bool:
        """Whether means over environments tell more than the returns: not with a single environment."""
        return len(self.table.environments) > 1


class Study(msgspec.Struct, frozen=True, kw_only=True):
    """All metrics of a set of runs. `records.rows` turns each list of records into rows for a data frame."""

    runs: tuple[PastRun, ...]
    left_out: tuple[LeftOut, ...]
    mixtures: tuple[Mixture, ...]
    """Differences between runs in settings that a comparison holds fixed; empty unless mixing was allowed."""
    suites: tuple[SuiteStudy, ...]
    evolutions: tuple[Evolution, ...]
    edit_rates: tuple[EditRates, ...]
    structure: tuple[StructureMean, ...]
    edit_sizes: tuple[EditSizeBin, ...]
    tokens: tuple[TokenUse, ...]
    phases: dict[str, dict[str, float]]
    """By entry, the mean wall time of a run in each phase, in seconds."""
    starts: tuple[StartGroup, ...] = ()
    """Runs that start from a submit of an earlier run: all other metrics leave them out."""
    worlds: Worlds | None = None
    """Environments beside their worlds; None if no entry has played both."""

    @property
    def entries(self) -> list[str]:
        """All agents by name, without the random reference."""
        return sorted({entry for suite in self.suites for entry in suite.table.agents}, key=by_name)

    @property
    def post_hoc(self) -> str:
        """The name of the re-score that the held-out scores come from; empty for the runs' own scores."""
        rescore = next((run.rescore for run in self.runs if run.rescore is not None), None)
        if rescore is None:
            return ""
        return (
            f"Held-out scores are those of the re-score {rescore.name}: {rescore.n_cases} further hidden cases, played"
            " post hoc, after the runs had ended. The selected checkpoints are those of the runs."
        )

    @property
    def reference(self) -> str | None:
        """The entry of the uniform-random reference; None when it is missing."""
        return next(filter(None, (suite.table.reference for suite in self.suites)), None)


def study_of(
    runs: Sequence[PastRun],
    *,
    left_out: Iterable[LeftOut] = (),
    allow_mixed: bool = False,
    scores: ScoreTable | None = None,
    resamples: int = RESAMPLES,
) -> Study:
    """Computes every metric. Raises MixedRunsError when the runs are not one comparison and `allow_mixed` is false.

    `scores` adds a table of scores without run directories (such as the paper's), with other entries than those of the
    runs.
    """
    learn_names(run.record for run in runs)
    whole = [run for run in runs if run.record.start is None]
    mixed = mixtures(whole)
    for group in by_state(runs).values():
        mixed += [one for one in mixtures(group) if one.what not in VARIED]
    table = score_table(whole)
    if scores is not None:
        table, more = _merged(table, scores)
        mixed += more
    if mixed and not allow_mixed:
        raise MixedRunsError(mixed)
    every, ordered = _in_order(runs), _in_order(whole)
    random = {env: cell.mean for (entry, env), cell in table.cells.items() if entry == table.reference}
    curves = evolutions(ordered, {env: mean for env, mean in random.items() if mean is not None})
    return Study(
        runs=tuple(every),
        left_out=tuple(left_out),
        mixtures=tuple(mixed),
        suites=tuple(
            _suite(name, table.restricted(envs), ordered, resamples)
            for name, envs in suites_of(table.environments).items()
        ),
        evolutions=tuple(curves),
        edit_rates=tuple(edit_rates(ordered)),
        structure=tuple(structure_means(ordered)),
        edit_sizes=tuple(edit_size_bins(ordered)),
        tokens=tuple(token_use(ordered)),
        phases=mean_phases(every),
        starts=tuple(start_groups(every, resamples=resamples)),
        worlds=worlds_of(table, curves),
    )


def study(
    paths: Iterable[Path | str],
    *,
    allow_mixed: bool = False,
    jobs: int = 1,
    rescore: str = "",
) -> Study:
    """Reads the runs at or under `paths` and computes every metric; see `study_of`. `rescore`: name of a re-score whose
    results replace the runs' held-out results."""
    with Processes(jobs) as processes:
        loaded = load_runs([Path(path) for path in paths], processes=processes)
    runs = rescored(loaded.runs, rescore) if rescore else loaded.runs
    return study_of(runs, left_out=loaded.left_out, allow_mixed=allow_mixed)


def _suite(name: str, table: ScoreTable, runs: Sequence[PastRun], resamples: int) -> SuiteStudy:
    board, environments, scales = leaderboard(table), table.environments, scales_of(table)
    compared = pairs(table.cells, table.entries, environments, resamples=resamples)
    means = {
        key: mean for key, sample in table.cells.items() if (mean := cell_mean(sample, resamples=resamples))
    }
    resolved = resolutions(table.cells, compared, table.agents, scales, environments)
    alone, against = aggregates(table.cells, board.agents, scales, resamples=resamples)
    general = generalisation((run for run in runs if run.env in set(environments)), scales)
    scores = {row.entry: row.score for row in board.standings}
    return SuiteStudy(
        name=name,
        table=table,
        board=board,
        normalised=normalised(table),
        statistics=SuiteStatistics(
            means=means,
            pairs=tuple(compared),
            standings=standings(table.cells, scores, environments, compared=compared, resamples=resamples),
            resolutions=tuple(resolved),
            overall=overall(resolved),
            aggregates=tuple(alone),
            improvements=tuple(against),
            generalisation=tuple(general),
            optimism=optimism(board.agents, general),
        ),
    )


def _in_order(runs: Sequence[PastRun]) -> list[PastRun]:
    place = {env: i for i, env in enumerate(ordered_environments(run.env for run in runs))}
    return sorted(runs, key=lambda run: (place[run.env], run.entry.casefold(), run.record.repeat, run.name))


def _merged(table: ScoreTable, scores: ScoreTable) -> tuple[ScoreTable, list[Mixture]]:
    """Merges both tables, and returns the mixtures of environments on which both have scores."""
    if twice := set(table.agents) & set(scores.agents):
        what = "entry from runs and from a CSV"
        raise MixedRunsError([Mixture(what=what, where=name, values={}) for name in sorted(twice)])
    other = scores.reference if table.reference not in (None, scores.reference) else None
    merged = ScoreTable(
        cells={key: cell for key, cell in scores.cells.items() if key[0] != other} | table.cells,
        harness={entry: text for entry, text in scores.harness.items() if entry != other} | table.harness,
        reference=table.reference or scores.reference,
    )
    mixed = [
        Mixture(what="scores from runs and from a CSV", where=env, values={"runs": 1, "CSV": 1})
        for env in ordered_environments(set(table.environments) & set(scores.environments))
    ]
    return merged, mixed
