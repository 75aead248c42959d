"""highway-env: the vehicles' controllers and kinematics in scalars.

Replaces `Vehicle.step`; of controlled vehicles also `steering_control` and what `act` does around it; of IDM vehicles
also `act`, `acceleration` and `desired_gap`; and `Road.neighbour_vehicles` where connected lanes are not searched. The
library makes small arrays and calls numpy's `clip` for single numbers. Here the same operations are made in
the same order on Python floats; trigonometric functions, powers and dot products stay numpy's (see
`highway_arithmetic`).
"""

from __future__ import annotations

from types import MethodType
from typing import Any

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark

from evopolicy_worker.environments.accelerations.highway_arithmetic import PI, clip, not_zero, wrap
from evopolicy_worker.environments.accelerations.highway_scene import Scene, take_over
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


class ScalarMDP(ScalarControlled, MDPVehicle):  # type: ignore[misc]
    """The vehicle that the policy drives in roundabout."""

    def act(self, action: Any = None) -> None:
        if action is not None:
            super().act(action)
            return
        # The library's two calls up, with nothing to change but the controls.
        self.follow_road()
        Vehicle.act(
            self,
            {
                "steering": self.steering_control(self.target_lane_index),
                "acceleration": self.speed_control(self.target_speed),
            },
        )


class ScalarIDM(ScalarControlled, IDMVehicle):  # type: ignore[misc]
    """The traffic."""

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
        if not ego_vehicle or not isinstance(ego_vehicle, Vehicle):
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
            relative = np.array(
                (
                    speed * cos - front_speed * np.cos(front_heading),
                    speed * sin - front_speed * np.sin(front_heading),
                )
            )
            approach = float(relative.dot(np.array((cos, sin))))
        else:
            approach = speed - float(front_vehicle.speed)
        braking = -self.COMFORT_ACC_MAX * self.COMFORT_ACC_MIN
        return float(
            self.DISTANCE_WANTED + speed * self.TIME_WANTED + speed * approach / (2 * np.sqrt(braking))
        )


class ScalarRoad(Road):  # type: ignore[misc]
    """A road that is searched for neighbours."""

    def neighbour_vehicles(self, vehicle: Any, lane_index: Any = None) -> tuple[Any, Any]:
        if self.neighbour_vehicles_connected_lanes:
            found: tuple[Any, Any] = super().neighbour_vehicles(vehicle, lane_index)
            return found
        lane_index = lane_index or vehicle.lane_index
        if not lane_index:
            return None, None
        lane = self.network.get_lane(lane_index)
        coordinates, length = lane.local_coordinates, lane.VEHICLE_LENGTH
        s = coordinates(vehicle.position)[0]
        s_front = s_rear = front = rear = None
        for other in self.vehicles + self.objects:
            if other is vehicle:
                continue
            s_other, lateral = coordinates(other.position)
            if not -length <= s_other < lane.length + length:
                continue
            if not abs(lateral) <= lane.width_at(s_other) / 2 + 1 or isinstance(other, Landmark):
                continue
            if s <= s_other and (s_front is None or s_other <= s_front):
                s_front, front = s_other, other
            if s_other < s and (s_rear is None or s_other > s_rear):
                s_rear, rear = s_other, other
        return front, rear


_KINDS: dict[type[Any], type[Any]] = {
    MDPVehicle: ScalarMDP,
    IDMVehicle: ScalarIDM,
}


class ScalarTraffic(Scene):
    """An environment of which the vehicles calculate in scalars."""

    def _road_made(self) -> None:
        super()._road_made()
        specialise(self.road, ScalarRoad)

    def _vehicles_made(self) -> None:
        super()._vehicles_made()
        for vehicle in self.road.vehicles:
            mixin = _KINDS.get(type(vehicle))
            if mixin is not None:
                specialise(vehicle, mixin)
            elif type(vehicle) is Vehicle:
                # Its class stays as it is: the library draws wheels for this very class only.
                vehicle.step = MethodType(_advance, vehicle)


def accelerate(env: Any) -> None:
    """Quicken the vehicles of this bare highway-env environment."""
    take_over(env, ScalarTraffic)
