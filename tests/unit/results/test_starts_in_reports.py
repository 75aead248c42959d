"""Runs from a submit of an earlier run: off the leaderboard, and compared with those from the same state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_common.messages.run_settings import Start
from evopolicy_results.reading.comparability import MixedRunsError
from evopolicy_results.report import write_report
from evopolicy_results.studies.study import Study, study
from evopolicy_results.tables.report_tables import tables_of
from evopolicy_results.tables.table import Table

START = Start(run="r-1", submit_index=3, tree="ab" * 32, parent_scored=True)
OTHER = Start(run="r-1", submit_index=4, tree="cd" * 32)


def played(root: Path, heldout: list[float], **more: Any) -> None:
    version = Version(policy(gain=heldout[0]), returns=[1.0, 2.0], val=heldout[0])
    write_run(root, [version], heldout=heldout, **more)


def around(mean: float) -> list[float]:
    return [mean + 0.01 * case for case in range(32)]


@pytest.fixture
def found(tmp_path: Path) -> Study:
    root = tmp_path / "runs"
    played(root, around(-100.0), entry="A", run="r-1")
    for repeat in range(3):
        again = {"repeat": repeat, "exp_id": "start", "start": START}
        played(root, around(-50.0 + repeat), entry="A", **again)
        played(root, around(-20.0 - repeat), entry="B", **again)
    played(root, around(-10.0), entry="B", exp_id="other", start=OTHER)
    return study([root])


def starts(of: Study) -> Table:
    (table,) = [table for table in tables_of(of) if table.name == "starts"]
    return table


def test_starts_are_on_no_leaderboard_and_in_no_mean(found: Study) -> None:
    (suite,) = found.suites
    assert suite.table.agents == ["A"]
    assert suite.table.cells["A", "gym/acrobot"].scores == (pytest.approx(-99.845),)
    assert len(found.runs) == 8
    assert {one.run for one in found.evolutions} == {"A / gym/acrobot / exp"}


def test_starts_from_one_state_are_paired_by_case_with_an_interval(found: Study) -> None:
    same, other = found.starts
    (pair,) = same.pairs
    assert (pair.first, pair.second, pair.n_runs, pair.n_cases) == ("A", "B", (3, 3), 32)
    assert pair.gap.value == pytest.approx(-28.0)
    assert pair.gap.low < -28.0 < pair.gap.high
    assert (pair.verdict, pair.n_needed) == ("too few runs", 4)
    assert (other.pairs, other.variants) == ((), {"B": 1})
    rows = starts(found).rows
    assert [(row["start"], row["scored"]) for row in rows] == [
        ("A / exp, submit 3", "yes"),
        ("A / exp, submit 4", "no"),
    ]
    assert [(row["over"], row["runs"]) for row in rows if row.get("over")] == [("runs and cases", "3 and 3")]
    assert rows[1]["interval"] == "no other agent or setting"


def test_a_report_shows_the_runs_from_one_state(found: Study, tmp_path: Path) -> None:
    page = write_report(found, tmp_path / "report", traces=False).read_text()
    assert "Runs from one state" in page
    assert "of these from a submit" in page
    assert (tmp_path / "report" / "tables" / "starts.csv").read_text().count("submit 3") == 1


def test_feedback_levels_from_one_state_are_compared_under_one_entry(tmp_path: Path) -> None:
    played(tmp_path, around(-50.0), start=START)
    played(tmp_path, around(-60.0), exp_id="scores", start=START, feedback="scores")
    ((pair,),) = [group.pairs for group in study([tmp_path]).starts]
    assert (pair.first, pair.second) == ("Agent A, feedback pictures", "Agent A, feedback scores")


def test_starts_that_differ_in_their_budget_are_refused(tmp_path: Path) -> None:
    played(tmp_path, around(-50.0), start=START)
    played(tmp_path, around(-60.0), exp_id="less", start=START, budget=64)
    with pytest.raises(MixedRunsError, match="episode budget"):
        study([tmp_path])
