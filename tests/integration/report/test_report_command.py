"""`evopolicy report` end to end on synthetic run directories: files, refusals, damaged input."""

from __future__ import annotations

import csv
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from click.testing import Result
from invented.policies import Version, png, policy
from invented.run_dirs import amend, write_run
from invented.study import AGENTS, write_suite
from typer.testing import CliRunner

from evopolicy_results.cli.report import app
from evopolicy_results.notebook import figures_of, rows, write_report
from evopolicy_results.scoring.scores import paper_text
from evopolicy_results.studies.study import study

ENVIRONMENTS = ("gym/acrobot", "gym/racing", "toy/line")
MP4 = bytes.fromhex("000000206674797069736f6d0000020069736f6d69736f32617663316d703431")
"""The first box of a video file: enough to be copied and linked."""


pytestmark = pytest.mark.usefixtures("one_process")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    write_suite(folder, environments=ENVIRONMENTS, repeats=2, n_submits=6)
    damaged = folder / "Tern" / "gym_racing" / "exp-1" / "run.json"
    damaged.write_bytes(damaged.read_bytes()[:300])
    return folder


PLAIN = [Version(policy(), (1.0,), 1.0)]


def reported(runs: Path, out: Path, *options: str, code: int = 0) -> Result:
    """`evopolicy report` in this process, which ends with `code`."""
    result = CliRunner().invoke(app, [str(runs), "--out", str(out), *options])
    assert result.exit_code == code, result.output
    return result


def report_on(folder: Path, *options: str) -> Path:
    """The report on `folder/runs`."""
    reported(folder / "runs", folder / "report", *options)
    return folder / "report"


@pytest.fixture(scope="module")
def report(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "report"
    found = json.loads(reported(runs, out, "--json").stdout)
    assert (found["runs"], len(found["left_out"])) == (23, 1)
    assert found["index"] == str(out / "index.html")
    return out


class Links(HTMLParser):
    """Ids, links and sources of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.targets: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.ids.append(value)
            if name in ("href", "src", "xlink:href") and value:
                self.targets.append(value)


def links_of(page: Path) -> Links:
    parser = Links()
    parser.feed(page.read_text(encoding="utf-8"))
    return parser


def test_every_table_and_figure_is_written_in_every_form(report: Path) -> None:
    tables = {path.stem for path in (report / "tables").glob("*.csv")}
    assert tables >= {
        "leaderboard", "heldout", "cells", "normalised", "evolution",
        "edit_types", "structure", "edit_sizes", "tokens", "audit", "runs", "feedback_use", "agents", "environments",
        "left_out",
    }  # fmt: skip
    for suffix in ("md", "tex"):
        assert {path.stem for path in (report / "tables").glob(f"*.{suffix}")} == tables
    figures = {path.stem for path in (report / "figures").glob("*.svg")}
    assert figures >= {
        "overview", "rank_scores_core16", "score_evolution_core16", "normalised_core16", "edit_hits", "edit_size", "structure", "tokens",  # noqa: E501
        "wall_time", "timeline_gym_acrobot", "timeline_toy_line",
    }  # fmt: skip
    data = json.loads((report / "report.json").read_text())
    assert set(data["figures"]) == figures
    assert set(data["tables"]) == tables
    assert len(data["runs"]) == 23
    assert all(data["figures"][name]["data"] for name in figures)


def table(report: Path, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((report / "tables" / f"{name}.csv").read_text().splitlines()))


def test_feedback_use_has_a_row_for_every_submit(report: Path, runs: Path) -> None:
    found = table(report, "feedback_use")
    assert len(found) == sum(int(row["submits"]) for row in table(report, "runs"))
    record = json.loads((runs / "Kestrel" / "gym_acrobot" / "exp" / "run.json").read_text())
    own = [r for r in found if (r["env"], r["entry"], r["run"]) == ("Acrobot", "Kestrel", "exp")]
    assert [r["submit"] for r in own] == [f"s{i:03d}" for i in range(len(own))]
    assert [r["before"] for r in own[1:]] == [r["after"] for r in own[:-1]]
    assert {r["submit"]: float(r["validation"]) for r in own if r["validation"]} == {
        f"s{int(index):03d}": score for index, score in record["outcome"]["val_scores"].items()
    }
    assert [r["submit"] for r in own if r["selected"]] == [f"s{record['outcome']['best_submit_index']:03d}"]
    assert any("feedback/submit_000" in r["read"] for r in own)
    assert any(r["said"] for r in own)
    assert own[0]["edit"] == "first"


def test_agents_and_environments_are_listed_as_they_were_set_up(tmp_path: Path) -> None:
    for repeat, settings in enumerate(
        ({"effort": "high", "retries": 5, "requests_failed": 3, "folder": "/home/me"}, {"effort": "low"})
    ):
        agent = {"settings": settings, "model_string": "m-1", "cli_version": "2.0"}
        write_run(tmp_path / "runs", PLAIN, repeat=repeat, budget=64, settings={}, change={"agent": agent})
    report = report_on(tmp_path)
    agents = table(report, "agents")
    assert [(r["entry"], r["cli_version"], r["model"], r["settings"], r["runs"]) for r in agents] == [
        ("Agent A", "2.0", "m-1", "effort high, retries 5", "1"),
        ("Agent A", "2.0", "m-1", "effort low", "1"),
    ]
    (env,) = table(report, "environments")
    assert (env["id"], env["family"], env["demand"], env["budget"], env["steps"]) == (
        "gym/acrobot", "Gym / Box2D", "tuning", "64", "500",
    )  # fmt: skip
    board = table(report, "leaderboard")
    assert {r["entry"]: r["budget"] for r in board} == {"Agent A": "64", "Random policy": ""}


def test_every_link_and_image_of_every_page_resolves(report: Path) -> None:
    pages = sorted(report.rglob("*.html"))
    assert len(pages) == 1 + 23
    ids = {page.resolve(): links_of(page).ids for page in pages}
    for page in pages:
        found = links_of(page)
        assert len(found.ids) == len(set(found.ids)), f"{page} repeats an id"
        for target in found.targets:
            assert not re.match(r"(https?:)?//", target), f"{page} reaches out to {target}"
            if target.startswith("data:"):
                continue
            path, _, fragment = unquote(target).partition("#")
            there = (page.parent / path).resolve() if path else page.resolve()
            assert there.is_file(), f"{page} links to {target}"
            if fragment and there.suffix == ".html":
                assert fragment in ids[there], f"{page} links to {target}"


def test_index_is_self_contained(report: Path) -> None:
    text = (report / "index.html").read_text()
    assert not re.search(r"<(?:img|script|link|iframe)[^>]+(?:src|href)=\"(?!data:)", text)
    assert "@import" not in text
    assert text.count('<svg role="img"') == len(list((report / "figures").glob("*.svg")))


def test_suites_are_groups_of_one_table_and_sections_have_one_order(report: Path) -> None:
    text = (report / "index.html").read_text()
    assert "<h1>Core16 (2 of 16), Toy line: policy evolution report</h1>" in text
    assert re.findall(r'<section id="([a-z-]+)"', text)[:3] == ["returns", "leaderboard", "statistics"]
    assert "\ufffd" not in text
    # Means over environments are shown of the suite with two, not of the one with a single environment.
    for name in ("leaderboard", "aggregates", "improvement"):
        assert f'id="{name}-table"' in text
        assert {row.get("suite", "Core16 (2 of 16)") for row in table(report, name)} == {"Core16 (2 of 16)"}
    assert {row["suite"] for row in table(report, "heldout")} == {"Core16 (2 of 16)", "Toy line"}
    assert not list((report / "figures").glob("rank_scores_toy*"))


def test_left_out_run_is_listed_with_its_reason(report: Path) -> None:
    (row,) = table(report, "left_out")
    assert row["path"].endswith("Tern/gym_racing/exp-1")
    assert row["reason"].startswith("run.json")
    assert row["path"] in (report / "index.html").read_text()


@pytest.mark.system
def test_report_is_the_same_whether_one_or_two_processes_make_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in write_suite(tmp_path / "runs", environments=("gym/racing", "own/glider"), n_submits=4):
        amend(folder, {"env_title": "Glider"} if "glider" in str(folder) else {})
    written = []
    for jobs in ("1", "2"):
        monkeypatch.setattr(os, "cpu_count", lambda jobs=jobs: int(jobs))
        reported(tmp_path / "runs", tmp_path / jobs)
        files = [path for path in (tmp_path / jobs).rglob("*") if path.is_file()]
        written.append({path.relative_to(tmp_path / jobs): path.read_bytes() for path in files})
    assert written[0].keys() == written[1].keys()
    assert [path for path, content in written[0].items() if written[1][path] != content] == []


def test_papers_table_as_input_gives_its_aggregate_table(tmp_path: Path) -> None:
    source = tmp_path / "table.csv"
    source.write_text(paper_text("table1_heldout_returns"))
    reported(source, tmp_path / "report")
    written = table(tmp_path / "report", "leaderboard")
    paper = csv.DictReader(paper_text("table2_aggregate").splitlines())
    for row, printed in zip(written, paper, strict=True):
        assert row["entry"] == printed["entry"]
        assert f"{float(row['score']):.3f}" == printed["core16"]
        assert (row["wins"], row["top2"]) == (printed["wins"], printed["top2"])


def test_mixed_runs_are_refused_unless_told_and_then_marked(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", PLAIN)
    other = write_run(tmp_path / "runs", PLAIN, entry="Other", policy_scope="submit")
    refused = reported(tmp_path / "runs", tmp_path / "report", code=3).output
    assert "policy scope on core16: episode (1 run), submit (1 run)" in refused
    assert f"    submit: {other}\n" in refused
    assert not (tmp_path / "report").exists()
    assert "policy scope on core16" in (report_on(tmp_path, "--allow-mixed") / "index.html").read_text()


def test_runs_of_unknown_isolation_are_named_and_mixed_on_request(tmp_path: Path) -> None:
    runs, out = tmp_path / "runs", tmp_path / "report"
    write_run(runs, PLAIN, hidden_isolation="unknown")
    reported(runs, out)
    assert "1 of 1 runs do not record whether" in (out / "index.html").read_text()
    write_run(runs, PLAIN, entry="Other", hidden_isolation="exclusive")
    assert "hidden isolation" in reported(runs, out, code=3).output
    reported(runs, out, "--allow-mixed")


def test_nothing_to_report_writes_nothing_and_says_why(tmp_path: Path) -> None:
    (tmp_path / "runs/x/workspace").mkdir(parents=True)
    (tmp_path / "runs/x/logs").mkdir()
    assert "unfinished" in reported(tmp_path / "runs", tmp_path / "report", code=1).output
    assert not (tmp_path / "report").exists()


def test_folder_with_other_files_is_not_written_to(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    assert "thesis.txt" in reported(runs, tmp_path, code=2).output
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_replays_are_copied_and_missing_ones_said(tmp_path: Path) -> None:
    replays = {"heldout_000/video.mp4": MP4, "heldout_001/video.mp4": MP4}
    for entry in ("A", "B"):
        folder = write_run(tmp_path / "runs", PLAIN, entry=entry, replays=replays)
    (folder / "replays/heldout_001/video.mp4").unlink()
    report = report_on(tmp_path)
    page = report / "replays/gym-acrobot.html"
    text = page.read_text()
    assert text.count("<video") == 3
    assert "its file is missing" in text
    assert 'href="replays/gym-acrobot.html"' in (report / "index.html").read_text()
    media = [target for target in links_of(page).targets if target.startswith("media")]
    assert len(media) >= 3
    assert all((page.parent / target.partition("#")[0]).exists() for target in media)


def test_feedback_video_is_shown_beside_its_submit(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "runs", [*PLAIN, Version(policy(gain=2.0), (1.0,), 2.0)])
    video = folder / "workspace/feedback/submit_001/episodes/ep_001/video.mp4"
    video.parent.mkdir(parents=True)
    video.write_bytes(MP4)
    (page,) = (report_on(tmp_path) / "traces").glob("*.html")
    (target,) = {target.partition("#")[0] for target in links_of(page).targets if ".mp4" in target}
    assert target.endswith("s001.mp4")
    assert (page.parent / target).read_bytes() == MP4


def test_replay_path_that_leads_out_of_the_run_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(png())
    folder = write_run(tmp_path / "runs", PLAIN, replays={"a.mp4": MP4})
    record = json.loads((folder / "run.json").read_text())
    amend(folder, {"replays": [record["replays"][0] | {"path": "../../../../secret.png"}]})
    report = report_on(tmp_path)
    assert not list(report.rglob("*.png.*"))
    assert "its file is missing" in (report / "replays/gym-acrobot.html").read_text()


def test_notebook_example_of_the_package_works(runs: Path, tmp_path: Path) -> None:
    found = study([runs])
    core16 = next(suite for suite in found.suites if suite.name == "core16")
    assert [row.entry for row in core16.board.standings][-1] == "Random policy"
    assert {row["entry"] for row in rows(found.evolutions)} == set(AGENTS)
    assert next(figures_of(found)).name == "rank_scores_core16"
    write_run(tmp_path / "runs", PLAIN)
    assert "Mine" in write_report(study([tmp_path / "runs"]), tmp_path / "report", title="Mine").read_text()
