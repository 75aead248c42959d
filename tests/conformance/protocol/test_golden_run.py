"""The run directory `golden_run` stays readable: later versions read, report, verify, and compare it.

`golden_run/record.py` plays it anew when a release changes the files of a run."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from played import DATA, GOLDEN_RUN, play
from typer.testing import CliRunner

from evopolicy_common.records.run_difference import differences
from evopolicy_results.cli.report import app as report
from evopolicy_results.reading.reader import read_run

VERIFY = "from evopolicy_common.cli.frame import run_app; from evopolicy_results.cli.verify import app; run_app(app)"


pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def now(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden run's agent on its cases, played today."""
    return play(tmp_path_factory.mktemp("now"), GOLDEN_RUN / "agent.py", 8)


def test_the_golden_run_is_read_with_all_its_numbers() -> None:
    run = read_run(GOLDEN_RUN / "run")
    assert [submit.status for submit in run.submits] == ["ok", "ok", "import_error", "ok"]
    assert [submit.consumed for submit in run.submits] == [2, 5, 6, 8]
    assert run.score == run.record.outcome.heldout_mean_return == -51.4054121059431
    assert all(
        submit.source is not None and submit.bundle_digest for submit in run.submits if submit.status == "ok"
    )
    assert run.record.record_version == 5
    assert run.record.versions.agents_md_hash.startswith("sha256:")
    assert run.record.artifacts.logs_agent == "logs/agent.jsonl"


@pytest.mark.usefixtures("one_process")
def test_the_golden_run_is_reported(tmp_path: Path) -> None:
    result = CliRunner().invoke(report, [str(GOLDEN_RUN / "run"), "--out", str(tmp_path / "report")])
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "report" / "report.json").read_bytes())
    assert len(found["runs"]) == 1
    assert found["left_out"] == []
    assert "not_told" not in found["tables"]


@pytest.mark.system
def test_the_golden_run_is_verified(tmp_path: Path) -> None:
    """Every recorded episode and every checkpoint's policy is played again."""
    run = tmp_path / "run"
    shutil.copytree(GOLDEN_RUN / "run", run)
    command = [sys.executable, "-c", VERIFY]
    command += [str(run), "--json", "--local", "--data", str(DATA)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    assert document["identical"]
    assert (document["episodes"], document["policy_episodes"], document["policy_differences"]) == (7, 7, [])


@pytest.mark.system
def test_the_golden_run_is_the_same_run_as_one_of_today(now: Path) -> None:
    found = differences(GOLDEN_RUN / "run", now)
    # Where the agent's program lies, and what it was made with, are of the two machines.
    other = ("run.json: agent.settings.", "run.json: versions.")
    changed = [line for line in found if not line.startswith(other)]
    assert changed == [], "on purpose: python tests/conformance/protocol/golden_run/record.py"


@pytest.mark.system
def test_the_golden_run_differs_where_its_outcome_does(now: Path, tmp_path: Path) -> None:
    changed = tmp_path / "run"
    shutil.copytree(GOLDEN_RUN / "run", changed)
    document = json.loads((changed / "run.json").read_bytes())
    document["outcome"]["final_score"] = 1.0
    (changed / "run.json").write_text(json.dumps(document))
    (changed / "checkpoints/submit_001/table.json").write_text("[9]")
    found = differences(changed, now)
    assert any("outcome.final_score" in line for line in found)
    assert any(line.startswith("checkpoints/submit_001/table.json") for line in found)
