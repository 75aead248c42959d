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

from evopolicy_common.statistics.intervals import Estimate, of_runs
from evopolicy_results.reading.environments import family_of
from evopolicy_results.reading.records import Run, by_cell
from evopolicy_results.scoring.normalised import Scale

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
    """Share of held-out episodes that reached the goal, as the environment reports it, or else as its returns determine
    it; None if neither does."""


def generalisation(runs: Iterable[Run], scales: Mapping[str, Scale]) -> list[Generalisation]:
    """Every entry on every environment with a completed run, environments in catalogue order."""
    completed = by_cell(run for run in runs if run.score is not None)
    return [_cell(entry, env, several, scales.get(env)) for (env, entry), several in completed.items()]


def optimism(entries: Iterable[str], cells: Sequence[Generalisation]) -> dict[str, Estimate]:
    """By entry, the mean of its normalised optimism with a t interval over environments; without entries that have
    none."""
    known = {entry: [cell.normalised_optimism for cell in cells if cell.entry == entry] for entry in entries}
    values = {entry: [value for value in several if value is not None] for entry, several in known.items()}
    return {entry: of_runs(several) for entry, several in values.items() if several}


def _cell(entry: str, env: str, runs: Sequence[Run], scale: Scale | None) -> Generalisation:
    heldout = fmean(run.score for run in runs if run.score is not None)
    train = mean_of_all([run.selected.mean_return if run.selected is not None else None for run in runs])
    validation = mean_of_all([run.selected.val_mean if run.selected is not None else None for run in runs])
    optimism = None if validation is None else validation - heldout
    width = None if scale is None else scale.best - scale.random
    return Generalisation(
        entry=entry,
        env=env,
        n_runs=len(runs),
        train=train,
        validation=validation,
        heldout=heldout,
        optimism=optimism,
        normalised_optimism=None if optimism is None or width is None else optimism / width,
        success=_success(env, runs),
    )


def mean_of_all(values: Sequence[float | None]) -> float | None:
    """None unless all are known."""
    known = [value for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None


def _success(env: str, runs: Sequence[Run]) -> float | None:
    outcomes = [run.record.outcome for run in runs]
    if any(not outcome.heldout_returns for outcome in outcomes):
        return None
    if all(len(outcome.heldout_successes) == len(outcome.heldout_returns) for outcome in outcomes):
        return fmean(fmean(outcome.heldout_successes) for outcome in outcomes)
    above = SUCCESS_ABOVE.get(env, SUCCESS_ABOVE.get(family_of(env)))
    if above is None:
        return None
    return fmean(fmean(value > above for value in outcome.heldout_returns) for outcome in outcomes)
