"""Every accelerated environment of HighwayEnv plays as a plain one does, bit for bit.

A sample of what `python tests/conformance/environments/acceleration_checks.py` compares over any number of seeds.
"""

from __future__ import annotations

import pytest
from acceleration_checks import DifferenceError, accelerated_ids, compare
from acceleration_drivers import competent_driver, random_driver
from environment_checks import play

from evopolicy_common.catalogue import entries
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import make
from evopolicy_worker.environments.families.highway import FAMILY

pytestmark = pytest.mark.families

IDS = [env_id for env_id in accelerated_ids() if entries()[env_id].adapter == "highway"]


@pytest.mark.parametrize("env_id", IDS)
def test_an_accelerated_road_is_driven_as_the_plain_one(env_id: str) -> None:
    for seed in (200, 210):
        assert compare(env_id, [seed], random_driver, steps=5).steps > 1
        assert compare(env_id, [seed + 1, seed + 2], competent_driver, steps=5).steps > 2


def test_an_intersection_changes_no_later_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    for env_id in ("gymnasium/roundabout-v0", "gymnasium/highway-fast-v0"):
        environment, crossing = make(env_id), make("gymnasium/intersection-v1")
        alone = play(environment, steps=8)
        crossing.reset(Case(seed=1))
        assert play(environment, steps=8) == alone
        monkeypatch.setattr(FAMILY, "begin", lambda: None)
        crossing.reset(Case(seed=1))
        assert play(environment, steps=8) != alone
        monkeypatch.undo()
        environment.close()
        crossing.close()


def test_the_comparison_notices_a_neighbour_that_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    from evopolicy_worker.environments.accelerations import highway_vehicles

    exact = highway_vehicles.ScalarRoad._along
    monkeypatch.setattr(
        highway_vehicles.ScalarRoad,
        "_along",
        lambda road, lane: tuple(each[:1] for each in exact(road, lane)),
    )
    with pytest.raises(DifferenceError):
        compare("gymnasium/highway-fast-v0", range(3), random_driver, steps=8)
