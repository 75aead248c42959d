"""Accelerated environments play as plain ones do, bit for bit.

A sample of what `python tests/conformance/environments/acceleration_checks.py` compares over any number of seeds.
"""

from __future__ import annotations

import numpy as np
import pygame
import pytest
from acceleration_checks import DifferenceError, DriverFactory, accelerated_ids, compare, compare_car_pictures
from acceleration_drivers import competent_driver, random_driver
from environment_checks import IDS as CORE_IDS

from evopolicy_common.catalogue import entries
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import Environment, make
from evopolicy_worker.environments.accelerations import ACCELERATIONS, table
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumEnvironment

pytestmark = pytest.mark.system

IDS = [env_id for env_id in accelerated_ids() if env_id in CORE_IDS]
STEPS = {"gym/racing": 60, "gymnasium/parking-v0": 50, "gymnasium/roundabout-v0": 11}
"""Steps of an episode where one is slow without acceleration; 150 elsewhere."""
SINGLES = [
    (one.name, entry.id)
    for one in ACCELERATIONS
    for entry in (entries()[env_id] for env_id in CORE_IDS)
    if one.serves(str(entry.gymnasium_id))
]


@pytest.mark.parametrize("factory", [random_driver, competent_driver])
@pytest.mark.parametrize("env_id", IDS)
def test_an_accelerated_episode_is_the_plain_one(env_id: str, factory: DriverFactory) -> None:
    done = compare(env_id, range(100, 103), factory, steps=STEPS.get(env_id, 150))
    assert done.episodes == 3
    assert done.steps > 10


@pytest.mark.parametrize(("name", "env_id"), SINGLES)
def test_each_acceleration_stands_by_itself(name: str, env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "ACCELERATIONS", tuple(one for one in ACCELERATIONS if one.name == name))
    assert _accelerations(make(env_id, accelerations=True)) == (name,)
    compare(env_id, [7], competent_driver, steps=STEPS.get(env_id, 150) // 2)


def test_accelerations_are_in_use_unless_switched_off() -> None:
    for env_id in IDS:
        gymnasium_id = str(entries()[env_id].gymnasium_id)
        wanted = tuple(one.name for one in ACCELERATIONS if one.serves(gymnasium_id))
        assert _accelerations(make(env_id)) == wanted
        assert _accelerations(make(env_id, accelerations=False)) == ()


@pytest.mark.parametrize("env_id", IDS)
def test_pictures_of_an_accelerated_environment_are_the_plain_ones(env_id: str) -> None:
    pictures = []
    for accelerations in (True, False):
        environment = make(env_id, render=True, accelerations=accelerations)
        environment.reset(Case(seed=5))
        rng = np.random.default_rng(5)
        pictures.append([environment.render()])
        for _ in range(3):
            environment.step(environment.action_codec.sample(rng))
            pictures[-1].append(environment.render())
        environment.close()
    for accelerated, plain in zip(*pictures, strict=True):
        assert accelerated.tobytes() == plain.tobytes()


def test_a_car_put_anywhere_is_seen_as_by_the_plain_environment() -> None:
    compare_car_pictures(seed=2, count=50)


def test_a_car_drives_on_after_another_environment_of_its_process_ended_pygame() -> None:
    frames = []
    for accelerations in (True, False):
        environment = make("gym/racing", accelerations=accelerations)
        environment.reset(Case(seed=5))
        rng = np.random.default_rng(5)
        for _ in range(3):
            pygame.quit()
            frames.append(environment.step(environment.action_codec.sample(rng)).obs)
        environment.close()
    for accelerated, plain in zip(frames[:3], frames[3:], strict=True):
        assert np.array_equal(accelerated, plain)


def test_the_comparison_notices_a_polygon_that_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    from evopolicy_worker.environments.accelerations import car_racing_road

    monkeypatch.setattr(car_racing_road, "MARGIN", -60.0)
    monkeypatch.setattr(car_racing_road, "_RIGHT", 900.0)
    with pytest.raises(DifferenceError):
        compare("gym/racing", [3], random_driver, steps=60)


def test_the_comparison_notices_one_unit_in_an_angles_last_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from evopolicy_worker.environments.accelerations import highway_vehicles

    exact = highway_vehicles.wrap
    monkeypatch.setattr(highway_vehicles, "wrap", lambda angle: float(np.nextafter(exact(angle), 4.0)))
    with pytest.raises(DifferenceError):
        compare("gymnasium/roundabout-v0", range(4), competent_driver)


def _accelerations(environment: Environment) -> tuple[str, ...]:
    assert isinstance(environment, GymnasiumEnvironment)
    environment.close()
    return environment.accelerations
