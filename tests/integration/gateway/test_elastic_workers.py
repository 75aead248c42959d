"""Workers that come and go while a run is played: it waits for nobody, and comes to the same."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from commands import agent, command, record_in
from coordinator_harness import Coordinator
from waiting import TIMEOUT_S, wait_until

from evopolicy_common.records.summary import decode_summary

CODE = '''
open("system/policy.py", "w").write("""
import time

class Policy:
    def __init__(self, *spaces):
        pass

    def reset(self, episode_index):
        time.sleep(0.2)

    def act(self, obs):
        return [float(obs[2] - obs[0]) / 3]
""")
submit([0, 1])
submit(list(range(16)))
submit([2, 3])
'''


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


def test_workers_join_and_leave_during_a_run_and_it_comes_to_the_same(tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "s")
    credentials = coordinator.ready["credentials"]["operator"]
    size = ("--budget", "20", "--validation", "4", "--heldout", "4", "--credentials", credentials)
    program = agent(tmp_path, CODE)

    def arguments(name: str) -> tuple[str, ...]:
        return "run", "--env", "toy/line", "--agent", program, "--exp-id", name, *size

    def folder(name: str) -> Path:
        (found,) = (tmp_path / "runs").glob(f"*/toy_line/{name}")
        return found

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
                with command(tmp_path, *arguments("calm")) as calm:
                    assert calm.wait() == 0, calm.text
    finally:
        coordinator.stop()
    restless, still = (record_in(folder(name)).outcome for name in ("restless", "calm"))
    assert (restless.status, restless.budget_used) == ("completed", 20)
    assert restless.heldout_returns == still.heldout_returns
    assert restless.val_scores == still.val_scores
    for index in range(3):
        told = [
            decode_summary(
                (folder(name) / f"workspace/feedback/submit_{index:03d}/summary.json").read_bytes()
            )
            for name in ("restless", "calm")
        ]
        assert told[0].returns == told[1].returns
