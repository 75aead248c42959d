"""Score evolution: the best hidden-validation score so far over the consumed budget (paper, "Post-hoc score
trajectories").

The curve is a step function of the consumed episodes; each level starts at the end of the submit that reached it.
Agents never see it. Scales are per environment: 0 is the random reference of the report's tables (on held-out cases,
the only ones it plays; without it the lowest first score of any run), 1 the best validation score of any run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import msgspec

from evopolicy_results.behaviour.edits import classify
from evopolicy_results.reading.environments import ordered_environments
from evopolicy_results.reading.records import Run


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


def evolutions(runs: Iterable[Run], references: Mapping[str, float]) -> list[Evolution]:
    """Every run's curve, environments in catalogue order, then by entry and run.

    `references`: by environment, the mean return of the random reference, if known.
    """
    by_env: dict[str, list[Run]] = {}
    for run in runs:
        by_env.setdefault(run.env, []).append(run)
    out: list[Evolution] = []
    for env in ordered_environments(by_env):
        group = sorted(by_env[env], key=lambda run: (run.entry.casefold(), run.name))
        curves = [
            tuple(
                CurvePoint(
                    index=t.index, consumed=t.consumed, val_mean=t.val_mean, best=t.best, improved=t.hit
                )
                for t in classify(run.submits)
            )
            for run in group
        ]
        base, top = scale(curves, references.get(env))
        for run, steps in zip(group, curves, strict=True):
            out.append(
                Evolution(
                    run=run.name,
                    entry=run.entry,
                    env=env,
                    budget=run.budget,
                    steps=steps,
                    n_improvements=sum(step.improved for step in steps[1:]),
                    area=area(steps, run.budget, base, top),
                    to_50=episodes_to(steps, 0.5, base, top),
                    to_80=episodes_to(steps, 0.8, base, top),
                )
            )
    return out


def scale(
    curves: Iterable[Sequence[CurvePoint]], reference: float | None
) -> tuple[float | None, float | None]:
    """The returns at 0 and 1 of the environment's scale; both None when no run has a score."""
    scored = [steps for steps in curves if steps]
    if not scored:
        return None, None
    base = min(steps[0].val_mean for steps in scored) if reference is None else reference
    return base, max(steps[-1].best for steps in scored)


def area(steps: Sequence[CurvePoint], budget: int, base: float | None, top: float | None) -> float | None:
    """Time-averaged normalised best score: the integral over episodes 0 … budget, divided by the budget."""
    if base is None or top is None or top <= base or budget <= 0:
        return None
    total = 0.0
    for i, step in enumerate(steps):
        until = steps[i + 1].consumed if i + 1 < len(steps) else budget
        level = min(1.0, max(0.0, (step.best - base) / (top - base)))
        total += level * max(0, until - step.consumed)
    return total / budget


def episodes_to(
    steps: Sequence[CurvePoint], share: float, base: float | None, top: float | None
) -> int | None:
    """Episodes consumed when the best score first reaches `base + share · (top − base)`; None if it never does."""
    if base is None or top is None or top <= base:
        return None
    goal = base + share * (top - base)
    return next((step.consumed for step in steps if step.best >= goal), None)


def best_at(steps: Sequence[CurvePoint], consumed: int) -> float:
    """The curve's value at `consumed` episodes. Raises ValueError before its first score."""
    reached = [step.best for step in steps if step.consumed <= consumed]
    if not reached:
        raise ValueError(
            f"no score by {consumed} episodes; the first is at {steps[0].consumed if steps else None}"
        )
    return reached[-1]
