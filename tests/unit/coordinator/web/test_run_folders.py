"""The live view combines run folders, a sweep's index, and the cluster's status."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import msgspec
from invented.web_site import finished_run, open_run, open_status

from evopolicy_common.records.suite_folder import INDEX, Index, SweepRun
from evopolicy_coordinator.web.content.run_folders import FolderReader


def test_a_sweep_shows_its_runs_on_all_hosts_once(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    here = open_run(root, exp_id="s-0", run="r-here")
    entry = partial(SweepRun, agent="Agent B", env="gym/acrobot", digest="d")
    directory = str(here.relative_to(root))
    entries = (
        entry(name="b/0", repeat=0, state="running", run="r-here", directory=directory),
        entry(name="b/1", repeat=1),
        entry(name="b/2", repeat=2),
        entry(name="b/3", repeat=3, state="error", error="no key", host="lab3"),
    )
    index = Index(suite="s", runs={each.name: each for each in entries})
    (root / INDEX).write_bytes(msgspec.json.encode(index))
    other = open_status(
        "r-there", exp_id="s-1", repeat=1, best_mean=-70.5, waits_for="a free slot", agent_host="lab2"
    )
    found = FolderReader([tmp_path]).read_runs(
        [open_status("r-here", exp_id="s-0"), other], cluster_is_known=True
    )
    (sweep,) = (sweep for sweep in found.sweeps if sweep.runs)
    assert sweep.name == "s"
    first, second, third, fourth = sorted(sweep.runs, key=lambda run: run.repeat)
    assert (first.path, first.state, first.used, first.best) == (here, "open", 1, -2.0)
    assert (second.state, second.best, second.host, second.waits_for) == (
        "open",
        -70.5,
        "lab2",
        "a free slot",
    )
    assert (second.run, second.used) == ("r-there", 28)
    assert (third.state, third.finished) == ("pending", False)
    assert (fourth.state, fourth.error, fourth.host) == ("error", "no key", "lab3")


def test_runs_beside_sweeps_are_shown_apart_from_them(tmp_path: Path) -> None:
    open_run(tmp_path / "sweep")
    (tmp_path / "sweep" / "suite.json").write_text('{"suite": "inner"}')
    finished_run(tmp_path / "other")
    found = FolderReader([tmp_path]).read_runs(None, cluster_is_known=True)
    assert {sweep.name: len(sweep.runs) for sweep in found.sweeps} == {"inner": 1, tmp_path.name: 1}


def test_a_damaged_record_is_a_run_with_that_error_and_stops_nothing(tmp_path: Path) -> None:
    folder = finished_run(tmp_path)
    open_run(tmp_path)
    (folder / "run.json").write_text("{")
    reader = FolderReader([tmp_path])
    found = reader.read_runs(None, cluster_is_known=True)
    assert sorted(run.state for run in found.by_key.values()) == ["interrupted", "unreadable"]
    assert "not a run record" in next(run.error for run in found.by_key.values() if run.finished)


def test_a_summary_that_an_agent_forged_is_passed_over(tmp_path: Path) -> None:
    folder = open_run(tmp_path)
    for name, text in (("submit_001", "{"), ("submit_002", '{"schema_version": 99}'), ("submit_x", "{}")):
        place = folder / "workspace" / "feedback" / name
        place.mkdir()
        (place / "summary.json").write_text(text)
    assert [one.summary.submit_index for one in FolderReader([tmp_path]).submits(folder)] == [0]
