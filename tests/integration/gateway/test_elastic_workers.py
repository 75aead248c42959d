"""Workers that come and go while a run is played: it waits for nobody, and comes to the same."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from commands import agent, command, ended
from coordinator_harness import Coordinator
from restless_runs import SIZE, agent_code, assert_same
from waiting import TIMEOUT_S, wait_until

pytestmark = pytest.mark.system


@contextmanager
def worker(coordinator: Coordinator, root: Path) -> Iterator[subprocess.Popen[bytes]]:
    options = ["--env", "toy", "--slots", "1", "--grace", "0", "--need-tier", "bwrap"]
    with coordinator.log.open("ab") as log:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "evopolicy_worker.cli", *options),
                *("--credentials", coordinator.ready["credentials"]["worker"]),
            ],
            env={**os.environ, "XDG_STATE_HOME": str(root / "xdg")},
            stdout=log,
            stderr=log,
        )
    try:
        yield process
    finally:
        process.terminate()
        process.wait(timeout=TIMEOUT_S)


def test_workers_that_join_and_leave_do_not_change_a_run(tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "s")
    credentials = coordinator.ready["credentials"]["operator"]
    size = (*SIZE, "--credentials", credentials)
    program = agent(tmp_path, agent_code(0.2))

    def arguments(name: str) -> tuple[str, ...]:
        return "run", "--env", "toy/line", "--agent", program, "--exp-id", name, *size

    try:
        with worker(coordinator, tmp_path) as first, command(tmp_path, *arguments("restless")) as running:
            feedback = "*/*/restless/workspace/feedback/"
            wait_until(lambda: [*(tmp_path / "runs").glob(f"{feedback}submit_000")])
            with worker(coordinator, tmp_path):
                wait_until(lambda: [*(tmp_path / "runs").glob(f"{feedback}submit_001*/episodes/ep_*")])
                first.terminate()
                assert first.wait(TIMEOUT_S) == 0
                with worker(coordinator, tmp_path):
                    assert running.wait() == 0, running.text
                ended(tmp_path, *arguments("calm"))
    finally:
        coordinator.stop()
    assert_same(tmp_path, "restless", "calm")
