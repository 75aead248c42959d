"""Identifies the plant from trajectories: the effect of actions on observations, for controllers that move objects.

An effector's coordinate is a component of `observation` whose step-to-step change follows one output, and whose values
are near those of the achieved goal on that axis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_gateway.agents.evolve.evolved.spaces import Schema, goal_keys
from evopolicy_gateway.agents.evolve.feedback import Step

N_AXES = 3
"""Goals with this many elements count as positions: in a plane the effector could not pass over things."""
MIN_STEPS = 40
MIN_CORRELATION = 0.5
REACTION_STEPS = 2
"""An action's effect is measured as the displacement over this many steps."""


def find_plant(obs_space: Schema, action_space: Schema, episodes: list[list[Step]]) -> dict[str, Any] | None:
    """Settings for the `pusher` and `carrier` controllers; None if spaces or trajectories do not determine them."""
    if not goal_keys(obs_space) or action_space["type"] != "Box":
        return None
    n_axes = math.prod(obs_space["spaces"]["desired_goal"]["shape"])
    if n_axes != N_AXES or math.prod(action_space["shape"]) < n_axes:
        return None
    long_enough = [steps for steps in episodes if len(steps) > REACTION_STEPS + 1]
    if sum(map(len, long_enough)) < MIN_STEPS:
        return None
    observed, achieved, desired, displacement, actions = _stack(long_enough)
    correlation = _correlations(displacement, actions)
    axes = _match_axes(correlation, observed, achieved, desired)
    if axes is None:
        return None
    effector = [component for component, _ in axes]
    outputs = [output for _, output in axes]
    slopes = [_slope(displacement[:, c], actions[:, o]) / REACTION_STEPS for c, o in axes]
    lift_axis = _lift_axis(achieved, float(np.abs(slopes).mean()))
    return {"effector": effector, "outputs": outputs, "slopes": slopes, "lift_axis": lift_axis}


Rows = NDArray[np.float64]


def _stack(episodes: list[list[Step]]) -> tuple[Rows, Rows, Rows, Rows, Rows]:
    """Rows of observation, achieved and desired goal, displacement and mean action over the reaction time."""
    parts: list[list[Rows]] = [[], [], [], [], []]
    k = REACTION_STEPS
    for steps in episodes:
        seen = [np.array([np.ravel(s.obs[key]) for s in steps], dtype=float) for key in _KEYS]
        acted = np.array([np.ravel(s.action) for s in steps], dtype=float)
        for part, rows in zip(
            parts, [*(rows[:-k] for rows in seen), seen[0][k:] - seen[0][:-k]], strict=False
        ):
            part.append(rows)
        parts[4].append(np.mean([acted[i : len(acted) - k + i] for i in range(k)], axis=0))
    observed, achieved, desired, displacement, actions = (np.concatenate(part) for part in parts)
    return observed, achieved, desired, displacement, actions


_KEYS = ("observation", "achieved_goal", "desired_goal")


def _correlations(displacement: Rows, actions: Rows) -> Rows:
    """Absolute correlation of every component's displacement with every output, shape (components, outputs)."""
    d = displacement - displacement.mean(axis=0)
    a = actions - actions.mean(axis=0)
    scale = np.outer(np.linalg.norm(d, axis=0), np.linalg.norm(a, axis=0))
    correlation: Rows = np.abs(d.T @ a) / np.maximum(scale, 1e-12)
    return correlation


def _lift_axis(achieved: Rows, step: float) -> int:
    """The axis along which the disturbed thing moved least, as it rests on something. If it did not move, the last
    axis."""
    moved = np.ptp(achieved, axis=0)
    return int(np.argmin(moved)) if moved.max() > max(step / 2, 3 * moved.min()) else N_AXES - 1


def _match_axes(
    correlation: Rows, observed: Rows, achieved: Rows, desired: Rows
) -> list[tuple[int, int]] | None:
    """Per goal axis, the observation component and the output that moves along it; None when an axis has none."""
    reach = np.maximum(np.ptp(observed, axis=0), np.abs(desired - achieved).max())
    axes: list[tuple[int, int]] = []
    for axis in range(achieved.shape[1]):
        far = np.abs(observed.mean(axis=0) - achieved[:, axis].mean())
        # A component that repeats the achieved goal is the object, not the effector.
        same = np.abs(observed - achieved[:, axis : axis + 1]).mean(axis=0) < 1e-9
        taken = [component for component, _ in axes]
        able = (correlation.max(axis=1) > MIN_CORRELATION) & (far < 2 * reach) & ~same
        able[taken] = False
        if not able.any():
            return None
        component = int(np.argmin(np.where(able, far, np.inf)))
        axes.append((component, int(np.argmax(correlation[component]))))
    return axes if len({output for _, output in axes}) == len(axes) else None


def _slope(displacement: Rows, action: Rows) -> float:
    centred = action - action.mean()
    return float(centred @ displacement / max(float(centred @ centred), 1e-12)) or 1e-6
