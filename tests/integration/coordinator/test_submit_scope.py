"""Policy scope `submit` from the option to the report: told, played in order by one Policy, recorded, verified, not
mixed.

Its policy also reads the clock, which a verification's second check is to find.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROGRAM = (
    "from evopolicy_common.cli.frame import run_app; from evopolicy_results.cli.{0} import app; run_app(app)"
)
POLICY = """
import time

class Policy:
    built = 0
    def __init__(self, obs_space, action_space, env_meta):
        Policy.built += 1
        self.resets = []
    def reset(self, episode_index):
        self.resets.append(episode_index)
        print(self.built, self.resets)
    def act(self, obs):
        return [time.perf_counter_ns() % 1000 / 1000]
"""
AGENT = f"""
import json, os, urllib.request

def ask(what, body=None):
    request = urllib.request.Request(os.environ[f"EVOPOLICYGYM_{{what}}_URL"], data=body)
    return urllib.request.urlopen(request).read()

with open("system/documents.json", "w") as file:
    json.dump({{"task": ask("TASK").decode(), "info": json.loads(ask("INFO"))}}, file)
with open("system/policy.py", "w") as file:
    file.write({POLICY!r})
ask("SUBMIT", json.dumps({{"env_instances": [2, 0, 0, 1]}}).encode())
"""


class Played:
    """A run of either scope, made with one state folder."""

    def __init__(self, root: Path) -> None:
        self.state = root / "st"
        agent = root / "agent.py"
        agent.write_text(AGENT)
        self.runs: dict[str, Path] = {}
        for scope in ("submit", "episode"):
            command = [
                sys.executable,
                "-m",
                "evopolicy_gateway.cli",
                "local",
                "--jail",
                "none",
                "--budget",
                "4",
            ]
            command += ["--agent", f"command:{sys.executable} {agent}", "--validation", "2", "--heldout", "2"]
            command += ["--env", "toy/line", "--state", str(self.state), "--runs", str(root / scope)]
            command += ["--policy-scope", scope]
            done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=150, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
            self.runs[scope] = next((root / scope).glob("*/*/*/run.json")).parent

    def documents(self, scope: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(
            (self.runs[scope] / "checkpoints/submit_000/documents.json").read_text()
        )
        return found

    def printed(self, scope: str) -> list[str]:
        episodes = self.runs[scope] / "workspace/feedback/submit_000/episodes"
        return [(folder / "stdout.txt").read_text().strip() for folder in sorted(episodes.iterdir())]

    def verify(self, scope: str, *options: str) -> dict[str, Any]:
        command = [sys.executable, "-c", PROGRAM.format("verify"), str(self.runs[scope]), "--json", "--local"]
        command += ["--state", str(self.state), *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        report: dict[str, Any] = json.loads(done.stdout)
        return report


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return Played(tmp_path_factory.mktemp("scope"))


def test_the_agent_is_told_the_scope(played: Played) -> None:
    for scope in ("submit", "episode"):
        documents = played.documents(scope)
        assert documents["info"]["policy_scope"] == scope
        assert f"Policy scope `{scope}`" in documents["task"]


def test_the_agent_is_told_every_limit(played: Played) -> None:
    limits = played.documents("submit")["info"]["resource_limits"]
    assert {
        "rollout_wall_s",
        "act_wall_s",
        "init_wall_s",
        "cpu_s",
        "memory_bytes",
        "processes",
    } < limits.keys()
    assert {"file_bytes", "files", "open_files", "output_bytes", "action_bytes"} < limits.keys()


def test_one_policy_plays_a_whole_submit_in_its_order(played: Played) -> None:
    assert played.printed("submit") == ["1 [0]", "1 [0, 1]", "1 [0, 1, 2]", "1 [0, 1, 2, 3]"]
    assert played.printed("episode") == ["1 [0]", "1 [1]", "1 [2]", "1 [3]"]


def test_the_scope_is_recorded_and_kept_out_of_a_comparison(played: Played, tmp_path: Path) -> None:
    for scope, folder in played.runs.items():
        record = json.loads((folder / "run.json").read_text())
        assert record["experiment_dimensions"]["policy_scope"] == scope
    command = [sys.executable, "-c", PROGRAM.format("report"), *map(str, played.runs.values())]
    command += ["--out", str(tmp_path / "report"), "--no-pages", "--jobs", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)
    assert done.returncode == 3, done.stdout + done.stderr
    assert "policy scope" in done.stderr
    assert not (tmp_path / "report").exists()


def test_results_of_actions_are_verified_and_clocks_show_in_second_checks(played: Played) -> None:
    report = played.verify("submit")
    assert report["identical"]
    assert report["episodes"] == 4 + 2 + 2 + 2  # train, validation, held-out, random reference
    assert report["policy_episodes"] == 4
    assert {found["episode"] for found in report["policy_differences"]} == {
        f"submit 0, ep_00{k}" for k in range(4)
    }


def test_a_sample_takes_whole_submits_of_policies_with_that_scope(played: Played) -> None:
    report = played.verify("submit", "--sample", "6", "--seed", "3")
    assert report["episodes"] == 6
    assert report["policy_episodes"] == 0
    assert [found["difference"] for found in report["not_checked"]] == [
        "its one policy plays whole submits, of which this sample is a part"
    ]
