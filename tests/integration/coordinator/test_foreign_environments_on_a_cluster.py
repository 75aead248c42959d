"""An environment that is installed on the worker alone: from its announcement through the operator's approval to a
report."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import STILL
from coordinator_harness import Coordinator

pytestmark = pytest.mark.system

PACKAGE = Path(__file__).parents[2] / "support" / "foreign_package"
FILE = """
id = "acme/glider"
gymnasium_id = "acme_envs:Glider-v0"
title = "Glider"
family = "acme"
max_episode_steps = 12
success = "near"
success_at = "any"
"""


@pytest.fixture
def coordinator(tmp_path: Path) -> Iterator[Coordinator]:
    found = Coordinator(tmp_path / "state", trust_workers=False)
    yield found
    found.stop()


@pytest.fixture
def worker(tmp_path: Path, coordinator: Coordinator) -> Iterator[subprocess.Popen[bytes]]:
    home = tmp_path / "worker"
    home.mkdir()
    (home / "glider.toml").write_text(FILE)
    words = "-P -m evopolicy_worker.cli --env glider.toml --env toy/line --slots 1 --grace 1 --credentials"
    with (home / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, *words.split(), coordinator.ready["credentials"]["worker"]],
            cwd=home,
            env={**os.environ, "PYTHONPATH": str(PACKAGE)},
            stdout=log,
            stderr=log,
        )
    yield process
    process.terminate()
    process.wait(timeout=60)


class Operator:
    """Runs commands of the operator's, who has no copy of the environment."""

    def __init__(self, coordinator: Coordinator, cwd: Path) -> None:
        self._where = ("--credentials", coordinator.ready["credentials"]["operator"])
        self._cwd = cwd

    def says(self, *words: str, cluster: bool = True) -> subprocess.CompletedProcess[str]:
        variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        return subprocess.run(
            [sys.executable, "-P", "-m", "evopolicy_gateway.cli", *words, *(self._where if cluster else ())],
            cwd=self._cwd,
            env=variables,
            capture_output=True,
            text=True,
            timeout=150,
        )


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_environment_of_the_workers_alone_goes_from_announcement_to_report(
    tmp_path: Path, coordinator: Coordinator, worker: subprocess.Popen[bytes]
) -> None:
    operator = Operator(coordinator, tmp_path)
    found: list[dict[str, object]] = []
    deadline = time.monotonic() + 120
    while len(found) < 2 and time.monotonic() < deadline:
        assert worker.poll() is None, (tmp_path / "worker" / "log").read_text()
        found = json.loads(operator.says("envs", "--json").stdout or "[]")
    listed = {str(each["description"]["env"]): each for each in found}  # type: ignore[index]
    assert listed["toy/line"]["accepted"] == "ships"
    assert listed["acme/glider"]["accepted"] == "by digest only"
    digest = str(listed["acme/glider"]["digest"])

    refused = operator.says("try", STILL, "--env", "acme/glider", "--cases", "0,1")
    assert refused.returncode == 2
    assert f"evopolicy envs approve acme/glider@{digest}" in refused.stderr
    near = operator.says("try", STILL, "--env", "acme/glidr", "--cases", "0")
    assert near.returncode == 2
    assert "no worker offers acme/glidr; near: acme/glider" in near.stderr
    wrong = operator.says("try", STILL, "--env", "acme/glider@0123456789abcdef", "--cases", "0")
    assert (
        f"no worker offers acme/glider in definition 0123456789abcdef; offered are: {digest}" in wrong.stderr
    )

    by_digest = operator.says("try", STILL, "--env", f"acme/glider@{digest[:8]}", "--cases", "0,1", "--json")
    assert by_digest.returncode == 0, by_digest.stderr
    approved = operator.says("envs", "approve", f"acme/glider@{digest}")
    assert approved.returncode == 0, approved.stderr
    assert "Glider" in operator.says("envs", "--env", "acme/glider").stdout
    run = operator.says(
        *("run", "--env", "acme/glider", "--agent", "evolve", "--budget", "6", "--exp-id", "a"),
        *("--validation", "2", "--heldout", "2", "--tier", "bwrap"),
    )
    assert run.returncode == 0, run.stderr + run.stdout
    record = json.loads((tmp_path / "runs/evolve/acme_glider/a/run.json").read_text())
    assert record["versions"]["fingerprint"]["definition"] == digest
    assert "acme_envs" in record["versions"]["fingerprint"]
    report = operator.says("report", "runs", "--out", "report", cluster=False)
    assert report.returncode == 0, report.stderr
    assert "acme/glider" in (tmp_path / "report" / "index.html").read_text()
