"""A few environments of each family are played as they say."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import proofs
import pytest
from text_checks import faults
from typer.testing import CliRunner

from evopolicy_common import catalogue
from evopolicy_worker import check_env, cli
from evopolicy_worker.environments import Environment, make
from evopolicy_worker.environments.checks import conformance

pytestmark = pytest.mark.families

Warm = Callable[[str], Environment]
FURTHER = (
    "gymnasium/Acrobot-v1",
    "gymnasium/Blackjack-v1",
    "gymnasium/Hopper-v5",
    "gymnasium/Walker2d-v4",
    "gymnasium/MiniGrid-Dynamic-Obstacles-5x5-v0",
    "gymnasium/BabyAI-GoToLocal-v0",
    "gymnasium/BabyAI-BossLevel-v0",
    "gymnasium/merge-v0",
    "gymnasium/PointMaze_UMaze-v3",
    "gymnasium/AdroitHandDoor-v1",
    "gymnasium/SpaceInvaders-v0",
    "gymnasium/MiniWorld-Sign-v0",
    "gymnasium/Meta-World/MT10",
    "gymnasium/NetHack-v0",
    "gymnasium/NetHackScout-v0",
    "gymnasium/MiniHack-Room-Ultimate-15x15-v0",
    "gymnasium/MiniHack-Levitate-Random-Full-v0",
    "dm_control/cartpole-swingup-v0",
    "dm_control/manipulator-insert_peg-v0",
    "gymnasium/VizdoomBasicNotifications-v1",
    "gymnasium/VizdoomDeathmatch-MultiBinary-v1",
    "gymnasium/VizdoomFreedoom2MAP01-S3-v0",
)
PAPER = {
    *("classic_control", "toy_text", "box2d", "mujoco", "minigrid", "babyai", "highway", "robotics"),
    *("atari", "miniworld", "metaworld", "mo_gymnasium"),
}
"""Families that the paper names, but those of web pages."""
FAMILIES = {each.family for each in proofs.table()} - {"miniwob", "browsergym"}
HERE = [each for each in proofs.together() if each.family in FAMILIES]
ELSEWHERE = FAMILIES - {each.family for each in HERE}
"""Families that exclude this installation's packages."""
SAMPLE = (*(each.env for each in HERE), *FURTHER)


def test_every_environment_has_the_digest_of_its_definition() -> None:
    assert catalogue.digests().keys() == catalogue.entries().keys(), "python docs/_site/digests.py"


def test_every_family_has_a_suite_and_is_sampled() -> None:
    suites = catalogue.suites()
    assert suites.keys() >= FAMILIES | {"breadth", "core16", "toy"}
    assert sum(len(suites[name].environments) for name in FAMILIES) >= 1041
    for name in FAMILIES:
        assert name in ELSEWHERE or set(suites[name].environments) & set(SAMPLE), name
        assert all(catalogue.entry(each).max_episode_steps for each in suites[name].environments), name


def test_the_breadth_suite_does_not_change_the_numbers_of_its_environments() -> None:
    breadth = catalogue.suites()["breadth"]
    assert {catalogue.entry(each).family for each in breadth.environments} >= FAMILIES - {"highway"}
    assert "miniwob" in {catalogue.entry(each).family for each in breadth.environments}
    assert not {"breadth", "paper13"} & {catalogue.suite_of(each).name for each in catalogue.entries()}


def test_the_suite_of_the_papers_families_has_all_their_environments() -> None:
    suites = catalogue.suites()
    paper = suites["paper13"].environments
    assert len(set(paper)) == len(paper) >= 1100
    more = {"gym_box2d", "robotics_driving", "miniwob", "browsergym"}
    assert {catalogue.entry(each).family for each in paper} | more == PAPER | more
    assert {"miniwob", "browsergym"} <= {catalogue.entry(each).family for each in paper}
    assert catalogue.resolve(["paper13"]) == [each for each in catalogue.entries() if each in set(paper)]


@pytest.mark.parametrize("env_id", SAMPLE)
def test_an_environment_keeps_what_the_interface_promises(env_id: str) -> None:
    played = conformance.play_checked(env_id, 40)
    assert played.verdict(None) == "ok"
    assert played.limit == catalogue.entry(env_id).max_episode_steps


SUITES = sorted(catalogue.suites().keys() & catalogue.families().keys() - {"toy"} - ELSEWHERE)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("suite", SUITES)
def test_every_text_of_a_family_is_whole_and_our_own(suite: str) -> None:
    ids = catalogue.suites()[suite].environments
    proofs.demand(ids[0])
    assert {each: found for each in ids if (found := faults(each))} == {}


def test_one_environment_under_two_ids_has_one_written_text(warm: Warm) -> None:
    assert warm("gymnasium/Acrobot-v1").description.task_text == warm("gym/acrobot").description.task_text


@pytest.mark.parametrize("env_id", ["gymnasium/AntMaze_UMaze-v3", "gymnasium/PointMaze_UMaze-v3"])
def test_a_maze_leaves_no_file_that_another_process_could_meet(
    env_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "ant_maze.xml").touch()
    make(env_id).close()
    assert [each.name for each in tmp_path.iterdir()] == ["ant_maze.xml"]
    assert not (tmp_path / "ant_maze.xml").read_bytes()


BROKEN = """
import os
import gymnasium
import numpy as np

class Broken(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, how):
        self.how = how

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed = seed
        return np.zeros(1, np.float32), {}

    def step(self, action):
        obs, info = np.zeros(1, np.float32), {}
        if self.how == "outside":
            obs += 2
        elif self.how == "unseeded":
            obs[0] = np.random.default_rng().random()
        elif self.how == "dies":
            os._exit(3)
        elif self.how == "tells":
            info["start"] = self.seed
        elif self.how == "hash":
            obs[0] = hash("a") % 97 / 97
        return obs, 0.0, False, False, info

for how in ("outside", "unseeded", "dies", "tells", "hash", "nothing"):
    gymnasium.register(f"{how}-v0", Broken, kwargs={"how": how}, max_episode_steps=5)
"""


@pytest.fixture
def readable() -> Iterator[Path]:
    """A folder that a slot's process of another user may read; `tmp_path` is its owner's alone."""
    with tempfile.TemporaryDirectory(prefix="evp-envs-", dir="/tmp") as name:
        Path(name).chmod(0o755)
        yield Path(name)


def test_check_env_names_what_is_not_kept_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, readable: Path
) -> None:
    (readable / "broken_environments.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(str(readable))
    monkeypatch.setenv("PYTHONPATH", str(readable))
    ways = ("outside", "unseeded", "dies", "tells", "hash", "nothing")
    ids = [f"broken_environments:{how}-v0" for how in ways]
    results = tmp_path / "results.jsonl"
    done = CliRunner().invoke(cli.app, ["check-env", "--results", str(results), *ids])
    assert done.exit_code == 1, done.output
    verdicts = {
        name.partition(":")[2]: each.verdict for name, each in check_env.read_checked(results).items()
    }
    assert "outside its space" in verdicts["outside-v0"]
    assert "another episode" in verdicts["unseeded-v0"]
    assert "status" in verdicts["dies-v0"]
    assert "names the seed" in verdicts["tells-v0"]
    assert verdicts["hash-v0"].startswith("another process plays another episode; draw from self.np_random")
    assert verdicts["nothing-v0"] == "ok"
    # What is in the file is not played again.
    n = len(results.read_bytes().splitlines())
    CliRunner().invoke(cli.app, ["check-env", "--results", str(results), *ids])
    assert len(results.read_bytes().splitlines()) == n == len(ids)
