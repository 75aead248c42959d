"""highway-env: pairs that are clearly apart are not checked for collision.

Replaces the second half of `Road.step`, which checks every vehicle against every other and every object with
`RoadObject.handle_collisions`. That does nothing when the two are further apart than their diagonals allow, nor when
some side of one of the rectangles separates both of them, with the way they move in one step. Either is estimated in
scalars, with an error below 1e-9 m; a pair that is not apart by DOUBT goes to the library, except for a goal that was
driven over before: it is not solid, and nothing is left to be noted of it.
"""

from __future__ import annotations

import math
from typing import Any

from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road

from evopolicy_worker.environments.accelerations.highway_scene import Scene, take_over
from evopolicy_worker.environments.accelerations.specialise import specialise

DOUBT = 1e-6
"""Metres."""

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
        bodies = [_body(vehicle, dt) for vehicle in vehicles]
        others = [_body(thing, dt) for thing in self.objects]
        for i, vehicle in enumerate(vehicles):
            body = bodies[i]
            x, y, _, _, _, _, diagonal, way = body
            for j in range(i + 1, len(vehicles)):
                other = bodies[j]
                # As in `_apart`, which is called for few.
                reach = (diagonal + other[6]) / 2 + way + DOUBT
                near = reach >= 0 and not (x - other[0]) ** 2 + (y - other[1]) ** 2 > reach * reach
                if near and not _apart(body, other):
                    vehicle.handle_collisions(vehicles[j], dt)
            for thing, other in zip(self.objects, others, strict=True):
                if not _apart(body, other) and not _settled(vehicle, thing):
                    vehicle.handle_collisions(thing, dt)


def _body(thing: Any, dt: float) -> Body:
    position, heading = thing.position, thing.heading
    return (
        float(position[0]),
        float(position[1]),
        math.cos(heading),
        math.sin(heading),
        thing.LENGTH / 2,
        thing.WIDTH / 2,
        float(thing.diagonal),
        float(thing.speed) * dt,
    )


def _settled(vehicle: Any, thing: Any) -> bool:
    """Whether all that a collision of the two could do is to mark as hit what is marked already: a goal driven over."""
    return bool(vehicle.solid and not thing.solid and thing.hit)


def _apart(a: Body, b: Body) -> bool:
    """Whether the two neither touch nor will, beyond doubt. False for anything that is not finite."""
    ax, ay, a_cos, a_sin, a_half_length, a_half_width, a_diagonal, a_way = a
    bx, by, b_cos, b_sin, b_half_length, b_half_width, b_diagonal, b_way = b
    dx, dy = bx - ax, by - ay
    reach = (a_diagonal + b_diagonal) / 2 + a_way + DOUBT
    if reach < 0 or dx * dx + dy * dy > reach * reach:
        return True
    along, across = abs(a_cos * b_cos + a_sin * b_sin), abs(a_cos * b_sin - a_sin * b_cos)
    # Relative way, and its part along each axis, widens the gap that is needed.
    way_x, way_y = a_way * a_cos - b_way * b_cos, a_way * a_sin - b_way * b_sin
    b_along_a, b_across_a = (
        b_half_length * along + b_half_width * across,
        b_half_length * across + b_half_width * along,
    )
    if (
        abs(dx * a_cos + dy * a_sin) - a_half_length - b_along_a - abs(way_x * a_cos + way_y * a_sin) > DOUBT
        or abs(dy * a_cos - dx * a_sin) - a_half_width - b_across_a - abs(way_y * a_cos - way_x * a_sin)
        > DOUBT
    ):
        return True
    a_along_b, a_across_b = (
        a_half_length * along + a_half_width * across,
        a_half_length * across + a_half_width * along,
    )
    return (
        abs(dx * b_cos + dy * b_sin) - b_half_length - a_along_b - abs(way_x * b_cos + way_y * b_sin) > DOUBT
        or abs(dy * b_cos - dx * b_sin) - b_half_width - a_across_b - abs(way_y * b_cos - way_x * b_sin)
        > DOUBT
    )


class SiftedCollisions(Scene):
    """An environment with such a road."""

    def _road_made(self) -> None:
        super()._road_made()
        specialise(self.road, SiftedRoad)


def accelerate(env: Any) -> None:
    """Check fewer collisions in this bare highway-env environment."""
    take_over(env, SiftedCollisions)
