"""highway-env: the lane closest to a position, without computing the distance to every lane.

Replaces `RoadNetwork.get_closest_lane_index`, which takes the first minimum of a distance over all lanes. Only *which*
lane it is matters, so distances are estimated, in scalars, with an error below 1e-9 m; the library's distance decides
between those within DOUBT of the least. Lanes that cannot be the closest are not even estimated: the plane is divided
into square cells, and for each cell the lanes are sorted by a lower bound of their distance from any point of it, in
metres and without the heading's part, which is not negative. The bounds hold because the distance, |lateral| plus
what the longitudinal coordinate sticks out of the lane, is the length of a path to the lane, or to the rectangle that
encloses a sine lane, and so no shorter than the straight way; and a straight way changes by no more than one moves.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, cast

from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.road import RoadNetwork

from evopolicy_worker.environments.accelerations.highway_shared import DOUBT, PI, TWO_PI, prepare, wrap
from evopolicy_worker.environments.accelerations.specialise import specialise

CELL = 2.0
"""Side of a cell, metres."""
_MAX_CELLS = 4_000
"""Some 3 KiB each; more than the cells along the roads of roundabout, or in the car park."""
_FEW = 6
"""So many lanes are all estimated sooner than sorted."""
_REACH = 1e5
"""Metres from the origin within which the error of estimates is known."""

Index = tuple[str, str, int]
Pair = tuple[float, float]
Shape = tuple[Any, ...]
"""The class of a lane's estimates, and its arguments."""


class _Straight:
    """A straight lane or, with an amplitude, a sine lane."""

    def __init__(
        self, start: Pair, along: Pair, across: Pair, length: float, heading: float, *wave: float
    ) -> None:
        (self._start_x, self._start_y), (self._along_x, self._along_y) = start, along
        self._across_x, self._across_y = across
        self._length, self._heading = length, heading
        self._amplitude, self._pulsation, self._phase = wave or (0.0, 0.0, 0.0)

    def bound(self, x: float, y: float) -> float:
        """Least distance from the cell around (x, y)."""
        dx, dy = x - self._start_x, y - self._start_y
        s = dx * self._along_x + dy * self._along_y
        out = max(s - self._length, -s, 0.0)
        off = max(abs(dx * self._across_x + dy * self._across_y) - abs(self._amplitude), 0.0)
        # The straight way to the enclosing rectangle; and the sum of its two parts, which is the distance itself.
        return max(math.hypot(out, off) - CELL / math.sqrt(2), out + off - CELL) - DOUBT

    def estimate(self, x: float, y: float, heading: float) -> float:
        """Distance with heading, as the library has it, but for rounding."""
        dx, dy = x - self._start_x, y - self._start_y
        s = dx * self._along_x + dy * self._along_y
        r = dx * self._across_x + dy * self._across_y
        lane_heading = self._heading
        if self._amplitude:
            wave = self._pulsation * s + self._phase
            r -= self._amplitude * math.sin(wave)
            lane_heading += math.atan(self._amplitude * self._pulsation * math.cos(wave))
        distance = abs(r) + abs((heading - lane_heading + PI) % TWO_PI - PI)
        if s < 0:
            return distance - s
        return distance + s - self._length if s > self._length else distance


class _Circular:
    def __init__(self, centre: Pair, radius: float, start: float, length: float, direction: float) -> None:
        self._x, self._y = centre
        self._radius, self._start, self._length, self._direction = radius, start, length, direction
        end = start + direction * length / radius
        self._ends = [
            (centre[0] + radius * math.cos(phi), centre[1] + radius * math.sin(phi)) for phi in (start, end)
        ]

    def bound(self, x: float, y: float) -> float:
        """Least distance from the cell around (x, y)."""
        dx, dy = x - self._x, y - self._y
        s = self._direction * wrap(math.atan2(dy, dx) - self._start) * self._radius
        to_ends = min(math.hypot(x - end_x, y - end_y) for end_x, end_y in self._ends)
        # Beside the arc the nearest point of it is straight ahead; never further than an end.
        ahead = abs(self._radius - math.hypot(dx, dy)) if -DOUBT <= s <= self._length + DOUBT else to_ends
        return min(ahead, to_ends) - CELL / math.sqrt(2) - DOUBT

    def estimate(self, x: float, y: float, heading: float) -> float:
        """Distance with heading, as the library has it, but for rounding; −inf where rounding decides on the side."""
        dx, dy = x - self._x, y - self._y
        turn = (math.atan2(dy, dx) - self._start + PI) % TWO_PI - PI
        if abs(turn) > PI - DOUBT:
            return -math.inf
        s = self._direction * turn * self._radius
        lane_heading = self._start + turn + PI / 2 * self._direction
        distance = abs(self._radius - math.hypot(dx, dy)) + abs((heading - lane_heading + PI) % TWO_PI - PI)
        if s < 0:
            return distance - s
        return distance + s - self._length if s > self._length else distance


class _Map:
    """All lanes of a network, sorted by their bounds in every cell that was visited."""

    def __init__(self, shapes: tuple[Shape, ...]) -> None:
        self._lanes = [kind(*numbers) for kind, *numbers in shapes]
        self._all = [(-math.inf, index) for index in range(len(shapes))] if len(shapes) <= _FEW else None
        self._cells: dict[Pair, list[tuple[float, int]]] = {}

    def closest(self, x: float, y: float, heading: float) -> list[int]:
        """Positions in the list, in order, of the lanes that may be the closest; empty where estimates do not hold."""
        key = (x // CELL, y // CELL)
        cell = self._all or self._cells.get(key) or self._cell(key)
        best = second = math.inf
        closest = -1
        lanes = self._lanes
        for bound, index in cell:
            # A lane that is not looked at is further than its bound, which has DOUBT to spare.
            if bound > best:
                break
            distance = lanes[index].estimate(x, y, heading)
            if distance < best:
                best, second, closest = distance, best, index
            elif distance < second:
                second = distance
        if not best >= 0:
            return []
        if second - best > DOUBT:
            return [closest]
        near = [index for bound, index in cell if bound <= best]
        return sorted(index for index in near if lanes[index].estimate(x, y, heading) - best <= DOUBT)

    def _cell(self, key: Pair) -> list[tuple[float, int]]:
        x, y = (key[0] + 0.5) * CELL, (key[1] + 0.5) * CELL
        cell = sorted((lane.bound(x, y), index) for index, lane in enumerate(self._lanes))
        if len(self._cells) >= _MAX_CELLS:
            self._cells.clear()
        self._cells[key] = cell
        return cell


_map = lru_cache(maxsize=8)(_Map)
"""Networks of the same lanes, one for every episode, share what was worked out about the plane."""


class MappedNetwork(RoadNetwork):  # type: ignore[misc]
    """A network that knows the shapes of its lanes; none is added later."""

    _map: _Map
    _known: list[tuple[Index, Any]]
    """The index of each lane, and the lane."""

    def get_closest_lane_index(self, position: Any, heading: float | None = None) -> Index:
        x, y = float(position[0]), float(position[1])
        if heading is not None and abs(x) < _REACH and abs(y) < _REACH and abs(heading) < _REACH:
            near = self._map.closest(x, y, float(heading))
            if len(near) > 1:  # of several at the same distance the first, as with the library
                near.sort(key=lambda each: self._known[each][1].distance_with_heading(position, heading))
            if near:
                return self._known[near[0]][0]
        return cast(Index, super().get_closest_lane_index(position, heading))


def _map_network(env: Any) -> None:
    network = env.road.network
    shapes = [_shape(lane) for lane in network.lanes_list()]
    if None not in shapes:
        specialise(network, MappedNetwork)
        network._map = _map(tuple(shapes))
        network._known = list(network.lanes_dict().items())


def _shape(lane: Any) -> Shape | None:
    """The numbers of a lane that determine distances; None for a kind without an estimate."""
    if isinstance(lane, CircularLane):
        numbers = lane.radius, lane.start_phase, lane.length, lane.direction
        return _Circular, _floats(lane.center), *_floats(numbers)
    if isinstance(lane, StraightLane):
        wave = (lane.amplitude, lane.pulsation, lane.phase) if isinstance(lane, SineLane) else ()
        places = map(_floats, (lane.start, lane.direction, lane.direction_lateral))
        return _Straight, *places, *_floats((lane.length, lane.heading, *wave))
    return None


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(map(float, values))


def accelerate(env: Any) -> None:
    prepare(env, _map_network)
