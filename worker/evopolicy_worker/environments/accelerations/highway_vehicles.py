"""highway-env: the vehicles' controllers and kinematics in scalars, and their neighbours in order.

Replaces `Vehicle.step`; of controlled vehicles also `steering_control` and what `act` does around it; of IDM
vehicles also `act`, `acceleration` and `desired_gap`. The library makes small arrays and calls numpy's `clip`
for single numbers. Here the same operations are made in the same order on Python floats; trigonometric
functions, powers and dot products stay numpy's (see `highway_shared`). Vehicles that appear later are
replaced before they act.

Replaces `Road.neighbour_vehicles`, which asks every vehicle for its place on the lane. No vehicle moves while
all decide, so the places on a lane are computed and sorted once. Of rules of priority, `is_conflict_possible`
predicts the ways of two vehicles for each pair: here each way once.
"""

from __future__ import annotations

import copy
from bisect import bisect_left
from operator import itemgetter
from types import FunctionType, MethodType, SimpleNamespace
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road
from highway_env.vehicle import kinematics
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark

from evopolicy_worker.environments.accelerations.highway_lanes import Remembering
from evopolicy_worker.environments.accelerations.highway_shared import (
    DOUBT,
    PI,
    clip,
    not_zero,
    prepare,
    wrap,
)
from evopolicy_worker.environments.accelerations.specialise import specialise


def _advance(vehicle: Any, dt: float) -> None:
    """`Vehicle.step`."""
    vehicle.clip_actions()
    beta = float(np.arctan(0.5 * np.tan(vehicle.action["steering"])))
    speed, heading, position = float(vehicle.speed), float(vehicle.heading), vehicle.position
    course = heading + beta
    position[0] += speed * float(np.cos(course)) * dt
    position[1] += speed * float(np.sin(course)) * dt
    if vehicle.impact is not None:
        vehicle.position += vehicle.impact
        vehicle.crashed = True
        vehicle.impact = None
    vehicle.heading = heading + speed * float(np.sin(beta)) / (vehicle.LENGTH / 2) * dt
    vehicle.speed = speed + vehicle.action["acceleration"] * dt
    vehicle.on_state_update()


class ScalarControlled(ControlledVehicle):  # type: ignore[misc]
    """A vehicle that follows lanes."""

    def step(self, dt: float) -> None:
        _advance(self, dt)

    def steering_control(self, target_lane_index: Any) -> float:
        lane = self.road.network.get_lane(target_lane_index)
        longitudinal, lateral = lane.local_coordinates(self.position)
        speed = float(self.speed)
        future_heading = lane.heading_at(longitudinal + speed * self.TAU_PURSUIT)
        nonzero_speed = not_zero(speed)
        lateral_command = -self.KP_LATERAL * lateral
        heading_command = float(np.arcsin(clip(lateral_command / nonzero_speed, -1.0, 1.0)))
        heading_reference = future_heading + clip(heading_command, -PI / 4, PI / 4)
        rate_command = self.KP_HEADING * wrap(heading_reference - float(self.heading))
        slip = float(np.arcsin(clip(self.LENGTH / 2 / nonzero_speed * rate_command, -1.0, 1.0)))
        steering = float(np.arctan(2 * np.tan(slip)))
        return clip(steering, -self.MAX_STEERING_ANGLE, self.MAX_STEERING_ANGLE)


class ScalarIDM(ScalarControlled, IDMVehicle):  # type: ignore[misc]
    def step(self, dt: float) -> None:
        self.timer += dt
        _advance(self, dt)

    def act(self, action: Any = None) -> None:
        if self.crashed:
            return
        self.follow_road()
        if self.enable_lane_change:
            self.change_lane_policy()
        steering = self.steering_control(self.target_lane_index)
        front, rear = self.road.neighbour_vehicles(self, self.lane_index)
        acceleration = self.acceleration(ego_vehicle=self, front_vehicle=front, rear_vehicle=rear)
        if self.lane_index != self.target_lane_index:
            front, rear = self.road.neighbour_vehicles(self, self.target_lane_index)
            target = self.acceleration(ego_vehicle=self, front_vehicle=front, rear_vehicle=rear)
            acceleration = min(acceleration, target)
        Vehicle.act(
            self, {"steering": steering, "acceleration": clip(acceleration, -self.ACC_MAX, self.ACC_MAX)}
        )

    def acceleration(self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None) -> float:
        # As vehicles alone have; to ask for the class takes longer.
        if not hasattr(ego_vehicle, "action"):
            return 0
        target_speed = float(getattr(ego_vehicle, "target_speed", 0))
        lane = ego_vehicle.lane
        if lane and lane.speed_limit is not None:
            target_speed = clip(target_speed, 0.0, lane.speed_limit)
        ratio = max(float(ego_vehicle.speed), 0) / abs(not_zero(target_speed))
        acceleration = float(self.COMFORT_ACC_MAX * (1 - np.power(ratio, self.DELTA)))
        if front_vehicle:
            gap = ego_vehicle.lane_distance_to(front_vehicle)
            desired = self.desired_gap(ego_vehicle, front_vehicle)
            acceleration -= float(self.COMFORT_ACC_MAX * np.power(desired / not_zero(gap), 2))
        return acceleration

    def desired_gap(self, ego_vehicle: Any, front_vehicle: Any = None, projected: bool = True) -> float:
        speed = float(ego_vehicle.speed)
        if projected:
            front_speed, front_heading = float(front_vehicle.speed), front_vehicle.heading
            cos, sin = np.cos(ego_vehicle.heading), np.sin(ego_vehicle.heading)
            x = speed * cos - front_speed * np.cos(front_heading)
            y = speed * sin - front_speed * np.sin(front_heading)
            approach = float(np.array((x, y)).dot(np.array((cos, sin))))
        else:
            approach = speed - float(front_vehicle.speed)
        braking = -self.COMFORT_ACC_MAX * self.COMFORT_ACC_MIN
        return float(
            self.DISTANCE_WANTED + speed * self.TIME_WANTED + speed * approach / (2 * np.sqrt(braking))
        )


class ScalarRoad(Road):  # type: ignore[misc]
    """A road that is searched for neighbours. While its vehicles decide, what is on a lane is sorted once."""

    _sorted: dict[Any, tuple[list[float], list[Any]]] | None = None
    _things: list[tuple[Any, Any, float, float]]

    def act(self) -> None:
        for vehicle in self.vehicles:
            quicken(vehicle)
        self._sorted = {}
        super().act()
        self._sorted = None

    def _note_places(self) -> None:
        things = self.vehicles + [each for each in self.objects if not isinstance(each, Landmark)]
        self._things = [(each, each.position, *each.position.tolist()) for each in things]

    def neighbour_vehicles(self, vehicle: Any, lane_index: Any = None) -> tuple[Any, Any]:
        lane_index = lane_index or vehicle.lane_index
        if not lane_index:
            return None, None
        s = self.network.get_lane(lane_index).local_coordinates(vehicle.position)[0]
        known = {} if self._sorted is None else self._sorted
        if not known:
            self._note_places()
        if lane_index not in known:
            known[lane_index] = self._along(lane_index)
        places, things = known[lane_index]
        # In front the nearest, of several at one place the last; behind the nearest, of several the first.
        front = rear = None
        s_front = s_rear = s
        at = begin = bisect_left(places, s)
        while at < len(places) and (front is None or places[at] == s_front):
            if things[at] is not vehicle:
                front, s_front = things[at], places[at]
            at += 1
        at = begin - 1
        while at >= 0 and (rear is None or places[at] == s_rear):
            if things[at] is not vehicle:
                rear, s_rear = things[at], places[at]
            at -= 1
        return front, rear

    def _along(self, lane_index: Any) -> tuple[list[float], list[Any]]:
        """Places along the lane, and along those that join it if asked for, with what is there, in order."""
        lane, graph = self.network.get_lane(lane_index), self.network.graph
        lanes = [(lane, 0.0)]
        if self.neighbour_vehicles_connected_lanes:
            begin, end, k = lane_index
            after = [each[k] if k < len(each) else each[0] for each in graph.get(end, {}).values() if each]
            joined = [ends[begin] for ends in graph.values() if ends.get(begin)]
            before = [each[k] if k < len(each) else each[0] for each in joined]
            lanes += [*((each, lane.length) for each in after), *((each, -each.length) for each in before)]
        along = []
        for thing, position, x, y in self._things:
            for each, offset in lanes:
                remembers = isinstance(each, Remembering)
                s, lateral = each.at(position, x, y) if remembers else each.local_coordinates(position)
                if -each.VEHICLE_LENGTH <= s < each.length + each.VEHICLE_LENGTH and (
                    abs(lateral) <= each.width_at(s) / 2 + 1
                ):
                    along.append((s + offset, thing))
                    break
        along.sort(key=itemgetter(0))
        return [s for s, _ in along], [thing for _, thing in along]


class ScalarCrossing(ScalarRoad, RegulatedRoad):  # type: ignore[misc]
    """A road with rules of priority: the way of each vehicle is predicted once for all others."""

    _ways: dict[int, list[tuple[Any, float]]]

    def enforce_road_rules(self) -> None:
        self._ways = {}
        super().enforce_road_rules()

    def is_conflict_possible(self, v1: Any, v2: Any, horizon: int = 3, step: float = 0.25) -> bool:
        for (place_1, heading_1), (place_2, heading_2) in zip(
            self._way(v1, horizon, step), self._way(v2, horizon, step), strict=False
        ):
            dx, dy = float(place_2[0] - place_1[0]), float(place_2[1] - place_1[1])
            if dx * dx + dy * dy > (v1.LENGTH + DOUBT) ** 2 or np.linalg.norm(place_2 - place_1) > v1.LENGTH:
                continue
            if utils.rotated_rectangles_intersect(
                (place_1, 1.5 * v1.LENGTH, 0.9 * v1.WIDTH, heading_1),
                (place_2, 1.5 * v2.LENGTH, 0.9 * v2.WIDTH, heading_2),
            ):
                return True
        return False

    def _way(self, vehicle: Any, horizon: int, step: float) -> list[tuple[Any, float]]:
        way = self._ways.get(id(vehicle))
        if way is None:
            alone = type(vehicle) is BicycleVehicle
            predict = _ALONE if alone else type(vehicle).predict_trajectory_constant_speed
            way = list(zip(*predict(vehicle, np.arange(step, horizon, step)), strict=False))
            self._ways[id(vehicle)] = way
        return way


# The library copies the vehicle with its whole world. A `BicycleVehicle` changes nothing in place.
_ALONE = FunctionType(
    Vehicle.predict_trajectory_constant_speed.__code__,
    {**vars(kinematics), "copy": SimpleNamespace(deepcopy=copy.copy)},
)
_KINDS: dict[type[Any], type[Any]] = {MDPVehicle: ScalarControlled, IDMVehicle: ScalarIDM}


def _make_road_scalar(env: Any) -> None:
    specialise(env.road, ScalarCrossing if isinstance(env.road, RegulatedRoad) else ScalarRoad)


def _quicken_all(env: Any) -> None:
    for vehicle in env.road.vehicles:
        quicken(vehicle)


def quicken(vehicle: Any) -> None:
    """Give a vehicle the methods above, if it is of a kind that has them."""
    mixin = _KINDS.get(type(vehicle))
    if mixin is not None:
        specialise(vehicle, mixin)
    elif type(vehicle) is Vehicle and "step" not in vars(vehicle):
        # Its class stays as it is: the library draws wheels for this very class only.
        vehicle.step = MethodType(_advance, vehicle)


def accelerate(env: Any) -> None:
    prepare(env, _make_road_scalar, _quicken_all)
