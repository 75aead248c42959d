"""The public package at work: a policy, a run with a function as agent, a cluster over mutual TLS, the page as it is
written."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from commands import process
from coordinator_harness import Coordinator
from machines.own_certs import OwnCerts

import evopolicy as evp

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "how-to" / "python.md"
POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        print("episode", episode_index)

    def act(self, obs):
        return [{gain} * (obs[2] - obs[0])]
"""


@pytest.fixture(scope="module")
def cluster() -> Iterator[evp.Cluster]:
    with evp.Cluster.local(slots=2, fresh=True) as cluster:
        yield cluster


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    folder = tmp_path / "policy"
    folder.mkdir()
    (folder / "policy.py").write_text(POLICY.replace("{gain}", "0.3"))
    return folder


def test_a_policy_is_played_and_its_trajectories_are_arrays(cluster: evp.Cluster, policy: Path) -> None:
    result = cluster.evaluate(policy, env="toy/line", cases=[3, 1])
    assert [one.case for one in result] == [3, 1]
    assert result.returns.shape == result.lengths.shape == (2,)
    assert result.mean_return == pytest.approx(result.returns.mean())
    for one in result:
        assert one.observations.shape == (one.length, 3)
        assert one.rewards.shape == (one.length,)
        assert one.rewards.sum() == pytest.approx(one.episode_return)
        assert one.stdout.startswith("episode ")
    assert list(result.to_pandas()["case"]) == [3, 1]
    assert "<svg" in result._repr_html_()


def test_a_function_plays_as_a_folder_with_its_code_does(cluster: evp.Cluster, policy: Path) -> None:
    gain, calls = 0.3, []

    def act(obs: np.ndarray) -> list[float]:
        calls.append(obs)
        return [gain * (obs[2] - obs[0])]

    played = cluster.evaluate(act, env="toy/line", cases=[3, 1])
    written = cluster.evaluate(policy, env="toy/line", cases=[3, 1])
    assert [*played.returns] == [*written.returns]
    assert calls == []


def test_async_twins_play_at_once_and_give_the_same(cluster: evp.Cluster, policy: Path) -> None:
    async def both() -> list[evp.Evaluation]:
        calls = (cluster.evaluate_async(policy, env="toy/line", cases=[case]) for case in (0, 1))
        return await asyncio.gather(*calls)

    one, two = asyncio.run(both())
    together = cluster.evaluate(policy, env="toy/line", cases=[0, 1])
    assert [*one.returns, *two.returns] == [*together.returns]


def test_a_failing_policy_is_a_result(cluster: evp.Cluster, policy: Path) -> None:
    (policy / "policy.py").write_text("raise ValueError('not today')")
    result = cluster.evaluate(policy, env="toy/line", cases=[0])
    assert result.mean_return is None
    assert "not today" in (result[0].failure or "")
    with pytest.raises(evp.ConfigError, match=r"no policy\.py"):
        cluster.evaluate(policy.parent, env="toy/line")
    with pytest.raises(evp.ConfigError, match="no environment or suite matches"):
        cluster.evaluate(policy, env="toy/none")
    with pytest.raises(evp.ConfigError, match="such as range"):
        cluster.evaluate(policy, env="toy/line", cases=["0-3"])  # type: ignore[list-item]
    assert len(cluster.evaluate(policy, env="toy/line", cases=np.arange(2))) == 2


def test_a_function_plays_a_run_from_inside_its_jail(cluster: evp.Cluster, tmp_path: Path) -> None:
    outside = tmp_path / "outside.txt"
    outside.write_text("hidden")
    before = os.getpid()

    def agent(workspace: evp.Workspace) -> dict[str, object]:
        refused = ""
        try:
            workspace.submit([0] * 99)
        except evp.SubmitRefusedError as error:
            refused = str(error)
        workspace.write(POLICY.replace("{gain}", "0.3"))
        summary = workspace.submit([0, 1])
        return {
            "sees_outside": outside.exists(),
            "same_process": os.getpid() == before,
            "mean": summary["mean_return"],
            "refused": refused,
            "left": workspace.remaining_budget,
            "task": workspace.task[:20],
        }

    run = cluster.run(
        env="toy/line", agent=agent, budget=4, validation=2, heldout=2, runs=tmp_path / "runs", exp_id="one"
    )
    assert run.status == "completed"
    assert run.summary.entry == "agent"
    value = run.value
    assert not value["sees_outside"]
    assert not value["same_process"]
    assert value["left"] == 2
    assert "budget" in value["refused"]
    assert run.submits[0].mean_return == value["mean"]
    (again,) = evp.load_runs(tmp_path / "runs")
    assert again.score == run.score


def test_a_function_that_fails_or_returns_no_json_says_so(cluster: evp.Cluster, tmp_path: Path) -> None:
    def agent(workspace: evp.Workspace) -> object:
        workspace.submit([0])
        return object()

    run = cluster.run(
        env="toy/line", agent=agent, budget=4, validation=1, heldout=1, runs=tmp_path / "runs", exp_id="two"
    )
    assert run.value is None
    assert run.summary.closed_reason == "agent_failed"
    assert "is not JSON" in (run.folder / "logs" / "agent.jsonl").read_text()


@pytest.fixture(scope="module")
def connected(tmp_path_factory: pytest.TempPathFactory) -> Iterator[evp.Cluster]:
    root = tmp_path_factory.mktemp("connect")
    certs = OwnCerts(root)
    coordinator = Coordinator(certs.state, "--listen", certs.endpoint)
    options = ["--env", "toy", "--slots", "2", "--grace", "0", "--need-tier", "bwrap"]
    options += ["--connect", certs.endpoint, "--credentials", str(certs.issue("worker", "one"))]
    state = str(root / "xdg")
    try:
        with (
            process(coordinator.log, "evopolicy_worker.cli", *options, XDG_STATE_HOME=state),
            evp.Cluster.connect(certs.endpoint, credentials=certs.issue("operator", "me")) as cluster,
        ):
            yield cluster
    finally:
        coordinator.stop()


def test_a_policy_is_played_on_a_cluster_over_tls(connected: evp.Cluster, policy: Path) -> None:
    result = connected.evaluate(policy, env="toy/line", cases=[0, 1])
    assert [one.failure for one in result] == [None, None]
    assert result[0].observations.shape == (result[0].length, 3)


def test_a_run_on_it_takes_prompts_rules_and_the_detail_of_feedback(
    connected: evp.Cluster, tmp_path: Path
) -> None:
    def agent(workspace: evp.Workspace) -> list[str]:
        workspace.write(POLICY.replace("{gain}", "0.3"))
        workspace.submit([0])
        rules = (workspace.folder / "AGENTS.md").read_text().splitlines()
        return [rules[0], *(path.name for path in workspace.folder.rglob("trajectory.jsonl"))]

    (tmp_path / "rules.md").write_text("Be brave.\n\n$standard")
    (tmp_path / "prompts.toml").write_text('first = "$standard Be brave."')
    run = connected.run(
        env="toy/line",
        agent=agent,
        budget=2,
        validation=1,
        heldout=1,
        runs=tmp_path / "runs",
        exp_id="brave",
        feedback="scores",
        agents_md=tmp_path / "rules.md",
        prompts=tmp_path / "prompts.toml",
    )
    assert run.value == ["Be brave."]
    record = json.loads((run.folder / "run.json").read_text())
    dimensions = record["experiment_dimensions"]
    digest = hashlib.sha256((tmp_path / "rules.md").read_bytes()).hexdigest()
    assert (dimensions["feedback"], dimensions["agents_md"]) == ("scores", f"sha256:{digest}")
    assert record["agent"]["prompts"]


def test_a_wrong_text_is_reported_before_anything_starts(connected: evp.Cluster, tmp_path: Path) -> None:
    with pytest.raises(evp.ConfigError, match=r"none\.md"):
        connected.run(env="toy/line", agent="random", runs=tmp_path / "runs", agents_md=tmp_path / "none.md")


def test_a_cluster_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(evp.EvopolicyError, match=r"operator-me"):
        evp.Cluster.connect("tls/127.0.0.1:1", credentials=tmp_path / "operator-me").open()


def test_ctrl_c_cancels_the_run_and_leaves_nothing(tmp_path: Path) -> None:
    program = """
import time
import evopolicy as evp

def agent(workspace):
    workspace.submit([0])
    time.sleep(600)

evp.run(env="toy/line", agent=agent, budget=4, validation=1, heldout=1, exp_id="stopped")
"""
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path / "state"), "TMPDIR": str(tmp_path)}
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "submit_000 ok" in line:
            break
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=120)
    assert output.strip().endswith("KeyboardInterrupt")
    record = json.loads((tmp_path / "runs/agent/toy_line/stopped/run.json").read_text())
    assert record["outcome"]["status"] == "cancelled"
    assert not list(tmp_path.glob("evopolicy-function-*"))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_page_does_what_it_says(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == 5
    (tmp_path / "page.py").write_text("\n".join(blocks))
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path / "state")}
    command = [sys.executable, "page.py"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=580
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert "my_function gym/continuouscar completed" in done.stdout
