"""`evp.Cluster.connect` to a running cluster over mutual TLS, and the settings of a run that the package takes."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from coordinator_harness import Coordinator
from machines.own_certs import OwnCerts
from waiting import TIMEOUT_S

import evopolicy as evp

pytestmark = pytest.mark.system

POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return [0.3 * (obs[2] - obs[0])]
"""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[evp.Cluster]:
    root = tmp_path_factory.mktemp("connect")
    certs = OwnCerts(root)
    coordinator = Coordinator(certs.state, "--listen", certs.endpoint)
    options = ["--env", "toy", "--slots", "2", "--grace", "0", "--need-tier", "bwrap"]
    with coordinator.log.open("ab") as log:
        worker = subprocess.Popen(
            [
                *(sys.executable, "-m", "evopolicy_worker.cli", *options),
                *("--connect", certs.endpoint, "--credentials", str(certs.issue("worker", "one"))),
            ],
            env={**os.environ, "XDG_STATE_HOME": str(root / "xdg")},
            stdout=log,
            stderr=log,
        )
    try:
        with evp.Cluster.connect(certs.endpoint, credentials=certs.issue("operator", "me")) as cluster:
            yield cluster
    finally:
        worker.terminate()
        worker.wait(timeout=TIMEOUT_S)
        coordinator.stop()


def test_a_policy_is_played_on_a_cluster_over_tls(cluster: evp.Cluster, tmp_path: Path) -> None:
    (tmp_path / "policy.py").write_text(POLICY)
    result = cluster.evaluate(tmp_path, env="toy/line", cases=[0, 1])
    assert [one.failure for one in result] == [None, None]
    assert result[0].observations.shape == (result[0].length, 3)


def test_a_run_on_it_takes_prompts_rules_and_the_detail_of_feedback(
    cluster: evp.Cluster, tmp_path: Path
) -> None:
    def agent(workspace: evp.Workspace) -> list[str]:
        workspace.write(POLICY)
        workspace.submit([0])
        rules = (workspace.folder / "AGENTS.md").read_text()
        return [
            rules.splitlines()[0],
            *sorted(path.name for path in workspace.folder.rglob("trajectory.jsonl")),
        ]

    (tmp_path / "rules.md").write_text("Be brave.\n\n$standard")
    (tmp_path / "prompts.toml").write_text('first = "$standard Be brave."')
    run = cluster.run(
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
    assert dimensions["feedback"] == "scores"
    digest = hashlib.sha256((tmp_path / "rules.md").read_bytes()).hexdigest()
    assert dimensions["agents_md"] == f"sha256:{digest}"
    assert record["agent"]["prompts"]


def test_a_wrong_text_is_reported_before_anything_starts(cluster: evp.Cluster, tmp_path: Path) -> None:
    with pytest.raises(evp.ConfigError, match=r"none\.md"):
        cluster.run(env="toy/line", agent="random", runs=tmp_path / "runs", agents_md=tmp_path / "none.md")


def test_a_cluster_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(evp.EvopolicyError, match=r"operator-me"):
        evp.Cluster.connect("tls/127.0.0.1:1", credentials=tmp_path / "operator-me").open()
