"""Moves a thing to its goal with an effector: by pushing it, or by grasping and carrying it.

Which observation components are the effector's position, and which output moves each, is identified from trajectories
(`plant.py` on the agent's side) and passed as settings. The only knowledge of the task is the goal convention: Dict
observations with `observation`, and `achieved_goal` and `desired_goal`, here positions in space.

Settings: `effector`, per axis the index into `observation`; `outputs`, per axis the output that moves it; `slopes`,
displacement per unit of that output and step; `lift_axis`, the axis along which things are approached from above.
Parameters are exponents of factors (the depth of touch is a length), 0 = the default. Then comes an offset for every
output, which sets outputs that move no axis, such as a gripper's. Lengths are in units of the effector's travel in one
step.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .spaces import GOALS, Given, Vector

FACTOR_RANGE = 3.0
"""Factors lie between 2 to minus this and 2 to this."""


class Mover:
    """Shared by pushing and carrying: reads the observation, and moves the effector to a point."""

    PARAMETERS = 6

    def __init__(self, given: Given, vector: Vector) -> None:
        settings = given.settings
        self._head = given.head
        self._effector = np.array(settings["effector"], dtype=int)
        self._outputs = np.array(settings["outputs"], dtype=int)
        self._slopes = np.array(settings["slopes"], dtype=float)
        self._lift = int(settings["lift_axis"])
        self._step = float(np.abs(self._slopes).mean())
        self._factors = 2.0 ** np.clip(vector[: self.PARAMETERS], -FACTOR_RANGE, FACTOR_RANGE)
        self._speed = float(self._factors[4])
        self._depth = float(self._step * vector[2])
        self._offset = vector[self.PARAMETERS :]

    def _positions(self, obs: Any) -> tuple[Vector, Vector, Vector]:
        """Positions of the thing, its goal, and the effector; each a new float64 vector with one element per axis."""
        thing, goal, observed = (np.array(obs[key], float).reshape(-1) for key in (*GOALS, "observation"))
        return thing, goal, observed[self._effector]

    def _level(self, difference: Vector) -> Vector:
        """The part of `difference` perpendicular to the lift axis."""
        level = difference.copy()
        level[self._lift] = 0.0
        return level

    def _action(self, move: Vector, others: float = 1.0) -> Any:
        """The action for a desired displacement; `others` scales the remaining outputs."""
        outputs = others * self._offset
        outputs[self._outputs] = self._speed * move / self._slopes
        return self._head.action(outputs)


class Pusher(Mover):
    """Moves behind the thing, touches it, and pushes it along the line to the goal.

    Parameters: distance kept behind, clearance, depth of touch, sideways tolerance, speed, goal tolerance.
    """

    def __init__(self, given: Given, vector: Vector) -> None:
        super().__init__(given, vector)
        self._behind = 2.5 * self._step * self._factors[0]
        self._clearance = 2.0 * self._step * self._factors[1]
        self._sideways = 0.7 * self._step * self._factors[3]
        self._near = 0.5 * self._step * self._factors[5]

    def act(self, obs: Any) -> Any:
        thing, goal, effector = self._positions(obs)
        missing = self._level(goal - thing)
        distance = float(np.linalg.norm(missing))
        if distance <= self._near:
            return self._action(np.zeros_like(missing))
        return self._action(self._target(thing, effector, missing / distance, distance) - effector)

    def _target(self, thing: Vector, effector: Vector, way: Vector, distance: float) -> Vector:
        touch = thing.copy()
        touch[self._lift] += self._depth
        offset = self._level(effector - thing)
        along = float(offset @ way)
        beside = float(np.linalg.norm(offset - along * way))
        high = effector[self._lift] - touch[self._lift]
        if along < 0 and beside < self._sideways and high < self._clearance / 2:
            touch += way * min(distance, self._behind)
            return touch
        behind: Vector = touch - way * self._behind
        if float(np.linalg.norm(offset + way * self._behind)) > self._sideways:
            # Pass over the thing, rising first so as not to knock it away.
            if high < self._clearance / 2 and along > -self._behind / 2:
                behind = effector.copy()
            behind[self._lift] = touch[self._lift] + self._clearance
        return behind


class Carrier(Mover):
    """Approaches the thing from above, reverses the other outputs to grasp it, and carries it to the goal.

    Parameters: sideways tolerance, clearance, depth of touch, reach within which to grasp, speed, steps to grasp for.
    """

    def __init__(self, given: Given, vector: Vector) -> None:
        super().__init__(given, vector)
        self._sideways = 0.5 * self._step * self._factors[0]
        self._clearance = 2.0 * self._step * self._factors[1]
        self._reach = 0.5 * self._step * self._factors[3]
        self._grasp_steps = 3.0 * self._factors[5]
        self._held_steps = 0

    def act(self, obs: Any) -> Any:
        thing, goal, effector = self._positions(obs)
        touch = thing.copy()
        touch[self._lift] += self._depth
        reach = float(np.linalg.norm(touch - effector))
        # Once grasped, the thing may slip a little; further away it has been lost.
        if reach < self._reach * (2.0 if self._held_steps else 1.0):
            self._held_steps += 1
            move = goal - thing if self._held_steps > self._grasp_steps else touch - effector
            return self._action(move, others=-1.0)
        self._held_steps = 0
        if float(np.linalg.norm(self._level(touch - effector))) > self._sideways:
            touch[self._lift] += self._clearance
        return self._action(touch - effector)
