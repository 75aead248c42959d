"""`evopolicy verify` on runs that were really played: untouched ones are identical, tampered ones are found out."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import agent, evopolicy, process, words
from edits import edited

pytestmark = pytest.mark.system

AGENT = """
submit_policy('''
import random
import numpy as np

class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.space = action_space
    def reset(self, episode_index):
        self.scale = 0.5 + episode_index / 4
    def act(self, obs):
        if self.space["type"] == "Discrete":
            return random.randrange(self.space["n"])
        return np.random.uniform(-1, 1, self.space["shape"]) * self.scale
''', [0, 1, 1])
"""
OWN = "own"
"""The run with hidden cases of its own."""
ENVIRONMENTS = ("toy/line", "gym/acrobot", "gymnasium/MiniGrid-FourRooms-v0")
"""Arrays of numbers, and dictionaries of pictures and texts."""


class Played:
    """A state folder, the runs that were made with it, and a cluster that has it, on which most of them are
    verified."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.state = root / "st"
        self.agent = agent(root, AGENT)
        environments = [word for env in ENVIRONMENTS for word in ("--env", env)]
        self.play("local", *environments, "--state", str(self.state))
        self.copy = root / "copy"
        shutil.copytree(self.state, self.copy)
        self.operator = str(self.state / "credentials" / "operator.json")
        self._cluster = contextlib.ExitStack()
        worker = [*environments, *words("--slots 2 --need-tier bwrap --credentials")]
        worker.append(str(self.state / "credentials" / "worker.json"))
        for room, options in {"coordinator": ["--state", str(self.state)], "worker": worker}.items():
            self._cluster.enter_context(process(root / room, f"evopolicy_{room}.cli", *options))

    def close(self) -> None:
        self._cluster.close()

    def play(self, *options: str) -> None:
        own = ("--agent", self.agent, *words("--budget 3 --validation 1 --heldout 2"))
        evopolicy(self.root, *options, *own, code=0)

    def run(self, env: str) -> Path:
        found = self.root.glob(f"runs/*/{env.replace('/', '_')}/*/run.json")
        return next(path.parent for path in found if path.parent.name != OWN)

    def verify(
        self, run: Path, *options: str, code: int, where: tuple[str, ...] | None = None
    ) -> dict[str, Any]:
        """The report, on the cluster or one of its own that `where` describes; else what it said."""
        where = ("--credentials", self.operator) if where is None else where
        done = evopolicy(self.root, "verify", str(run), "--json", *where, *options, code=code)
        report: dict[str, Any] = json.loads(done.stdout) if done.stdout else {"said": done.stderr}
        return report


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Played]:
    found = Played(tmp_path_factory.mktemp("verify"))
    yield found
    found.close()


def tampered(run: Path, target: Path, step: int, **changes: Any) -> Path:
    """A copy of the run with one row of its first episode changed."""
    shutil.copytree(run, target)
    path = next(target.glob("workspace/feedback/submit_000/episodes/ep_000/trajectory.jsonl"))
    path.chmod(0o644)
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    rows[step] |= changes
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return target


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_an_untouched_run_is_identical_hidden_episodes_too(played: Played, env: str) -> None:
    # The first one on a cluster of its own, with the state of the cluster that played it.
    own = ("--local", "--state", str(played.copy)) if env == ENVIRONMENTS[0] else None
    report = played.verify(played.run(env), where=own, code=0)
    assert report["identical"]
    assert report["episodes"] == 3 + 1 + 2 + 2  # train, validation, held-out, random reference
    assert report["policy_episodes"] == 3
    assert not report["policy_differences"]
    assert not report["not_checked"]
    assert not report["fingerprint_differences"]


def test_episodes_that_garbage_collection_removed_are_told_by_the_exit_code(
    played: Played, tmp_path: Path
) -> None:
    state = tmp_path / "st"
    shutil.copytree(played.copy, state)
    evopolicy(tmp_path, *words("gc --older-than 0 --state st"), code=0)
    run, where = played.run(ENVIRONMENTS[0]), ("--local", "--state", str(state))
    report = played.verify(run, where=where, code=3)
    # The actions of train episodes are in the feedback files; validation 1, held-out 2 and random reference 2 are gone.
    assert (report["identical"], report["episodes"], report["unchecked_episodes"]) == (True, 3, 5)


@pytest.mark.timeout(600)
def test_a_run_with_own_hidden_cases_is_verified_where_known(played: Played) -> None:
    on = ("--credentials", played.operator)
    played.play("run", "--env", "toy/line", "--set", "hidden_cases=per-run", "--exp-id", OWN, *on)
    (run,) = [path.parent for path in played.root.glob("runs/*/toy_line/own*/run.json")]
    report = played.verify(run, code=0)
    assert (report["identical"], report["episodes"], report["not_checked"]) == (True, 8, [])
    assert "hidden cases of its own" in played.verify(run, where=("--local",), code=2)["said"]


def test_a_sample_has_the_asked_size(played: Played) -> None:
    assert played.verify(played.run("toy/line"), "--sample", "3", code=0)["episodes"] == 3


def test_a_tampered_reward_is_found(played: Played, tmp_path: Path) -> None:
    run = tampered(played.run("gym/acrobot"), tmp_path / "run", 4, reward=-0.5)
    (found,) = played.verify(run, code=1)["differences"]
    assert found["episode"] == "submit 0, ep_000"
    assert "step 4: reward" in found["difference"]


def test_numbers_that_no_episode_shows_are_compared_with_the_coordinators(
    played: Played, tmp_path: Path
) -> None:
    """A raised score with everything that follows from it, and a summary with fewer returns than episodes."""
    run = Path(shutil.copytree(played.run("gym/acrobot"), tmp_path / "run"))
    with edited(run / "run.json") as record:
        outcome = record["outcome"]
        outcome |= {"final_score": -1.0, "heldout_mean_return": -1.0, "heldout_returns": [-1.0, -1.0]}
        outcome["heldout_std_return"] = 0.0
    path = run / "workspace" / "feedback" / "submit_000" / "summary.json"
    path.chmod(0o644)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"returns": [-1.0]}))
    report = played.verify(run, "--sample", "1", code=1)
    found = [one["difference"] for one in report["differences"]]
    assert any(text.startswith("outcome.final_score is -1.0; the coordinator has") for text in found), found
    assert any(text.startswith("number of returns is 1") for text in found), found


def test_without_the_coordinator_a_tampered_action_shows_in_its_results(
    played: Played, tmp_path: Path
) -> None:
    run = tampered(played.run("toy/line"), tmp_path / "run", 0, action=[0.9])
    with edited(run / "run.json") as record:
        record["run"] = "r-unknown"
        record["versions"]["fingerprint"] |= {"numpy": "1.0", "definition": "of another text"}
    report = played.verify(run, code=1)
    assert {found["episode"] for found in report["differences"]} == {"submit 0, ep_000"}
    assert report["from_files"] == report["episodes"] == 3
    for first in ("numpy 1.0 in the run", "definition of another text in the run"):
        assert any(text.startswith(first) for text in report["fingerprint_differences"])


def test_a_cluster_with_other_cases_says_so_and_stops(played: Played) -> None:
    said = played.verify(played.run("toy/line"), where=("--local",), code=2)["said"]
    assert "train cases of toy/line are not the run's" in said
