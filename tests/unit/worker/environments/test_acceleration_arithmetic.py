"""The scalar forms of numpy calls, and the estimates, of the accelerations of highway-env, against the library."""

from __future__ import annotations

import contextlib
import copy
import math
from collections import Counter
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from evopolicy_worker.environments.accelerations.highway_shared import clip, not_zero, wrap

highway_env = pytest.importorskip("highway_env")

from highway_env import utils  # noqa: E402
from highway_env.road.lane import SineLane, StraightLane  # noqa: E402
from highway_env.road.road import RoadNetwork  # noqa: E402
from highway_env.vehicle.kinematics import Vehicle  # noqa: E402

from evopolicy_worker.environments.accelerations import (  # noqa: E402
    highway_closest_lane,
    highway_collisions,
    highway_lanes,
)

ANY = st.floats(allow_nan=True, allow_infinity=True)
FINITE = st.floats(-1e6, 1e6)


def bits(*values: Any) -> list[str]:
    return [float(value).hex() for value in values]


@pytest.fixture(scope="module", params=["roundabout-v0", "parking-v0"])
def network(request: pytest.FixtureRequest) -> Any:
    gymnasium.register_envs(highway_env)
    with pytest.warns() if "roundabout" in request.param else contextlib.nullcontext():
        env: Any = gymnasium.make(request.param, disable_env_checker=True).unwrapped
    return env.road.network


@given(ANY, st.sampled_from([(-1.0, 1.0), (0.0, 20.0), (-math.pi / 4, math.pi / 4), (-6.0, 6.0)]))
@example(-0.0, (0.0, 20.0))
@example(math.nan, (0.0, 20.0))
def test_clip_is_numpys_for_every_double(value: float, limits: tuple[float, float]) -> None:
    assert bits(clip(value, *limits)) == bits(np.clip(value, *limits))


@given(FINITE)
def test_wrap_and_not_zero_are_the_librarys(value: float) -> None:
    assert bits(wrap(value)) == bits(utils.wrap_to_pi(np.float64(value)))
    assert bits(not_zero(value)) == bits(utils.not_zero(np.float64(value)))


def positions(network: Any, count: int, seed: int) -> Any:
    """Points on lanes, near them and anywhere, and some at which two lanes meet."""
    rng = np.random.default_rng(seed)
    lanes = network.lanes_list()
    for _ in range(count):
        lane = lanes[rng.integers(len(lanes))]
        kind = rng.integers(4)
        if kind == 0:
            yield rng.uniform(-200, 200, size=2), rng.uniform(-7, 7)
            continue
        s = (0.0, lane.length)[rng.integers(2)] if kind == 1 else rng.uniform(-10, lane.length + 10)
        r = 0.0 if kind == 1 else rng.normal(0, 2)
        yield np.asarray(lane.position(s, r), dtype=np.float64), lane.heading_at(s) + rng.normal(0, 0.3)


def test_quickened_lanes_have_the_librarys_coordinates_and_headings(network: Any) -> None:
    rng = np.random.default_rng(3)
    for lane in network.lanes_list():
        quick = lane.from_config(lane.to_config()["config"])
        highway_lanes.quicken(quick)
        assert type(quick) is not type(lane)
        for position, _ in positions(network, 60, seed=int(rng.integers(1000))):
            expected = lane.local_coordinates(position)
            for _ in range(2):  # computed, then remembered
                assert bits(*quick.local_coordinates(position)) == bits(*expected)
            assert bits(quick.heading_at(expected[0])) == bits(lane.heading_at(expected[0]))
            assert quick.on_lane(position) == lane.on_lane(position)
            assert quick.on_lane(position, *expected, margin=1) == lane.on_lane(position, *expected, margin=1)


def test_lanes_that_run_askew_have_the_librarys_numbers() -> None:
    rng = np.random.default_rng(3)
    for make in (lambda: StraightLane([0, 0], [10, 7]), lambda: SineLane([0, 0], [10, 7], 1.0, 0.5, 0.0)):
        lane, plain = make(), make()
        highway_lanes.quicken(lane)
        for position in rng.normal(0, 20, (300, 2)):
            for _ in range(2):
                assert bits(*lane.local_coordinates(position)) == bits(*plain.local_coordinates(position))


def test_the_closest_lane_is_the_librarys(network: Any) -> None:
    mapped = copy.deepcopy(network)
    highway_closest_lane._map_network(SimpleNamespace(road=SimpleNamespace(network=mapped)))
    candidates = Counter[bool]()
    at_rest = [(np.zeros(2), heading) for heading in (0.0, math.pi / 2, 1.0)]
    for position, heading in (*at_rest, *positions(network, 4000, seed=1)):
        expected = RoadNetwork.get_closest_lane_index(network, position, heading)
        assert mapped.get_closest_lane_index(position, heading) == expected
        candidates[len(mapped._map.closest(*position.tolist(), float(heading))) > 1] += 1
    assert candidates[False] > 2000
    assert candidates[True] > 0


def test_every_estimate_and_bound_of_a_distance_holds(network: Any) -> None:
    half = highway_closest_lane.CELL / 2
    rng = np.random.default_rng(4)
    for position, heading in positions(network, 150, seed=2):
        x, y = float(position[0]), float(position[1])
        centre = (x + rng.uniform(-half, half), y + rng.uniform(-half, half))
        for lane in network.lanes_list():
            shape: Any = highway_closest_lane._shape(lane)
            known = shape[0](*shape[1:])
            exact = lane.distance_with_heading(position, heading)
            estimate = known.estimate(x, y, float(heading))
            assert estimate == -math.inf or abs(estimate - exact) < 1e-9
            assert known.bound(*centre) <= lane.distance(position)


@settings(max_examples=300)
@given(
    st.tuples(st.floats(-8, 8), st.floats(-8, 8)),
    st.floats(-4, 4),
    st.floats(-4, 4),
    st.floats(-40, 40),
    st.floats(-40, 40),
    st.sampled_from([(5.0, 2.0), (70.0, 1.0), (2.0, 2.0)]),
)
def test_vehicles_that_are_dismissed_do_not_collide(
    place: tuple[float, float],
    heading: float,
    other_heading: float,
    speed: float,
    other_speed: float,
    size: tuple[float, float],
) -> None:
    dt = 1 / 15
    one = Vehicle(None, [0.5, -0.5], heading, speed)
    other = Vehicle(None, place, other_heading, other_speed)
    other.LENGTH, other.WIDTH = size
    other.diagonal = np.sqrt(other.LENGTH**2 + other.WIDTH**2)
    apart = highway_collisions._apart(highway_collisions._body(one, dt), highway_collisions._body(other, dt))
    intersecting, will_intersect, _ = one._is_colliding(other, dt)
    assert not (apart and (intersecting or will_intersect))
