"""The first screen of a report: its sentences agree with the tables, and name every known fault of the data."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run
from invented.study import write_suite

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_results.figures.scores import overview
from evopolicy_results.notebook import study, tables_of
from evopolicy_results.statistics.intervals import bounds_text, valued
from evopolicy_results.studies.answers import answers_of
from evopolicy_results.studies.palette import looks

GOOD, BAD = (Version(policy(gain=gain), (-90.0,), -95.0) for gain in (1.0, 2.0))


@pytest.mark.parametrize(
    ("value", "low", "high", "text"),
    [
        (-104.0, -144.429, -63.571, "-104 ± 40"),
        (0.9171, 0.8333, 0.9171, "0.917 (0.833 to 0.917)"),
        (12345.678, 12000.0, 12691.356, "12346 ± 346"),
        (0.00012, 0.00011, 0.00013, "0.000120 ± 0.000010"),
        (3.0, 3.0, 3.0, "3"),
        (0.5, 0.5, 0.5 + 1e-16, "0.5"),
        (-104.25, None, None, "-104.2"),
    ],
)
def test_a_number_has_the_digits_that_its_interval_supports(
    value: float, low: float | None, high: float | None, text: str
) -> None:
    assert valued(Estimate(value=value, low=low, high=high)) == text


def test_the_leader_of_a_suite_is_the_first_of_its_leaderboard(tmp_path: Path) -> None:
    write_suite(tmp_path, environments=("gym/acrobot", "gym/racing"), repeats=2)
    found = study([tmp_path])
    (leader,) = answers_of(found).leaders
    board = next(table for table in tables_of(found) if table.name == "leaderboard")
    rows = [row for row in board.rows if row["harness"] != "Uniform"]
    assert leader.entry == rows[0]["entry"]
    second = found.suites[0].statistics.standings.of(rows[1]["entry"])
    assert second is not None
    interval = str(bounds_text(rows[1]["score"], second.score_low, second.score_high))
    assert f"before {rows[1]['entry']} with" in leader.lead
    assert interval in leader.lead.partition("before")[2]
    tied = [row["entry"] for row in rows[1:] if set(row["ties"]) & set(rows[0]["ties"])]
    assert all(name in leader.apart for name in tied)
    assert leader.apart.startswith("Not told apart" if tied else "The difference to every other agent")


def test_a_rank_score_that_no_resample_changes_says_so(tmp_path: Path) -> None:
    for env in ("gym/acrobot", "gym/racing"):
        for entry, level in (("Kestrel", -90.0), ("Tern", -300.0)):
            versions = [Version(policy(gain=1.0), (level,), level)]
            heldout = [level + case % 5 for case in range(32)]
            write_run(tmp_path, versions, env=env, entry=entry, heldout=heldout, random_mean=-400.0)
    (leader,) = answers_of(study([tmp_path])).leaders
    assert leader.lead.startswith(
        "mean rank score 1.00 (in all resamples), before Tern with 0.50 (in all resamples);"
    )


def test_an_agent_far_below_random_actions_is_in_the_picture(tmp_path: Path) -> None:
    for entry, level in (("Kestrel", -90.0), ("Tern", -9000.0)):
        heldout = [level + case % 5 for case in range(32)]
        versions = [Version(policy(gain=1.0), (level,), level)]
        write_run(tmp_path, versions, entry=entry, heldout=heldout, random_mean=-400.0)
    found = study([tmp_path])
    plot = overview(found, looks(found.entries, None))
    assert plot is not None
    assert plot.figure is not None
    (panel,) = plot.figure.axes
    left, right = panel.get_xlim()
    shown = [x for line in panel.lines if line.get_marker() in ("o", "s") for x in line.get_xdata()]
    assert len(shown) == 2
    assert all(left <= x <= right for x in shown)
    assert "lie beyond it" in plot.caption


def test_on_one_environment_the_difference_has_its_own_interval(tmp_path: Path) -> None:
    for repeat in range(3):
        for entry, level in (("Kestrel", -90.0), ("Tern", -300.0)):
            versions = [Version(policy(gain=1.0 + repeat), (level,), level)]
            heldout = [level + repeat + case % 5 for case in range(32)]
            write_run(tmp_path, versions, entry=entry, repeat=repeat, exp_id=f"e{repeat}", heldout=heldout)
    (leader,) = answers_of(study([tmp_path])).leaders
    assert leader.entry == "Kestrel"
    assert "210.0 ± 2.3 above Tern" in leader.lead
    assert leader.apart == "Too few runs for a verdict on Tern; about 4 of each would do."


def test_no_agent_leads_where_none_is_above_random_actions(tmp_path: Path) -> None:
    write_run(tmp_path, [GOOD], heldout=[-95.0] * 4, random_mean=-50.0)
    (leader,) = answers_of(study([tmp_path])).leaders
    assert (leader.entry, leader.lead) == ("", "No agent is above the random policy.")


def test_missing_cells_single_runs_and_failed_runs_are_named(tmp_path: Path) -> None:
    for folder in write_suite(tmp_path, environments=("gym/acrobot", "gym/racing")):
        if folder.parts[-3:-1] == ("Tern", "gym_racing"):
            (folder / "run.json").unlink()
        if folder.parts[-3:-1] == ("Kestrel", "gym_racing"):
            shutil.rmtree(folder)
    troubles = "\n".join(answers_of(study([tmp_path])).troubles)
    for name in ("Tern", "Kestrel"):
        assert f"{name} has no run on CarRacing" in troubles
    assert "1 folder left out" in troubles
    assert "Every cell has one run" in troubles


def test_repeats_that_returned_one_policy_are_named(tmp_path: Path) -> None:
    for repeat in range(2):
        write_run(tmp_path, [BAD], exp_id=f"e{repeat}", repeat=repeat, heldout=[-95.0] * 4)
    assert any(
        "both repeats returned the same policy" in text for text in answers_of(study([tmp_path])).troubles
    )
