"""The catalogue against itself and the paper's suite."""

from __future__ import annotations

from collections import Counter

import proofs
import pytest

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError


def test_core16_is_four_families_of_four() -> None:
    core16 = catalogue.suites()["core16"]
    families = [catalogue.entry(env_id).family for env_id in core16.environments]
    assert len(core16.environments) == 16
    assert Counter(families) == dict.fromkeys(("gym_box2d", "mujoco", "minigrid", "robotics_driving"), 4)
    assert (core16.budget, core16.n_validation, core16.n_heldout) == (128, 16, 32)
    demands = [catalogue.entry(env_id).demand for env_id in core16.environments]
    assert (demands.count("synthesis"), demands.count("tuning")) == (5, 11)


def test_every_suite_names_known_environments_of_known_families() -> None:
    for suite in catalogue.suites().values():
        for env_id in suite.environments:
            assert catalogue.entry(env_id).family in catalogue.families()


@pytest.mark.parametrize(
    ("patterns", "n"),
    [
        (["core16"], 16),
        (["gym/acrobot"], 1),
        (["gymnasium/MiniGrid-*"], 76),
        (["core16", "gym/*", "toy"], 18),
    ],
)
def test_patterns_name_environments_without_repeats(patterns: list[str], n: int) -> None:
    assert len(catalogue.resolve(patterns)) == n


@pytest.mark.parametrize(
    ("pattern", "near"),
    [
        ("gym/acrobat", "gym/acrobot"),
        ("Core16", "core16"),
        ("minigird", "minigrid"),
        ("zzz", "suites: core16"),
    ],
)
def test_an_unknown_name_is_refused_naming_what_is_near(pattern: str, near: str) -> None:
    with pytest.raises(ConfigError, match=near):
        catalogue.resolve([pattern])


def test_anchors_of_core16_and_every_family_have_width_and_a_policy() -> None:
    found = catalogue.anchors()
    assert set(catalogue.suites()["core16"].environments) <= set(found)
    assert {each.env for each in proofs.table()} <= set(found), "python docs/_site/anchors.py"
    for env_id, each in found.items():
        assert each.width > 0.0, env_id
        assert (each.random.high or each.random.mean) < (each.best.low or each.best.mean), env_id
        assert (proofs.FOLDER.parents[1] / each.policy / "policy.py").is_file()
    assert catalogue.anchor("gym/acrobot@w1") == found["gym/acrobot"]
    assert found["gym/acrobot"].normalised(found["gym/acrobot"].best.mean) == 1.0
