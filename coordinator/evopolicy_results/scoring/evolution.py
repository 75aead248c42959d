"""Score evolution: the best hidden-validation score so far over the consumed budget (paper, "Post-hoc score
trajectories").

The curve is a step function of the consumed episodes; each level starts at the end of the submit that reached it.
Agents never see it. Scales are per environment: 0 is the random reference of the report's tables (on held-out cases,
the only ones it plays; without it the lowest first score of any run), 1 the best validation score of any run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest

import msgspec

from evopolicy_results.behaviour.edits import classify
from evopolicy_results.reading.environments import grouped, ordered_environments
from evopolicy_results.reading.records import PastRun
from evopolicy_results.scoring.scores import Scale, scale_between


class CurvePoint(msgspec.Struct, frozen=True, kw_only=True):
    """The curve after one score-bearing submit."""

    index: int
    consumed: int
    """Budget consumed after it, episodes."""
    val_mean: float
    best: float
    improved: bool
    """Whether it raised the best score; always true for the first."""


class Evolution(msgspec.Struct, frozen=True, kw_only=True):
    """One run's curve and its efficiency measures."""

    run: str
    entry: str
    env: str
    policy: str
    """Digest of the selected policy's bundle; empty if unknown."""
    budget: int
    steps: tuple[CurvePoint, ...]
    n_improvements: int
    """Number of rises after the first score."""
    area: float | None
    """Mean of the curve over the budget on the environment's scale, clipped to [0, 1]; 0 before the first score. None
    without a scale (no score beats random)."""
    to_50: int | None
    """Episodes consumed when the curve first reaches half of the scale; None if it never does."""
    to_80: int | None


def evolutions(runs: Iterable[PastRun], references: Mapping[str, float]) -> list[Evolution]:
    """Every run's curve, environments in catalogue order, then by entry and run. `references`: by environment, the mean
    return of the random reference, if known."""
    by_env = grouped(runs, lambda run: run.env)
    out: list[Evolution] = []
    for env in ordered_environments(by_env):
        group = sorted(by_env[env], key=lambda run: (run.entry.casefold(), run.name))
        curves = [_curve(run) for run in group]
        scored = [steps for steps in curves if steps]
        first = min((steps[0].val_mean for steps in scored), default=None)
        top = max((steps[-1].best for steps in scored), default=None)
        scale = scale_between(references.get(env, first), top)
        out += [
            Evolution(
                run=run.name,
                entry=run.entry,
                env=env,
                policy=run.policy,
                budget=run.budget,
                steps=steps,
                n_improvements=sum(step.improved for step in steps[1:]),
                area=area(steps, run.budget, scale),
                to_50=episodes_to(steps, 0.5, scale),
                to_80=episodes_to(steps, 0.8, scale),
            )
            for run, steps in zip(group, curves, strict=True)
        ]
    return out


def _curve(run: PastRun) -> tuple[CurvePoint, ...]:
    return tuple(
        CurvePoint(index=t.index, consumed=t.consumed, val_mean=t.val_mean, best=t.best, improved=t.hit)
        for t in classify(run.submits)
    )


def area(steps: Sequence[CurvePoint], budget: int, scale: Scale | None) -> float | None:
    """Time-averaged normalised best score: the integral over episodes 0 … budget, divided by the budget."""
    if scale is None or budget <= 0:
        return None
    total = 0.0
    for step, after in zip_longest(steps, steps[1:]):
        until = budget if after is None else after.consumed
        total += scale.clipped(step.best) * max(0, until - step.consumed)
    return total / budget


def episodes_to(steps: Sequence[CurvePoint], share: float, scale: Scale | None) -> int | None:
    """Episodes consumed when the best score first reaches `share` of the scale; None if it never does."""
    if scale is None:
        return None
    goal = scale.random + share * (scale.best - scale.random)
    return next((step.consumed for step in steps if step.best >= goal), None)


def best_at(steps: Sequence[CurvePoint], consumed: int) -> float:
    """The curve's value at `consumed` episodes. Raises ValueError before its first score."""
    reached = [step.best for step in steps if step.consumed <= consumed]
    if not reached:
        raise ValueError(
            f"no score by {consumed} episodes; the first is at {steps[0].consumed if steps else None}"
        )
    return reached[-1]
