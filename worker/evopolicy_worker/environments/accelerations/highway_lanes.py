"""highway-env: coordinates along a lane, in scalars, and remembered while the same position is asked for.

Replaces `local_coordinates`, `heading_at` and `on_lane` of straight, sine and circular lanes. A lane is asked
by every vehicle about every other, so the same few positions come again and again: the last ones are
remembered, by value. The arithmetic is the library's in its order, one number at a time (see
`highway_shared`); of a straight lane only where it runs along an axis, so that each product of its dot
products is exact and fusing changes nothing. Other straight lanes remember what the library's method gives.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from highway_env.envs.racetrack_env import RacetrackEnv
from highway_env.road.lane import AbstractLane, CircularLane, SineLane, StraightLane

from evopolicy_worker.environments.accelerations.highway_shared import PI, prepare, wrap
from evopolicy_worker.environments.accelerations.specialise import specialise

_REMEMBERED = 256
Coordinates = tuple[float, float]


class Remembering(AbstractLane):  # type: ignore[misc]
    """Looks a position up before it is computed."""

    _known: dict[tuple[float, float], Coordinates]

    def local_coordinates(self, position: Any) -> Coordinates:
        return self.at(position, *position.tolist())

    def at(self, position: Any, x: float, y: float) -> Coordinates:
        """The same, of a position whose numbers are known."""
        known = self._known.get((x, y))
        if known is None:
            known = self._compute(position, x, y)
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            # Zeros of both signs are one key, but need not be one result.
            if x and y:
                self._known[x, y] = known
        return known

    def _compute(self, position: Any, x: float, y: float) -> Coordinates:
        """The coordinates along the lane of `position`, which is (x, y)."""
        raise NotImplementedError

    def on_lane(
        self, position: Any, longitudinal: Any = None, lateral: Any = None, margin: float = 0
    ) -> bool:
        if longitudinal is None or lateral is None:
            longitudinal, lateral = self.local_coordinates(position)
        if not abs(lateral) <= self.width_at(longitudinal) / 2 + margin:
            # Rewards add it up: numpy's truth values and Python's make other numbers of a float32.
            return cast(bool, np.False_)
        return cast(bool, -self.VEHICLE_LENGTH <= longitudinal < self.length + self.VEHICLE_LENGTH)


class AskewLane(Remembering, StraightLane):  # type: ignore[misc]
    def _compute(self, position: Any, x: float, y: float) -> Coordinates:
        return cast(Coordinates, StraightLane.local_coordinates(self, position))


class AxisLane(Remembering, StraightLane):  # type: ignore[misc]
    """A straight lane along an axis: its direction has a one and a zero."""

    _origin: tuple[float, float, float, float, float, float]

    def _compute(self, position: Any, x: float, y: float) -> Coordinates:
        start_x, start_y, along_x, along_y, across_x, across_y = self._origin
        dx, dy = x - start_x, y - start_y
        # The sum of a dot product starts at zero, so it is never the negative one.
        return dx * along_x + dy * along_y + 0.0, dx * across_x + dy * across_y + 0.0


class AxisSineLane(AxisLane, SineLane):  # type: ignore[misc]
    def _compute(self, position: Any, x: float, y: float) -> Coordinates:
        longitudinal, lateral = AxisLane._compute(self, position, x, y)
        wave = float(np.sin(self.pulsation * longitudinal + self.phase))
        return longitudinal, lateral - self.amplitude * wave

    def heading_at(self, longitudinal: float) -> float:
        slope = self.amplitude * self.pulsation * np.cos(self.pulsation * longitudinal + self.phase)
        return float(self.heading + np.arctan(slope))


class ScalarCircularLane(Remembering, CircularLane):  # type: ignore[misc]
    _start: float

    def _compute(self, position: Any, x: float, y: float) -> Coordinates:
        delta = position - self.center
        start = self._start
        phi = start + wrap(float(np.arctan2(delta[1], delta[0])) - start)
        distance = math.sqrt(delta.dot(delta))
        return self.direction * (phi - start) * self.radius, self.direction * (self.radius - distance)

    def heading_at(self, longitudinal: float) -> float:
        phi = self.direction * longitudinal / self.radius + self._start
        return float(phi + PI / 2 * self.direction)


class RacingCircularLane(ScalarCircularLane):
    """The same in numpy's numbers: races square them, and the square of a Python number can differ."""

    def local_coordinates(self, position: Any) -> Coordinates:
        longitudinal, lateral = super().local_coordinates(position)
        return np.float64(longitudinal), np.float64(lateral)


def quicken(lane: Any, *, races: bool = False) -> None:
    """Give a lane the methods above, if it is of a kind that has them."""
    kind = type(lane)
    if kind is CircularLane:
        specialise(lane, RacingCircularLane if races else ScalarCircularLane)
        lane._start = float(lane.start_phase)
    elif kind in (StraightLane, SineLane) and _on_axis(lane.direction) and _on_axis(lane.direction_lateral):
        specialise(lane, AxisSineLane if kind is SineLane else AxisLane)
        lane._origin = tuple(map(float, (*lane.start, *lane.direction, *lane.direction_lateral)))
    elif kind is StraightLane:
        specialise(lane, AskewLane)
    else:
        return
    lane._known = {}


def _on_axis(direction: Any) -> bool:
    return sorted(abs(float(value)) for value in direction) == [0.0, 1.0]


def accelerate(env: Any) -> None:
    prepare(env, _quicken_all)


def _quicken_all(env: Any) -> None:
    for lane in env.road.network.lanes_list():
        quicken(lane, races=isinstance(env, RacetrackEnv))
