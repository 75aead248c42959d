"""Brings a thing to its goal with an effector that the actions move: get behind it, touch it, push along the line.

Which observation components are the effector's position, and which action moves each, is found from trajectories
(`plant.py` on the agent's side) and comes as settings; nothing is known of the task but the goal convention.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .spaces import ActionHead, Vector, goal_error


class Pusher:
    """A controller for Dict observations with `observation`, `achieved_goal` and `desired_goal`.

    Settings: `effector`, per goal axis the index into `observation`; `outputs`, per goal axis the output that moves it;
    `slopes`, displacement per unit of that output and step; `lift_axis`, the axis along which to pass over the thing.
    Parameters, as factors around 0 = the default: distance kept behind, clearance, depth of touch, sideways tolerance,
    speed, goal tolerance; then an offset for every output (what the others do meanwhile, such as a gripper).
    Lengths are in units of the effector's travel in one step.
    """

    PARAMETERS = 6

    def __init__(self, head: ActionHead, vector: Vector, settings: dict[str, Any]) -> None:
        self._head = head
        self._effector = np.array(settings["effector"], dtype=int)
        self._outputs = np.array(settings["outputs"], dtype=int)
        self._slopes = np.array(settings["slopes"], dtype=float)
        self._lift = int(settings["lift_axis"])
        step = float(np.abs(self._slopes).mean())
        factors = 2.0 ** np.clip(vector[: self.PARAMETERS], -3, 3)
        self._behind = 2.5 * step * factors[0]
        self._clearance = 2.0 * step * factors[1]
        self._depth = step * vector[2]
        self._sideways = 0.7 * step * factors[3]
        self._speed = factors[4]
        self._near = 0.5 * step * factors[5]
        self._offset = vector[self.PARAMETERS :]

    def act(self, obs: Any) -> Any:
        thing = np.asarray(obs["achieved_goal"], dtype=float).reshape(-1)
        effector = np.asarray(obs["observation"], dtype=float).reshape(-1)[self._effector]
        missing = goal_error(obs)
        missing[self._lift] = 0.0
        distance = float(np.linalg.norm(missing))
        outputs = self._offset.copy()
        outputs[self._outputs] = 0.0
        if distance > self._near:
            move = self._target(thing, effector, missing / distance, distance) - effector
            outputs[self._outputs] = self._speed * move / self._slopes
        return self._head.action(outputs)

    def _target(self, thing: Vector, effector: Vector, way: Vector, distance: float) -> Vector:
        """Where the effector should go next."""
        touch = thing.copy()
        touch[self._lift] += self._depth
        offset = effector - thing
        offset[self._lift] = 0.0
        along = float(offset @ way)
        beside = float(np.linalg.norm(offset - along * way))
        high = effector[self._lift] - touch[self._lift]
        if along < 0 and beside < self._sideways and high < self._clearance / 2:
            touch += way * min(distance, self._behind)
            return touch
        behind: Vector = touch - way * self._behind
        if float(np.linalg.norm(offset + way * self._behind)) > self._sideways:
            # Pass over the thing, rising first so as not to knock it away.
            behind[self._lift] += self._clearance
            if high < self._clearance / 2 and along > -self._behind / 2:
                behind = effector.copy()
                behind[self._lift] = touch[self._lift] + self._clearance
        return behind
