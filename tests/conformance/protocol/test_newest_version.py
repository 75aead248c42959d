"""Files of the newest published software are recognised and named wherever they are given."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.newest import described
from evopolicy_gateway.operator.trials import policy_bundle
from evopolicy_results.leaderboard.command import app as leaderboard
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.verify.source import read_run

POLICY = "def make_policy(context):\n    return object()\n"


def write(folder: Path, name: str, **fields: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(fields))
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = write(tmp_path / "run", "run.json", schema="evopolicygym/run-record/v8", library_version="0.3.0")
    for place in ("initial/program", "workspace/program", "submissions/submission-000001/program"):
        (folder / place).mkdir(parents=True)
        (folder / place / "policy.py").write_text(POLICY)
    return folder


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return (
        write(tmp_path / "board", "results.json", schema="evopolicygym/leaderboard-results/v1")
        / "results.json"
    )


def test_a_report_names_runs_results_and_policies_of_the_newest_version(run: Path, results: Path) -> None:
    program = run / "initial/program"
    reasons = [each.reason for each in load_runs([run, results, results.parent, program]).left_out]
    assert sorted(reason.partition("EvoPolicyGym")[0].rpartition("this is ")[2] for reason in reasons) == [
        "a policy of ",
        "a run of ",
        "leaderboard results of ",
        "leaderboard results of ",
    ]
    assert all("`evopolicy try" in reason for reason in reasons)


def test_verify_and_leaderboard_name_what_they_are_given(run: Path, results: Path, tmp_path: Path) -> None:
    for folder in (run, results.parent, run / "initial/program"):
        with pytest.raises(ConfigError, match=r"EvoPolicyGym.*`evopolicy try"):
            read_run(folder)
    for path in (run, results):
        result = CliRunner().invoke(leaderboard, [str(path), "--out", str(tmp_path / "site")])
        assert result.exit_code != 0
        assert "EvoPolicyGym" in result.output


def test_try_plays_a_program_and_names_a_run_or_results(run: Path, results: Path) -> None:
    (bundled,) = policy_bundle(run / "submissions/submission-000001/program").files
    assert bundled.data == POLICY.encode()
    for path in (run, results):
        with pytest.raises(ConfigError, match="EvoPolicyGym"):
            policy_bundle(path)


def test_other_files_are_not_taken_for_the_newest_version(tmp_path: Path) -> None:
    (tmp_path / "policy.py").write_text("class Policy: pass\n")
    (tmp_path / "results.json").write_text("[1]")
    assert described(tmp_path) == described(tmp_path / "results.json") == described(tmp_path / "none") == ""
