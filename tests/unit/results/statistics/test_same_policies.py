"""Repeats that returned the same policy, byte for byte, are one sample: in statistics, reports and cards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run
from rigs.finished_run import finished, played_submit

from evopolicy_common.records.policies import checkpoints
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_results.leaderboard.bundles import LabBundle
from evopolicy_results.leaderboard.write import write_site
from evopolicy_results.notebook import rows, study, tables_of
from evopolicy_results.publish import card as cards
from evopolicy_results.publish import descriptions
from evopolicy_results.publish.findings import Findings
from evopolicy_results.reading.reader import read_run
from evopolicy_results.scoring.scores import Cell, RunReturns, Scale
from evopolicy_results.statistics.aggregates import aggregates
from evopolicy_results.statistics.pairs import cell_mean, pairs, returns_in
from evopolicy_results.statistics.standings import standings
from evopolicy_results.tables.table import to_markdown

BOTH = "both repeats returned the same policy"


def cell(entry: str, *policies: str, level: float = 0.0, env: str = "env") -> Cell:
    """A run for each policy, with returns that follow from it."""
    returns = {
        each: level + np.random.default_rng(list(map(ord, each))).normal(0.0, 1.0, 32) for each in policies
    }
    runs = (
        RunReturns(score=float(returns[p].mean()), returns=tuple(returns[p]), case_set=env, policy=p)
        for p in policies
    )
    return Cell(entry=entry, env=env, runs=tuple(runs))


@pytest.mark.parametrize(
    ("policies", "text"),
    [
        ("aa", BOTH),
        ("aaa", "all 3 repeats returned the same policy"),
        ("abac", "2 of 4 repeats returned the same policy"),
        ("abab", "4 of 4 repeats returned 2 policies"),
        ("ab", ""),
        ("a", ""),
    ],
)
def test_a_cell_says_which_repeats_returned_the_same_policy(policies: str, text: str) -> None:
    assert cell("A", *policies).repeated == text


def test_runs_whose_policies_are_not_known_are_samples_of_their_own() -> None:
    assert cell("A", "", "").samples == [[0], [1]]


def test_equal_repeats_have_no_interval_over_runs_anywhere() -> None:
    one, two, other = cell("A", "a"), cell("A", "a", "a"), cell("B", "b", "c", level=-3.0)
    assert cell_mean(two) == cell_mean(one)
    (pair,) = pairs({("A", "env"): two, ("B", "env"): other}, ["A", "B"], ["env"])
    assert (pair.compares, pair.gap.over) == ("checkpoints", "cases")
    assert (pair.n_runs, pair.p_exchange) == ((1, 2), None)
    samples = {("A", "env"): two, ("B", "env"): cell("B", "b", "b")}
    scales = {"env": Scale(random=-4.0, best=0.0)}
    found, (improvement,) = aggregates(samples, ["A", "B"], scales)
    assert {one.over for one in found} == {"cases"}
    assert improvement.probability.low is None or improvement.n_environments == 1
    assert standings(samples, {"A": 1.0, "B": 0.0}, ["env"]).over == "cases"


def test_a_repeated_policy_counts_in_the_mean_and_once_in_the_variance() -> None:
    several = cell("A", "a", "a", "a", "b")
    kept = returns_in(several)
    assert kept.shape == (2, 32)
    assert kept.mean() == pytest.approx(several.mean)
    # Cluster-robust: k/(k − 1) Σ w² (x − mean)².
    a, b = several.scores[0], several.scores[3]
    expected = 2.0 * (0.75**2 * (a - several.mean) ** 2 + 0.25**2 * (b - several.mean) ** 2)
    assert kept.mean(axis=1).var(ddof=1) / 2 == pytest.approx(expected)
    # Of the same number of runs, all different, nothing changes.
    different = cell("A", "a", "b", "c")
    assert returns_in(different).tolist() == [list(run.returns) for run in different.runs]


def played(root: Path, gains: tuple[float, ...], entry: str = "Climber") -> list[Path]:
    """A run for each gain; equal gains give equal policies and returns."""
    folders = []
    for repeat, gain in enumerate(gains):
        returns = np.random.default_rng(int(gain)).normal(-200.0, 10.0, 32)
        versions = [Version(policy(gain=gain), (-200.0,), -180.0)]
        folders.append(write_run(root, versions, entry=entry, repeat=repeat, heldout=returns.tolist()))
    return folders


def test_a_report_names_equal_repeats_and_has_no_interval_over_runs(tmp_path: Path) -> None:
    played(tmp_path, (1.0, 1.0))
    played(tmp_path, (3.0, 4.0), entry="Walker")
    found = study([tmp_path])
    by_name = {table.name: table for table in tables_of(found)}
    cells = {row["entry"]: row for row in by_name["cells"].rows}
    assert cells["Climber"]["over"] == f"cases; {BOTH}"
    assert cells["Walker"]["over"] == "runs and cases"
    assert cells["Climber"]["runs"] == 2
    for name in ("leaderboard", "pairs", "aggregates"):
        assert f"Climber, Acrobot: {BOTH}" in to_markdown(by_name[name])
    (pair,) = (row for row in by_name["pairs"].rows if row["second"] == "Walker")
    assert (pair["compares"], pair["over"], pair["runs"]) == ("checkpoints", "cases", "1 and 2")
    table = found.suites[0].table
    named = {entry: table.cells[entry, "gym/acrobot"].repeated for entry in table.agents}
    assert named == {"Climber": BOTH, "Walker": ""}
    compared = rows(found.suites[0].statistics.pairs)
    assert {row["n_runs"][0] for row in compared if row["first"] == "Climber"} == {1}


def test_a_leaderboard_names_equal_repeats(tmp_path: Path) -> None:
    runs = list(map(read_run, played(tmp_path / "runs", (1.0, 1.0))))
    lab = LabBundle(file="x.evp", sha256="", lab="Lab", checked=Findings(signer="ab" * 32), runs=runs)
    assert f"cases; {BOTH}" in write_site([lab], tmp_path / "site", title="Site").read_text()


def test_equal_policies_of_other_software_are_found_by_their_files(tmp_path: Path) -> None:
    for folder in played(tmp_path, (1.0, 1.0)):
        (meta,) = folder.glob("checkpoints/*/_meta.json")
        meta.write_text(meta.read_text().replace(checkpoints.bundle_of(meta.parent).digest, ""))
    table = study([tmp_path]).suites[0].table
    assert table.cells["Climber", "gym/acrobot"].repeated == BOTH


@pytest.mark.parametrize(("gains", "over"), [((1.0, 1.0), f"cases; {BOTH}"), ((1.0, 2.0), "runs and cases")])
def test_a_card_names_equal_repeats(tmp_path: Path, gains: tuple[float, ...], over: str) -> None:
    sources = []
    for number, folder in enumerate(played(tmp_path, gains)):
        record = decode_run_record((folder / "run.json").read_bytes())
        bundle = checkpoints.bundle_of(next(folder.glob("checkpoints/*"))).digest
        submit = played_submit(bundle=bundle, mean_return=-200.0, val_mean=-180.0)
        played_run = {"run": f"r-{number}", "heldout_returns": record.outcome.heldout_returns}
        result = finished(**played_run, best_submit_index=0, submits=(submit,)).result
        sources.append(cards.CardSource(f"runs/{number:04d}", record, result))
    card = cards.make(sources, [], signer="", software="")
    assert card.results[0].over == over
    assert f"| {over} |" in descriptions.markdown(card)
