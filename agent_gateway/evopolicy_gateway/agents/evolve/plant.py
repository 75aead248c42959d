"""Identifies the plant from trajectories: the effect of actions on observations, for controllers that move objects.

An effector's coordinate is a component of `observation` whose step-to-step change follows one output, and whose values
are near those of the achieved goal on that axis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_gateway.agents.evolve.evolved.spaces import GOALS, Schema, goal_keys
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
    centred = actions - actions.mean(axis=0)
    shifts = displacement - displacement.mean(axis=0)
    scale = np.outer(np.linalg.norm(shifts, axis=0), np.linalg.norm(centred, axis=0))
    axes = _match_axes(np.abs(shifts.T @ centred) / np.maximum(scale, 1e-12), observed, achieved, desired)
    if axes is None:
        return None
    slopes = [_slope(displacement[:, c], actions[:, o]) / REACTION_STEPS for c, o in axes]
    moved = np.ptp(achieved, axis=0)
    # The disturbed thing moved least along the lift axis, as it rests on something.
    disturbed = moved.max() > max(float(np.abs(slopes).mean()) / 2, 3 * moved.min())
    return {
        "effector": [component for component, _ in axes],
        "outputs": [output for _, output in axes],
        "slopes": slopes,
        "lift_axis": int(np.argmin(moved)) if disturbed else N_AXES - 1,
    }


Rows = NDArray[np.float64]


def _stack(episodes: list[list[Step]]) -> tuple[Rows, Rows, Rows, Rows, Rows]:
    """Rows of observation, achieved and desired goal, displacement and mean action over the reaction time."""
    parts: list[tuple[Rows, ...]] = []
    k = REACTION_STEPS
    for steps in episodes:
        seen = [np.array([np.ravel(s.obs[key]) for s in steps], float) for key in ("observation", *GOALS)]
        acted = np.array([np.ravel(s.action) for s in steps], dtype=float)
        mean_action = np.mean([acted[i : len(acted) - k + i] for i in range(k)], axis=0)
        parts.append((*(rows[:-k] for rows in seen), seen[0][k:] - seen[0][:-k], mean_action))
    observed, achieved, desired, displacement, actions = map(np.concatenate, zip(*parts, strict=True))
    return observed, achieved, desired, displacement, actions


def _match_axes(
    correlation: Rows, observed: Rows, achieved: Rows, desired: Rows
) -> list[tuple[int, int]] | None:
    """Per goal axis, the observation component and the output that moves along it; None when an axis has none.

    `correlation`: absolute, of every component's displacement with every output, shape (components, outputs)."""
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
