"""Every figure of a report, drawn with matplotlib, which is imported only here."""

from __future__ import annotations

from collections.abc import Iterator

from evopolicy_results.figures import cost, edits, profiles, scores
from evopolicy_results.figures.style import Plot
from evopolicy_results.reading.environments import ordered_environments
from evopolicy_results.studies.palette import looks
from evopolicy_results.studies.study import Study


def figures_of(study: Study) -> Iterator[Plot]:
    """Yields the report's figures in order; figures without data are omitted.

    Each keeps its drawing in memory until it is dropped: write it before taking the next.
    """
    look = looks(study.entries, study.reference)
    for suite in study.suites:
        for plot in (
            scores.rank_scores(suite, look),
            scores.score_evolution(suite, study, look),
            profiles.performance_profiles(suite, look),
            scores.normalised_performance(suite, look),
        ):
            if plot is not None:
                yield plot
    for draw in (edits.hit_rates, edits.edit_size, cost.structure, cost.tokens, cost.wall_time):
        plot = draw(study, look)
        if plot is not None:
            yield plot
    for env in ordered_environments(line.env for line in study.timelines):
        plot = edits.timeline(env, [line for line in study.timelines if line.env == env], look)
        if plot is not None:
            yield plot
