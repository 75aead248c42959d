"""Generalisation from train to validation to held-out: the selected checkpoint's scores, and the selection's
optimism.

The validation score of the selected checkpoint is the best of many, so it is too high on average; its held-out score
is not. Their difference is the selection's optimism. Success is given if the environment reports it, or if its
return determines it exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

import msgspec

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_results.reading.environments import family_of
from evopolicy_results.reading.records import PastRun, by_cell
from evopolicy_results.scoring.scores import Scale, mean_of_all
from evopolicy_results.statistics.intervals import of_runs

SUCCESS_ABOVE = {"minigrid": 0.0, "gym/acrobot": -500.0, "gym/continuouscar": 0.0}
"""By family or environment, the return above which an episode has reached its goal. MiniGrid pays 1 − 0.9 ·
steps/limit at the goal, otherwise 0. Acrobot costs 1 per step except the one that reaches the goal, up to 500 steps.
MountainCarContinuous pays 100 at the goal, and costs at most 0.1 per step, up to 999 steps."""


class Generalisation(msgspec.Struct, frozen=True, kw_only=True):
    """One entry on one environment; means over its completed runs."""

    entry: str
    env: str
    n_runs: int
    train: float | None
    """Mean return of the selected submit's own train episodes; None if a run has no record of it."""
    validation: float | None
    heldout: float
    optimism: float | None
    """`validation − heldout`."""
    normalised_optimism: float | None
    """As a share of the random-to-best scale."""
    success: float | None
    """Share of held-out episodes that reached the goal, as environment or returns tell it; None if neither does."""


def generalisation(runs: Iterable[PastRun], scales: Mapping[str, Scale]) -> list[Generalisation]:
    """Every entry on every environment with a completed run, environments in catalogue order."""
    completed = by_cell(run for run in runs if run.score is not None)
    return [_cell(entry, env, several, scales.get(env)) for (env, entry), several in completed.items()]


def optimism(entries: Iterable[str], cells: Sequence[Generalisation]) -> dict[str, Estimate]:
    """The mean normalised optimism of each entry that has any, with a t interval over environments."""
    known = [(cell.entry, cell.normalised_optimism) for cell in cells]
    values = {entry: [value for e, value in known if e == entry and value is not None] for entry in entries}
    return {entry: of_runs(several) for entry, several in values.items() if several}


def _cell(entry: str, env: str, runs: Sequence[PastRun], scale: Scale | None) -> Generalisation:
    heldout = fmean(run.score for run in runs if run.score is not None)
    selected = [run.selected for run in runs]
    validation = mean_of_all([None if each is None else each.val_mean for each in selected])
    optimism = None if validation is None else validation - heldout
    return Generalisation(
        entry=entry,
        env=env,
        n_runs=len(runs),
        train=mean_of_all([None if each is None else each.mean_return for each in selected]),
        validation=validation,
        heldout=heldout,
        optimism=optimism,
        normalised_optimism=None
        if optimism is None or scale is None
        else optimism / (scale.best - scale.random),
        success=_success(env, runs),
    )


def _success(env: str, runs: Sequence[PastRun]) -> float | None:
    outcomes = [run.record.outcome for run in runs]
    if any(not outcome.heldout_returns for outcome in outcomes):
        return None
    if all(len(outcome.heldout_successes) == len(outcome.heldout_returns) for outcome in outcomes):
        return fmean(fmean(outcome.heldout_successes) for outcome in outcomes)
    above = SUCCESS_ABOVE.get(env, SUCCESS_ABOVE.get(family_of(env)))
    if above is None:
        return None
    return fmean(fmean(value > above for value in outcome.heldout_returns) for outcome in outcomes)
