"""`evopolicy verify` on runs that were really played: untouched ones are identical, tampered ones are found out."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.system

VERIFY = "from evopolicy_common.cli.frame import run_app; from evopolicy_results.cli.verify import app; run_app(app)"
AGENT = """
import json, os, urllib.request
with open("system/policy.py", "w") as file:
    file.write('''
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
''')
request = urllib.request.Request(
    os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": [0, 1, 1]}).encode()
)
urllib.request.urlopen(request).read()
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
        (root / "agent.py").write_text(AGENT)
        self.play(
            "local", *(word for env in ENVIRONMENTS for word in ("--env", env)), "--state", str(self.state)
        )
        self.copy = root / "copy"
        shutil.copytree(self.state, self.copy)
        self.operator = str(self.state / "credentials" / "operator.json")
        self._cluster = contextlib.ExitStack()
        worker = [word for env in ENVIRONMENTS for word in ("--env", env)]
        worker += [
            "--slots",
            "2",
            "--need-tier",
            "bwrap",
            "--credentials",
            str(self.state / "credentials" / "worker.json"),
        ]
        for room, options in {"coordinator": ["--state", str(self.state)], "worker": worker}.items():
            command = [sys.executable, "-m", f"evopolicy_{room}.cli", *options]
            process = self._cluster.enter_context(subprocess.Popen(command, stdout=subprocess.DEVNULL))
            self._cluster.callback(process.terminate)

    def close(self) -> None:
        self._cluster.close()

    def play(self, *options: str) -> None:
        command = [sys.executable, "-m", "evopolicy_gateway.cli", *options, "--budget", "3"]
        command += ["--agent", f"command:{sys.executable} {self.root / 'agent.py'}", "--validation", "1"]
        command += ["--heldout", "2"]
        done = subprocess.run(
            command, cwd=self.root, capture_output=True, text=True, timeout=150, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def run(self, env: str) -> Path:
        found = self.root.glob(f"runs/*/{env.replace('/', '_')}/*/run.json")
        return next(path.parent for path in found if path.parent.name != OWN)

    def verify(
        self, run: Path, *options: str, where: tuple[str, ...] | None = None
    ) -> subprocess.CompletedProcess[str]:
        """On the cluster, or on one of its own that `where` describes."""
        where = ("--credentials", self.operator) if where is None else where
        command = [sys.executable, "-c", VERIFY, str(run), "--json", *where, *options]
        return subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)


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
    done = played.verify(played.run(env), where=own)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
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
    gc = [sys.executable, "-m", "evopolicy_gateway.cli", "gc", "--older-than", "0", "--state", str(state)]
    subprocess.run(gc, check=True, capture_output=True, timeout=150)
    run, where = played.run(ENVIRONMENTS[0]), ("--local", "--state", str(state))
    done = played.verify(run, where=where)
    assert done.returncode == 3, done.stdout + done.stderr
    report = json.loads(done.stdout)
    # The actions of train episodes are in the feedback files; validation 1, held-out 2 and random reference 2 are gone.
    assert (report["identical"], report["episodes"], report["unchecked_episodes"]) == (True, 3, 5)


@pytest.mark.timeout(600)
def test_a_run_with_own_hidden_cases_is_verified_where_known(played: Played) -> None:
    on = ("--credentials", played.operator)
    played.play("run", "--env", "toy/line", "--hidden-cases", "per-run", "--exp-id", OWN, *on)
    (run,) = [path.parent for path in played.root.glob("runs/*/toy_line/own*/run.json")]
    done = played.verify(run)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert (report["identical"], report["episodes"], report["not_checked"]) == (True, 8, [])
    done = played.verify(run, where=("--local",))
    assert done.returncode != 0
    assert "hidden cases of its own" in done.stdout + done.stderr


def test_a_sample_has_the_asked_size_and_follows_its_seed(played: Played) -> None:
    run = played.run("toy/line")
    for _ in range(2):
        done = played.verify(run, "--sample", "3", "--seed", "7", "--no-policy")
        assert done.returncode == 0, done.stdout + done.stderr
        assert json.loads(done.stdout)["episodes"] == 3


def test_a_tampered_reward_is_found(played: Played, tmp_path: Path) -> None:
    run = tampered(played.run("gym/acrobot"), tmp_path / "run", 4, reward=-0.5)
    done = played.verify(run, "--no-policy")
    assert done.returncode == 1, done.stdout + done.stderr
    (found,) = json.loads(done.stdout)["differences"]
    assert found["episode"] == "submit 0, ep_000"
    assert "step 4: reward" in found["difference"]


def test_numbers_that_no_episode_shows_are_compared_with_the_coordinators(
    played: Played, tmp_path: Path
) -> None:
    """A raised score with everything that follows from it, and a summary with fewer returns than episodes."""
    run = Path(shutil.copytree(played.run("gym/acrobot"), tmp_path / "run"))
    record = json.loads((run / "run.json").read_text())
    outcome = record["outcome"]
    outcome |= {"final_score": -1.0, "heldout_mean_return": -1.0, "heldout_returns": [-1.0, -1.0]}
    outcome["heldout_std_return"] = 0.0
    (run / "run.json").write_text(json.dumps(record))
    path = run / "workspace" / "feedback" / "submit_000" / "summary.json"
    path.chmod(0o644)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"returns": [-1.0]}))
    done = played.verify(run, "--no-policy", "--sample", "1")
    assert done.returncode == 1, done.stdout + done.stderr
    found = [one["difference"] for one in json.loads(done.stdout)["differences"]]
    assert any(text.startswith("final_score is -1.0; the coordinator has") for text in found), found
    assert any(text.startswith("number of returns is 1") for text in found), found


def test_without_the_coordinator_a_tampered_action_shows_in_its_results(
    played: Played, tmp_path: Path
) -> None:
    run = tampered(played.run("toy/line"), tmp_path / "run", 0, action=[0.9])
    record = json.loads((run / "run.json").read_text())
    record["run"] = "r-unknown"
    record["versions"]["fingerprint"] |= {"numpy": "1.0", "definition": "of another text"}
    (run / "run.json").write_text(json.dumps(record))
    done = played.verify(run)
    assert done.returncode == 1, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert {found["episode"] for found in report["differences"]} == {"submit 0, ep_000"}
    assert report["from_files"] == report["episodes"] == 3
    for first in ("numpy: 1.0 in the run", "definition: of another text in the run"):
        assert any(text.startswith(first) for text in report["fingerprint_differences"])


def test_a_cluster_with_other_cases_says_so_and_stops(played: Played) -> None:
    done = played.verify(played.run("toy/line"), where=("--local",))
    assert done.returncode == 2
    assert "train cases of toy/line are not the run's" in done.stderr


def test_a_folder_without_a_run_is_wrong_usage(tmp_path: Path) -> None:
    command = [sys.executable, "-c", VERIFY, str(tmp_path), "--local"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "is not the directory of a finished run" in done.stderr
