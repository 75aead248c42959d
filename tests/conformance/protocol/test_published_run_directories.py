"""`evopolicy report` reads run directories of the published software, and says what they do not tell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from invented.policies import Version, policy
from invented.published_runs import SUBMITS, write_published_run
from invented.run_dirs import write_run
from published_checker import check_run
from typer.testing import CliRunner

from evopolicy_common.errors import ConfigError, ProtocolError
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_results.cli.report import app
from evopolicy_results.reading.reader import read_or_explain, read_run
from evopolicy_results.reading.records import LeftOut
from evopolicy_results.verify.source import read_run as read_for_verify

pytestmark = pytest.mark.usefixtures("one_process")


def test_the_fixture_is_what_the_published_checker_passes(tmp_path: Path) -> None:
    assert check_run(write_published_run(tmp_path)) == []
    assert check_run(write_published_run(tmp_path, exp_id="none", submits=SUBMITS[2:3])) == []


@pytest.mark.parametrize("env", ["gym/acrobot", "gym_acrobot"])
def test_a_published_run_is_read_with_what_it_tells(tmp_path: Path, env: str) -> None:
    folder = write_published_run(tmp_path, env=env)
    for path in folder.glob("workspace/feedback/*/summary.json"):
        if env == "gym_acrobot":  # the environment is in the path alone
            path.write_text(json.dumps(json.loads(path.read_bytes()) | {"env": ""}))
    run = read_run(folder)
    assert (run.entry, run.env, run.record.exp_id) == ("model-a", "gym/acrobot", "exp-1")
    assert (run.score, run.budget, run.record.outcome.best_submit_index) == (-95.0, 32, 3)
    assert [submit.status for submit in run.submits] == ["ok", "ok", "init_error", "ok"]
    assert [submit.consumed for submit in run.submits] == [8, 16, 24, 32]
    assert [submit.val_mean for submit in run.submits] == [-300.0, -150.0, None, -90.0]
    assert run.submits[0].mean_return == -306.5
    assert all(submit.source is not None for submit in run.scored)
    dimensions = run.record.experiment_dimensions
    assert (dimensions.policy_scope, dimensions.observations, dimensions.simulation) == (
        "submit",
        "lists",
        "forbidden",
    )
    assert run.record.versions.data_secret is False
    assert run.record.hidden_isolation == "unknown"


def test_an_untold_selected_submit_is_found_by_its_code(tmp_path: Path) -> None:
    folder = write_published_run(tmp_path)
    document = json.loads((folder / "run.json").read_bytes())
    del document["outcome"]["best_submit_index"]
    (folder / "run.json").write_text(json.dumps(document))
    assert read_run(folder).record.outcome.best_submit_index == 3


def test_a_published_run_without_an_ok_submit_has_no_score(tmp_path: Path) -> None:
    run = read_run(write_published_run(tmp_path, submits=SUBMITS[2:3]))
    assert run.record.outcome.final_score == 0.0
    assert run.score is None


def report(tmp_path: Path, *arguments: str) -> dict[str, Any]:
    out = tmp_path / "report"
    result = CliRunner().invoke(app, [*arguments, "--out", str(out)])
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads((out / "report.json").read_bytes())["tables"]
    return found


def test_a_report_of_published_runs_fills_its_tables_and_tells_the_gaps(tmp_path: Path) -> None:
    for model, submits in (("model-a", SUBMITS), ("model-b", SUBMITS[:2])):
        write_published_run(tmp_path / "runs", model=model, submits=submits)
    tables = report(tmp_path, str(tmp_path / "runs"))
    board = {row["entry"]: row for row in tables["leaderboard"]["rows"]}
    assert {entry: row["rank"] for entry, row in board.items()} == {"model-a": 1, "model-b": 2}
    assert [row["improvements"] for row in tables["evolution"]["rows"]] == [2, 1]
    edits = {row["entry"]: row for row in tables["edit_types"]["rows"]}
    assert (
        edits["model-a"]["n_parametric"],
        edits["model-a"]["n_synthesis"],
        edits["model-a"]["n_not_ok"],
    ) == (1, 1, 1)
    assert {row["entry"] for row in tables["structure"]["rows"]} == {"model-a", "model-b"}
    assert "tokens" not in tables
    gaps = {(row["table"], row["runs"]) for row in tables["not_told"]["rows"]}
    assert {("Normalised performance", 2), ("Tokens and cost", 2), ("Audit signals", 2)} <= gaps
    assert ("Realised structure", 2) not in gaps
    for row in tables["audit"]["rows"]:
        assert row["wall_s"] == 600.0
        assert [row[name] for name in ("rejected", "turns", "agent_s", "rollout_s")] == [None] * 4
    assert tables["left_out"]["rows"] == []


def test_published_runs_and_ours_are_compared_only_where_that_is_allowed(tmp_path: Path) -> None:
    write_published_run(tmp_path / "runs")
    write_run(tmp_path / "runs", [Version(policy(), (0.0,) * 8, -200.0)])
    result = CliRunner().invoke(app, [str(tmp_path / "runs"), "--out", str(tmp_path / "report")])
    assert result.exit_code != 0
    assert "policy scope" in result.output
    tables = report(tmp_path, str(tmp_path / "runs"), "--allow-mixed")
    assert {row["runs"] for row in tables["not_told"]["rows"]} == {1}


def test_only_reports_read_published_runs(tmp_path: Path) -> None:
    folder = write_published_run(tmp_path)
    with pytest.raises(ProtocolError, match="published software"):
        decode_run_record((folder / "run.json").read_bytes())
    with pytest.raises(ConfigError, match="published software"):
        read_for_verify(folder)


@pytest.mark.parametrize(
    "damage",
    [
        {"outcome": None},
        {"timing": {}},
        {"outcome": {"status": "completed", "final_score": "high"}},
        {"outcome": {"status": "completed", "final_score": 1.0, "auxiliary": {"code_metrics_best": 1}}},
        {"versions": 3, "artifacts": {"workspace": 7}},
        {"model": ["x"], "outcome": {"status": "completed", "best_submit_index": "x"}},
        {"experiment_dimensions": {"episode_budget": -1}, "outcome": {"val_scores": [1]}},
    ],
)
def test_a_damaged_published_run_is_left_out_with_its_reason(tmp_path: Path, damage: dict[str, Any]) -> None:
    folder = write_published_run(tmp_path)
    document = json.loads((folder / "run.json").read_bytes())
    (folder / "run.json").write_text(json.dumps(document | damage))
    found = read_or_explain(folder)
    assert isinstance(found, LeftOut)
    assert found.reason


def edited(folder: Path, **parts: dict[str, Any]) -> None:
    """Changes fields of parts of a `run.json`."""
    path = folder / "run.json"
    record = json.loads(path.read_text())
    for name, fields in parts.items():
        record[name] |= fields
    path.write_text(json.dumps(record))


def both_softwares(runs: Path, n_ours: int = 3) -> None:
    """A run of each software of the same name on the same case files, of which ours has used `n_ours` held-out
    cases."""
    published = write_published_run(runs / "published")
    edited(published, outcome={"heldout_returns": [-90.0, -95.0, -100.0], "final_score": -95.0})
    hashes = json.loads((published / "run.json").read_text())["versions"]
    ours = write_run(
        runs / "ours",
        [Version(policy(), (0.0,) * 8, -200.0)],
        entry="model-a",
        exp_id="exp-1",
        heldout=[-80.0, -86.0, -92.0][:n_ours],
    )
    cases = {split: f"sha256:{split}{n_ours}" for split in ("train", "validation", "heldout")}
    files = {name: hashes[name] for name in hashes if name.startswith("data_")}
    edited(ours, versions={**files, "cases_hashes": cases}, experiment_dimensions={"n_heldout": n_ours})


def test_runs_of_both_softwares_are_paired_by_the_cases_of_their_files(tmp_path: Path) -> None:
    both_softwares(tmp_path / "runs")
    result = CliRunner().invoke(app, [str(tmp_path / "runs"), "--out", str(tmp_path / "report")])
    assert result.exit_code != 0
    assert "failed episodes" in result.output
    assert "split on" not in result.output
    tables = report(tmp_path, str(tmp_path / "runs"), "--allow-mixed")
    assert tables["left_out"]["rows"] == []
    names = {"model-a", "model-a (published software)"}
    (pair,) = (row for row in tables["pairs"]["rows"] if {row["first"], row["second"]} == names)
    assert (pair["cases"], pair["left_out"], abs(pair["gap"])) == (3, 0, 9.0)


def test_runs_of_both_softwares_on_other_numbers_of_cases_are_not_paired(tmp_path: Path) -> None:
    both_softwares(tmp_path / "runs", n_ours=2)
    result = CliRunner().invoke(app, [str(tmp_path / "runs"), "--out", str(tmp_path / "report")])
    assert "held-out split on gym/acrobot" in result.output
