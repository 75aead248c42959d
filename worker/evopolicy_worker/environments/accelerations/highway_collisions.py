"""highway-env: pairs that are clearly apart are not checked for collision.

Replaces the second half of `Road.step`, which checks every vehicle against every other and every object with
`RoadObject.handle_collisions`. That does nothing when the two are further apart than their diagonals allow, nor when
some side of one of the rectangles separates both of them, with the way they move in one step. Either is estimated in
scalars, with an error below 1e-9 m; a pair that is not apart by DOUBT goes to the library.
"""

from __future__ import annotations

import math
from typing import Any

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from evopolicy_worker.environments.accelerations.highway_shared import DOUBT, prepare
from evopolicy_worker.environments.accelerations.specialise import specialise

Body = tuple[float, float, float, float, float, float, float, float]
"""x, y, cosine and sine of the heading, half length, half width, diagonal, way in one step."""


class SiftedRoad(Road):  # type: ignore[misc]
    """A road on which most pairs are dismissed early."""

    def step(self, dt: float) -> None:
        if isinstance(self, RegulatedRoad):
            self.steps += 1
            if self.steps % int(1 / dt / self.REGULATION_FREQUENCY) == 0:
                self.enforce_road_rules()
        vehicles = self.vehicles
        for vehicle in vehicles:
            vehicle.step(dt)
        # Collisions change no position, heading or speed before the next step.
        things = vehicles + self.objects
        bodies = [_body(thing, dt) for thing in things]
        for i, vehicle in enumerate(vehicles, 1):
            body = bodies[i - 1]
            x, y, _, _, _, _, diagonal, way = body
            for thing, other in zip(things[i:], bodies[i:], strict=True):
                reach = (diagonal + other[6]) / 2 + way + DOUBT
                if reach < 0 or (x - other[0]) ** 2 + (y - other[1]) ** 2 > reach * reach:
                    continue
                if not _apart(body, other):
                    vehicle.handle_collisions(thing, dt)


def _body(thing: Any, dt: float) -> Body:
    position, heading = thing.position, thing.heading
    return (
        *(float(position[0]), float(position[1]), math.cos(heading), math.sin(heading)),
        *(thing.LENGTH / 2, thing.WIDTH / 2, float(thing.diagonal), float(thing.speed) * dt),
    )


def _apart(a: Body, b: Body) -> bool:
    """Whether some side of one separates the two now and in the next step, beyond doubt. False for anything that is
    not finite."""
    ax, ay, a_cos, a_sin, a_length, a_width, _, a_way = a
    bx, by, b_cos, b_sin, b_length, b_width, _, b_way = b
    along, across = abs(a_cos * b_cos + a_sin * b_sin), abs(a_cos * b_sin - a_sin * b_cos)
    dx, dy = bx - ax, by - ay
    way_x, way_y = a_way * a_cos - b_way * b_cos, a_way * a_sin - b_way * b_sin

    def separates(cos: float, sin: float, length: float, width: float) -> bool:
        # Relative way, and its part along each axis, widens the gap that is needed.
        gap_along = abs(dx * cos + dy * sin) - length - abs(way_x * cos + way_y * sin)
        gap_across = abs(dy * cos - dx * sin) - width - abs(way_y * cos - way_x * sin)
        return gap_along > DOUBT or gap_across > DOUBT

    return separates(
        a_cos,
        a_sin,
        a_length + b_length * along + b_width * across,
        a_width + b_length * across + b_width * along,
    ) or separates(
        b_cos,
        b_sin,
        b_length + a_length * along + a_width * across,
        b_width + a_length * across + a_width * along,
    )


def accelerate(env: Any) -> None:
    prepare(env, lambda env: specialise(env.road, SiftedRoad))
