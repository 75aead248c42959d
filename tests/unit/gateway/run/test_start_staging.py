"""`--start-from`: which submit it names, and the workspace that a run gets from it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from gateway_double import opened
from rigs.finished_run import mark_opened

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.policies import bundles, trees
from evopolicy_gateway.run.plan import Plan, find_start, stage_start
from evopolicy_gateway.run.run_options import RunOptions
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.workspace import staging
from evopolicy_gateway.workspace.agents_md import NO_URLS

RUN = "runs/e/toy_line/first"


@pytest.fixture
def parent(tmp_path: Path) -> RunFolder:
    """An open run with one submit, and hidden results beside its workspace."""
    folder = RunFolder(tmp_path / RUN)
    folder.state.mkdir(parents=True)
    mark_opened(folder)
    (folder.feedback / "submit_000").mkdir(parents=True)
    (folder.feedback / "submit_000" / "summary.json").write_text("{}")
    folder.system.mkdir()
    (folder.system / "policy.py").write_text("submitted")
    (folder.workspace / "notes.md").write_text("notes")
    trees.TreeRecorder(folder.workspace, folder.trees).record(
        "submit_000", bundles.snapshot(folder.system), None
    )
    (folder.system / "policy.py").write_text("selected by hidden cases")
    (folder.checkpoints / "submit_000").mkdir(parents=True)
    (folder.checkpoints / "submit_000" / "_meta.json").write_text("hidden")
    return folder


def plan(root: Path, start_from: str, exp_id: str = "second") -> Plan:
    given = RunOptions(agent="evolve", entry="e", runs=root / "runs", start_from=start_from, overwrite=True)
    return given.plan(given.settings("toy/line", exp_id), root)


def test_a_start_gets_the_recorded_workspace_and_no_hidden_result(parent: RunFolder, tmp_path: Path) -> None:
    started = plan(tmp_path, f"{RUN}@submit_000")
    assert started.settings.start is not None
    assert started.settings.start.tree == trees.read_tree(parent.root, "submit_000")[1]
    started.claim()
    started.folder.state.mkdir()
    stage_start(find_start(started.start_from, tmp_path), started.folder)
    staging.stage(started.folder, opened(), NO_URLS)
    workspace = started.folder.workspace
    files = {str(path.relative_to(workspace)) for path in workspace.rglob("*") if path.is_file()}
    assert files == {
        "AGENTS.md",
        "history/START.json",
        "history/submit_000/summary.json",
        "notes.md",
        "system/policy.py",
    }
    assert (workspace / "system" / "policy.py").read_text() == "submitted"
    assert "`history/`" in (workspace / "AGENTS.md").read_text()
    recorder = trees.TreeRecorder(workspace, started.folder.trees, started=started.folder.start.exists())
    unchanged = recorder.record("submit_000", bundles.snapshot(started.folder.system), None)
    assert unchanged == started.settings.start.tree


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (RUN, "use the form RUN@submit_NNN"),
        (f"{RUN}@submit_001", "name a submit whose workspace is recorded"),
        ("runs/e/toy_line/none@submit_000", "no run is there"),
    ],
)
def test_a_start_needs_a_recorded_submit(parent: RunFolder, tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        plan(tmp_path, text)


def test_another_users_run_is_no_start(
    parent: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: parent.root.stat().st_uid + 1)
    with pytest.raises(ConfigError, match="belongs to another user"):
        plan(tmp_path, f"{RUN}@submit_000")


def test_a_run_cannot_start_from_itself(parent: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot start from itself"):
        plan(tmp_path, f"{RUN}@submit_000", "first").check_held()
    assert parent.feedback.is_dir()


def test_a_submit_without_feedback_yet_is_no_start(parent: RunFolder, tmp_path: Path) -> None:
    (parent.feedback / "submit_000").rename(parent.feedback / "submit_000.partial")
    with pytest.raises(ConfigError, match="has no feedback yet"):
        plan(tmp_path, f"{RUN}@submit_000")
