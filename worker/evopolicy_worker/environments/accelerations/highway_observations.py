"""highway-env: observations without data frames.

Replaces `observe` of `KinematicsGoal` (parking) and of `Kinematics` (roundabout), which build pandas data frames of one
to five rows, and compute every feature that a vehicle has to keep a few. Here the features that are wanted are computed
alone, by the library's operations, and put into an array. Parking observes four times a step, and weighs the
same difference three times: both are remembered until the vehicle's state changes. Observations with other features, or
in shuffled order, are the library's.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import KinematicObservation, KinematicsGoalObservation
from highway_env.envs.parking_env import ParkingEnv
from highway_env.vehicle.objects import Landmark

from evopolicy_worker.environments.accelerations.specialise import specialise

_GOAL_FEATURES = ["x", "y", "vx", "vy", "cos_h", "sin_h"]
_TRAFFIC_FEATURES = ["presence", "x", "y", "vx", "vy"]


class GoalInScalars(KinematicsGoalObservation):  # type: ignore[misc]
    """Position, velocity and direction of a vehicle and of its goal."""

    _seen: tuple[Any, ...] = ()
    _observation: Any = None

    def observe(self) -> Any:
        vehicle = self.observer_vehicle
        if not vehicle or self.features != _GOAL_FEATURES or type(vehicle.goal) is not Landmark:
            return super().observe()
        position, goal = vehicle.position, vehicle.goal
        # As bits, for zeros of both signs are equal.
        state = (position.tobytes(), float(vehicle.heading).hex(), float(vehicle.speed).hex(), goal)
        if state != self._seen:
            cos, sin = np.cos(vehicle.heading), np.sin(vehicle.heading)
            speed = vehicle.speed
            own = np.array((position[0], position[1], speed * cos, speed * sin, cos, sin))
            there = goal.position
            aim = np.array((there[0], there[1], 0.0, 0.0, np.cos(goal.heading), np.sin(goal.heading)))
            self._observation = OrderedDict(
                observation=own / self.scales, achieved_goal=own / self.scales, desired_goal=aim / self.scales
            )
            self._seen = state
        return self._observation


class TrafficInScalars(KinematicObservation):  # type: ignore[misc]
    """Positions and velocities of a vehicle and of those around it."""

    def observe(self) -> Any:
        if (
            not self.env.road
            or self.features != _TRAFFIC_FEATURES
            or not (self.absolute and self.normalize and self.clip and self.features_range)
            or self.order != "sorted"
        ):
            return super().observe()
        observer = self.observer_vehicle
        others = self.env.road.close_objects_to(
            observer,
            self.env.PERCEPTION_DISTANCE,
            count=self.vehicles_count - 1,
            see_behind=self.see_behind,
            sort=True,
            vehicles_only=not self.include_obstacles,
        )
        rows = np.zeros((self.vehicles_count, len(self.features)))
        for row, vehicle in enumerate([observer, *others[-self.vehicles_count + 1 :]]):
            speed, heading = vehicle.speed, vehicle.heading
            rows[row] = (
                1.0,
                vehicle.position[0],
                vehicle.position[1],
                speed * np.cos(heading),
                speed * np.sin(heading),
            )
        seen = rows[: len(others) + 1]
        for column, feature in enumerate(self.features):
            limits = self.features_range.get(feature)
            if limits is not None:
                low, high = limits
                scaled = -1 + (seen[:, column] - low) * 2 / (high - low)
                seen[:, column] = np.clip(scaled, -1, 1)
        return rows.astype(np.float32)


class ScalarObservations(AbstractEnv):  # type: ignore[misc]
    """An environment whose observations are computed without data frames."""

    def define_spaces(self) -> None:
        super().define_spaces()
        for name in ("observation_type", "observation_type_parking"):
            observation = getattr(self, name, None)
            if type(observation) is KinematicsGoalObservation:
                specialise(observation, GoalInScalars)
            elif type(observation) is KinematicObservation:
                specialise(observation, TrafficInScalars)


class RememberedReward(ParkingEnv):  # type: ignore[misc]
    """Weighs the same observation once: its arrays are not written to, so being the same object is enough."""

    _weighed: tuple[Any, Any, float] = (None, None, 0.0)

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any, p: float = 0.5) -> Any:
        achieved, desired, reward = self._weighed
        if p != 0.5:
            return super().compute_reward(achieved_goal, desired_goal, info, p)
        if achieved is not achieved_goal or desired is not desired_goal:
            reward = super().compute_reward(achieved_goal, desired_goal, info, p)
            self._weighed = (achieved_goal, desired_goal, reward)
        return reward


def accelerate(env: Any) -> None:
    """Observe faster in this bare highway-env environment."""
    specialise(env, ScalarObservations)
    if isinstance(env, ParkingEnv):
        specialise(env, RememberedReward)
