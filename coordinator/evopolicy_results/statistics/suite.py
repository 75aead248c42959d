"""All statistics of one suite, as one record."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_common.statistics.resampling import RESAMPLES
from evopolicy_results.reading.records import Run
from evopolicy_results.scoring.normalised import scales_of
from evopolicy_results.scoring.ranking import Leaderboard
from evopolicy_results.scoring.scores import ScoreTable
from evopolicy_results.statistics.aggregates import Aggregate, Improvement, aggregates
from evopolicy_results.statistics.generalisation import Generalisation, Optimism, generalisation, optimism_of
from evopolicy_results.statistics.pairs import Pair, cell_mean, pairs
from evopolicy_results.statistics.resolution import Resolution, overall, resolutions
from evopolicy_results.statistics.samples import samples_of
from evopolicy_results.statistics.standings import Standings, standings


class SuiteStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """The uncertainty of a suite's scores."""

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
    optimism: tuple[Optimism, ...]


def suite_statistics(
    runs: Sequence[Run], table: ScoreTable, board: Leaderboard, *, resamples: int = RESAMPLES
) -> SuiteStatistics:
    """Statistics of the cells of `table`, ranked as `board`. `runs` supply the returns by case, and may include
    others."""
    samples = samples_of(runs, table)
    environments = table.environments
    scales = scales_of(table)
    compared = pairs(samples, table.entries, environments, resamples=resamples)
    means = {key: mean for key, sample in samples.items() if (mean := cell_mean(sample, resamples=resamples))}
    resolved = resolutions(samples, compared, table.agents, scales, environments)
    shares, against = aggregates(samples, board.agents, scales, resamples=resamples)
    wanted = set(environments)
    general = generalisation((run for run in runs if run.env in wanted), scales)
    optimism = [optimism_of(agent, general) for agent in board.agents]
    scores = {row.entry: row.score for row in board.standings}
    return SuiteStatistics(
        means=means,
        pairs=tuple(compared),
        standings=standings(samples, scores, environments, compared=compared, resamples=resamples),
        resolutions=tuple(resolved),
        overall=overall(resolved),
        aggregates=tuple(shares),
        improvements=tuple(against),
        generalisation=tuple(general),
        optimism=tuple(one for one in optimism if one is not None),
    )
