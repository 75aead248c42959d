"""Every figure of a report. Matplotlib is imported by the first figure that it draws."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib import import_module

import msgspec

from evopolicy_results.figures.plot import Plot
from evopolicy_results.figures.timelines import timeline_of
from evopolicy_results.reading.environments import grouped, ordered_environments
from evopolicy_results.studies.palette import looks
from evopolicy_results.studies.study import Study

_OF_SUITE = (
    "scores.rank_scores",
    "scores.score_evolution",
    "scores.performance_profiles",
    "scores.normalised_performance",
)
"""All but the second average over environments."""
_OF_STUDY = (
    "scores.overview",
    "scores.worlds",
    "policies.hit_rates",
    "policies.edit_size",
    "policies.structure",
    "policies.tokens",
    "policies.wall_time",
)


def drawings_of(study: Study) -> list[partial[Plot | None]]:
    """The figures that matplotlib draws, in order; None for one without data. Processes can send them."""
    look = looks(study.entries, study.reference)
    sent = msgspec.structs.replace(study, runs=())  # figures need no more
    return [
        partial(_draw, name, suite, sent, look)
        for suite in study.suites
        for name in (_OF_SUITE if suite.is_ranked else _OF_SUITE[1:2])
    ] + [partial(_draw, name, sent, look) for name in _OF_STUDY]


def _draw(function: str, *args: object) -> Plot | None:
    module, _, name = function.partition(".")
    plot: Plot | None = getattr(import_module(f"{__name__}.{module}"), name)(*args)
    return plot


def timelines_of(study: Study) -> Iterator[Plot]:
    """The code phases of each environment's runs, as SVG."""
    look = looks(study.entries, study.reference)
    by_env = grouped((run for run in study.runs if run.record.start is None), lambda run: run.env)
    yield from filter(None, (timeline_of(env, by_env[env], look) for env in ordered_environments(by_env)))


def figures_of(study: Study) -> Iterator[Plot]:
    """Yields the report's figures with data, in order. Each keeps its drawing in memory: write it before the next."""
    yield from filter(None, (draw() for draw in drawings_of(study)))
    yield from timelines_of(study)
