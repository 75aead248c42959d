"""Harbor itself plays a run of ours as a task: its orchestrator, its verifier, and its result with our score.

Docker is replaced by a namespace (`support/harbor_parts`). Opt-in, since Harbor is large and needs Python 3.12:

    python3.12 -m venv ~/harbor && ~/harbor/bin/pip install harbor==0.24.0
    EVOPOLICY_HARBOR=~/harbor/bin/harbor python -m pytest tests/integration/gateway/agents/test_harbor.py
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from test_remote_agent import remote_run
from waiting import wait_until

HARBOR = os.environ.get("EVOPOLICY_HARBOR", "")
PARTS = Path(__file__).parents[3] / "support" / "harbor_parts"
TIMEOUT_S = 300.0

if not HARBOR:
    pytest.skip(
        "the file's tests need Harbor: install it as its docstring says, then EVOPOLICY_HARBOR=... make test"
        " ARGS=tests/integration/gateway/agents/test_harbor.py",
        allow_module_level=True,
    )


@contextmanager
def scores(tasks: Path, *runs: Path) -> Iterator[str]:
    """`evopolicy harbor`, and what it prints."""
    words = ["harbor", *map(str, runs), "--tasks", str(tasks), "--http", "127.0.0.1:0"]
    said = tasks.with_suffix(".said")
    with said.open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "evopolicy_gateway.cli", *words], stdout=out, stderr=out
        )
    try:
        wait_until(lambda: "scores are served" in said.read_text() or process.poll() is not None)
        yield said.read_text()
    finally:
        process.terminate()
        process.wait(timeout=TIMEOUT_S)


def play(folder: Path, tasks: Path, agent: str) -> dict[str, Any]:
    """Harbor's result of its one trial."""
    words = ["run", "--path", str(tasks), "--agent", agent, "--jobs-dir", str(folder / "jobs"), "--yes"]
    done = subprocess.run(
        [HARBOR, *words, "--env", "harbor_parts:Container", "--n-concurrent", "1"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(PARTS)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (file,) = (folder / "jobs").glob("*/*/result.json")
    result: dict[str, Any] = json.loads(file.read_text())
    return result


def test_harbors_result_has_our_score(operator_file: Path, tmp_path: Path) -> None:
    tasks = tmp_path / "tasks"
    with remote_run(operator_file, tmp_path) as run, scores(tasks, run.folder.root):
        result = play(tmp_path, tasks, "harbor_parts:Scripted")
    assert run.record.outcome.budget_used == 4
    assert run.record.outcome.score is not None
    assert result["exception_info"] is None
    assert result["verifier_result"]["rewards"] == {"reward": run.record.outcome.score}
    policy = run.folder.root / "checkpoints" / "submit_000" / "policy.py"
    assert "# better" in policy.read_text()


def test_an_agent_that_submits_nothing_gets_no_reward(operator_file: Path, tmp_path: Path) -> None:
    tasks = tmp_path / "tasks"
    with remote_run(operator_file, tmp_path, code=3) as run, scores(tasks, run.folder.root):
        result = play(tmp_path, tasks, "nop")
    assert run.record.outcome.status == "no_ok_submit"
    assert result["verifier_result"] is None
    assert "Reward" in result["exception_info"]["exception_type"]
