"""highway-env: observations without data frames.

Replaces `observe` of `KinematicsGoal` (parking), `Kinematics` and `ExitObservation`, which build pandas data
frames of a few rows and compute every feature to keep some. Here the wanted features alone are computed, by
the library's operations, and put into an array. Parking observes four times a step, and weighs the same
difference three times: both are remembered until the vehicle's state changes.

`OccupancyGrid` (racetracks) also goes along every lane, point by point, to find the cells with a road. Only
cells count, so points are estimated, in arrays, with an error far below DOUBT; a point so near to a cell's
edge goes to the library. Lanes that lie beyond the grid have no cell. `TimeToCollision` computes for each
speed and margin what depends on neither. Observations of other kinds or features are the library's.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from types import FunctionType
from typing import Any

import numpy as np
from highway_env.envs.common import observation
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import (
    ExitObservation,
    KinematicObservation,
    KinematicsGoalObservation,
    OccupancyGridObservation,
    TimeToCollisionObservation,
)
from highway_env.envs.parking_env import ParkingEnv
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark

from evopolicy_worker.environments.accelerations.highway_shared import not_zero
from evopolicy_worker.environments.accelerations.specialise import specialise

_GOAL_FEATURES = ["x", "y", "vx", "vy", "cos_h", "sin_h"]
_GRID_FEATURES = ["presence", "on_road"]
_OFFSETS = {"long_off", "lat_off", "ang_off"}
DOUBT = 1e-6
"""Share of a cell; far more than the error of an estimate."""


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
            own = np.array((*position, speed * cos, speed * sin, cos, sin))
            aim = np.array((*goal.position, 0.0, 0.0, np.cos(goal.heading), np.sin(goal.heading)))
            self._observation = OrderedDict(
                observation=own / self.scales, achieved_goal=own / self.scales, desired_goal=aim / self.scales
            )
            self._seen = state
        return self._observation


def _row(thing: Any, features: list[str], origin: Any, intentions: bool) -> list[float]:
    """The features of a vehicle or an object, relative to `origin` where it is given."""
    if not isinstance(thing, Vehicle):
        known = thing.to_dict(origin, intentions)
        return [known.get(feature, np.nan) for feature in features]
    cos, sin = np.cos(thing.heading), np.sin(thing.heading)
    known = {"presence": 1.0, "heading": thing.heading, "cos_h": cos, "sin_h": sin}
    known |= {
        "x": thing.position[0],
        "y": thing.position[1],
        "vx": thing.speed * cos,
        "vy": thing.speed * sin,
    }
    if "cos_d" in features or "sin_d" in features:
        known["cos_d"], known["sin_d"] = thing.destination_direction if intentions else (0.0, 0.0)
    if not _OFFSETS.isdisjoint(features):
        known |= zip(("long_off", "lat_off", "ang_off"), thing.lane_offset, strict=True)
    if origin is not None:
        relative = ["x", "y", "vx", "vy"]
        for feature, value in zip(relative, _row(origin, relative, None, True), strict=True):
            known[feature] -= value
    return [known[feature] for feature in features]


class TrafficInScalars(KinematicObservation):  # type: ignore[misc]
    """Features of a vehicle and of those around it."""

    def observe(self) -> Any:
        # The library's own call sets the ranges that are not configured.
        if not self.env.road or (self.normalize and not self.features_range):
            return super().observe()
        features, observer = self.features, self.observer_vehicle
        leaves = isinstance(self, ExitObservation)
        others = self.env.road.close_objects_to(
            observer,
            self.env.PERCEPTION_DISTANCE,
            count=self.vehicles_count - 1,
            see_behind=self.see_behind,
            sort=leaves or self.order == "sorted",
            vehicles_only=leaves or not self.include_obstacles,
        )
        origin = None if self.absolute else observer
        rows = np.zeros((self.vehicles_count, len(features)))
        rows[0] = _row(observer, features, None, True)
        if leaves:
            exit_lane = self.env.road.network.get_lane(("1", "2", -1))
            rows[0, features.index("x")] = exit_lane.local_coordinates(observer.position)[0]
        for row, thing in enumerate(others[-self.vehicles_count + 1 :], 1):
            rows[row] = _row(thing, features, origin, self.observe_intentions)
        seen = rows[: len(others) + 1]
        for feature, (low, high) in self.features_range.items() if self.normalize else ():
            if feature in features:
                column = features.index(feature)
                scaled = -1 + (seen[:, column] - low) * 2 / (high - low)
                seen[:, column] = np.clip(scaled, -1, 1) if self.clip else scaled
        if self.order == "shuffled":
            self.env.np_random.shuffle(rows[1:])
        return rows.astype(np.float32)


class GridInScalars(OccupancyGridObservation):  # type: ignore[misc]
    """Cells around a vehicle that hold a vehicle, or a road."""

    def observe(self) -> Any:
        usual = self.features == _GRID_FEATURES and not self.absolute and not self.as_image
        ranges = not {"presence", "x", "y"}.isdisjoint(self.features_range or ())
        if not self.env.road or not usual or ranges:
            return super().observe()
        self.grid.fill(np.nan)
        observer = self.observer_vehicle
        for vehicle in reversed(self.env.road.vehicles):
            place = tuple(vehicle.position - observer.position)
            self._fill(0, *self.pos_to_index(place, relative=True))
        self.fill_road_layer_by_lanes(1)
        grid = np.clip(self.grid, -1, 1) if self.clip else self.grid
        return np.nan_to_num(grid).astype(np.float32)

    def _fill(self, layer: int, i: int, j: int) -> None:
        if 0 <= i < self.grid.shape[-2] and 0 <= j < self.grid.shape[-1]:
            self.grid[layer, i, j] = 1

    def fill_road_layer_by_lanes(self, layer_index: int, lane_perception_distance: float = 100) -> None:
        # Only cells count, so places are estimated; where one is at the edge of a cell, the library decides.
        x, y = map(float, self.observer_vehicle.position)
        heading = self.observer_vehicle.heading if self.align_to_vehicle_axes else 0.0
        cos, sin = math.cos(heading), math.sin(heading)
        (low_x, high_x), (low_y, high_y) = self.grid_size
        # The grid's corners are no further.
        reach = math.hypot(max(-low_x, high_x), max(-low_y, high_y)) + 1
        spacing, (n_rows, n_columns) = np.amin(self.grid_step), self.grid.shape[-2:]
        for lane in self.env.road.network.lanes_list():
            disc = _disc(lane)
            if disc is not None and math.hypot(x - disc[0], y - disc[1]) > disc[2] + reach:
                continue
            origin, _ = lane.local_coordinates(self.observer_vehicle.position)
            ends = origin - lane_perception_distance, origin + lane_perception_distance
            ways = np.arange(*ends, spacing).clip(0, lane.length)
            if disc is None:
                doubtful = np.ones(len(ways), bool)
            else:
                if isinstance(lane, CircularLane):
                    phi = lane.direction * ways / lane.radius + lane.start_phase
                    dx = lane.center[0] + lane.radius * np.cos(phi) - x
                    dy = lane.center[1] + lane.radius * np.sin(phi) - y
                else:
                    dx = lane.start[0] + ways * lane.direction[0] - x
                    dy = lane.start[1] + ways * lane.direction[1] - y
                i = (cos * dx + sin * dy - low_x) / self.grid_step[0]
                j = (cos * dy - sin * dx - low_y) / self.grid_step[1]
                near = (abs(2 * i - n_rows) < n_rows + 1) & (abs(2 * j - n_columns) < n_columns + 1)
                i, j, ways = i[near], j[near], ways[near]
                doubtful = (abs(i - i.round()) < DOUBT) | (abs(j - j.round()) < DOUBT)
                for row, column in zip(i[~doubtful], j[~doubtful], strict=True):
                    self._fill(layer_index, math.floor(row), math.floor(column))
            for way in ways[doubtful]:
                self._fill(layer_index, *self.pos_to_index(lane.position(way, 0)))


def _disc(lane: Any) -> tuple[float, float, float] | None:
    """Centre and radius of a disc that holds the lane's middle; None for a kind that is not known."""
    if isinstance(lane, CircularLane):
        return float(lane.center[0]), float(lane.center[1]), float(lane.radius)
    if isinstance(lane, StraightLane) and not isinstance(lane, SineLane):
        (x, y), (end_x, end_y) = lane.start, lane.end
        return float(x + end_x) / 2, float(y + end_y) / 2, float(lane.length) / 2
    return None


def _collisions(env: Any, time_quantization: float, horizon: float, vehicle: Any = None) -> Any:
    """`compute_ttc_grid`: what does not depend on the speed is computed once for each vehicle."""
    vehicle = vehicle or env.vehicle
    network = env.road.network
    n_lanes = len(network.all_side_lanes(env.vehicle.lane_index))
    n_own = len(network.all_side_lanes(vehicle.lane_index))
    grid = np.zeros((vehicle.target_speeds.size, n_lanes, int(horizon / time_quantization)))
    speeds = [vehicle.index_to_speed(index) for index in range(grid.shape[0])]
    for other in env.road.vehicles:
        if other is vehicle or not network.is_connected_road(
            vehicle.lane_index, other.lane_index, route=vehicle.route, depth=3
        ):
            continue
        margin = other.LENGTH / 2 + vehicle.LENGTH / 2
        distance = vehicle.lane_distance_to(other)
        projected = other.speed * np.dot(other.direction, vehicle.direction)
        same = len(network.all_side_lanes(other.lane_index)) == n_own
        lanes = [other.lane_index[2]] if same else range(n_lanes)
        for index, speed in enumerate(speeds):
            for ahead, cost in ((0, 1), (-margin, 0.5), (margin, 0.5)) if speed != other.speed else ():
                time = (distance + ahead) / not_zero(speed - projected)
                if time < 0:
                    continue
                for at in (int(time / time_quantization), int(np.ceil(time / time_quantization))):
                    if 0 <= at < grid.shape[2]:
                        grid[index, lanes, at] = np.maximum(grid[index, lanes, at], cost)
    return grid


class TimesOnce(TimeToCollisionObservation):  # type: ignore[misc]
    """Times to collisions, by the library's method with the function above."""

    observe = FunctionType(
        TimeToCollisionObservation.observe.__code__, {**vars(observation), "compute_ttc_grid": _collisions}
    )


_KINDS = {
    KinematicsGoalObservation: GoalInScalars,
    KinematicObservation: TrafficInScalars,
    ExitObservation: TrafficInScalars,
    OccupancyGridObservation: GridInScalars,
    TimeToCollisionObservation: TimesOnce,
}


class ScalarObservations(AbstractEnv):  # type: ignore[misc]
    """An environment whose observations are computed without data frames."""

    def define_spaces(self) -> None:
        super().define_spaces()
        kinds = [getattr(self, name, None) for name in ("observation_type", "observation_type_parking")]
        for each in (*kinds, *getattr(kinds[0], "agents_observation_types", ())):
            if type(each) in _KINDS:
                specialise(each, _KINDS[type(each)])


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
    specialise(env, ScalarObservations)
    if isinstance(env, ParkingEnv):
        specialise(env, RememberedReward)
