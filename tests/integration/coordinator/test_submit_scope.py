"""Policy scope `submit` from the option to the report: told, played in order by one Policy, recorded, verified, not
mixed.

Its policy also reads the clock, which a verification's second check is to find.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from commands import agent, evopolicy, words

pytestmark = pytest.mark.system

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
def ask(what):
    return urllib.request.urlopen(os.environ[f"EVOPOLICYGYM_{{what}}_URL"]).read()

with open("system/documents.json", "w") as file:
    json.dump({{"task": ask("TASK").decode(), "info": json.loads(ask("INFO"))}}, file)
submit_policy({POLICY!r}, [2, 0, 0, 1])
"""


class Played:
    """A run of either scope, made with one state folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        own = ("--agent", agent(root, AGENT))
        options = words("--jail none --budget 4 --validation 2 --heldout 2 --env toy/line --state st")
        self.runs: dict[str, Path] = {}
        for scope in ("submit", "episode"):
            where = words(f"--runs {scope} --set policy_scope={scope}")
            evopolicy(root, "local", *options, *own, *where, code=0)
            self.runs[scope] = next((root / scope).glob("*/*/*/run.json")).parent

    def documents(self, scope: str) -> dict[str, Any]:
        path = self.runs[scope] / "checkpoints/submit_000/documents.json"
        found: dict[str, Any] = json.loads(path.read_text())
        return found

    def printed(self, scope: str) -> list[str]:
        episodes = self.runs[scope] / "workspace/feedback/submit_000/episodes"
        return [(folder / "stdout.txt").read_text().strip() for folder in sorted(episodes.iterdir())]

    def verify(self, scope: str, *options: str) -> dict[str, Any]:
        where = words("--json --local --state st")
        done = evopolicy(self.root, "verify", str(self.runs[scope]), *where, *options, code=0)
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
    assert limits.keys() >= set(words("rollout_wall_s act_wall_s init_wall_s cpu_s memory_bytes processes"))
    assert {"file_bytes", "files", "open_files", "output_bytes", "action_bytes"} < limits.keys()


def test_one_policy_plays_a_whole_submit_in_its_order(played: Played) -> None:
    assert played.printed("submit") == ["1 [0]", "1 [0, 1]", "1 [0, 1, 2]", "1 [0, 1, 2, 3]"]
    assert played.printed("episode") == ["1 [0]", "1 [1]", "1 [2]", "1 [3]"]


def test_the_scope_is_recorded_and_kept_out_of_a_comparison(played: Played, tmp_path: Path) -> None:
    for scope, folder in played.runs.items():
        record = json.loads((folder / "run.json").read_text())
        assert record["experiment_dimensions"]["policy_scope"] == scope
    out = words("--out report")
    done = evopolicy(tmp_path, "report", *map(str, played.runs.values()), *out, code=3)
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
    # 6 of the 10 episodes are hidden: the sample has 1 to 4 of the submit's 4, a part of it in 5 of 6 samples.
    part = "its one policy plays whole submits, of which this sample is a part"
    for _ in range(8):
        report = played.verify("submit", "--sample", "7")
        assert report["episodes"] == 7
        not_checked = [found["difference"] for found in report["not_checked"]]
        if report["policy_episodes"] == 0:
            assert not_checked == [part]
            return
        assert (report["policy_episodes"], not_checked) == (4, [])
    pytest.fail("no sample had a part of the submit")
