"""The workspace at a submit as a tree: what it takes, what it omits, and what a start gets from it.

Attacks, each with its defence:
- floods the record of its workspace, puts links, pipes or keys into it: regular files only, opened without
  following links; files with keys are left out; files and bytes are bounded, and recording fails no submit.
- leaves links to hidden results in what a later run starts from: tree and history hold regular files only;
  the final `workspace/system/` is not read.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from evopolicy_common.errors import ConfigError, StorageError
from evopolicy_common.records.blobs import BlobStore, digest_of
from evopolicy_common.records.policies import bundles, trees
from evopolicy_common.records.policies.trees import Tree, TreeFile, TreeRecorder
from evopolicy_common.records.secrets import Passed

KEY = "sk-live-4f8a1c9d7e2b6a3f0c5d"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder with a workspace, and beside its reach a home with a login."""
    workspace = tmp_path / "workspace"
    (workspace / "system").mkdir(parents=True)
    (workspace / "feedback" / "submit_000").mkdir(parents=True)
    (workspace / "AGENTS.md").write_text("rules")
    (workspace / "system" / "policy.py").write_text("class Policy: ...\n")
    (workspace / "notes.md").write_text("gain 0.3")
    (tmp_path / ".gateway" / "agent" / "home").mkdir(parents=True)
    (tmp_path / ".gateway" / "agent" / "home" / "auth.json").write_text(KEY)
    return tmp_path


def recorded(run: Path, recorder: TreeRecorder | None = None, passed: Passed | None = None) -> Tree:
    recorder = recorder or TreeRecorder(run / "workspace", run / "trees")
    digest = recorder.record("submit_000", bundles.snapshot(run / "workspace" / "system"), passed)
    tree, again = trees.read_tree(run, "submit_000")
    assert again == digest
    return tree


def paths(tree: Tree) -> list[str]:
    return [file.path for file in tree.files]


def test_a_tree_has_the_agents_files_and_restores_them(run: Path, tmp_path: Path) -> None:
    (run / "workspace" / "run.sh").write_text("#!/bin/sh\n")
    (run / "workspace" / "run.sh").chmod(0o755)
    tree = recorded(run)
    assert paths(tree) == ["notes.md", "run.sh", "system/policy.py"]
    assert tree.n_omitted == 0
    trees.restore(run, tree, tmp_path / "new")
    assert (tmp_path / "new" / "notes.md").read_text() == "gain 0.3"
    assert os.access(tmp_path / "new" / "run.sh", os.X_OK)


def test_equal_contents_are_stored_once_and_changed_ones_anew(run: Path) -> None:
    recorder = TreeRecorder(run / "workspace", run / "trees")
    (run / "workspace" / "copy.md").write_text("gain 0.3")
    recorded(run, recorder)
    assert len(list(BlobStore(run / "trees").digests())) == 2
    (run / "workspace" / "notes.md").write_text("gain 0.4")
    tree = recorded(run, recorder)
    assert len(list(BlobStore(run / "trees").digests())) == 3
    assert {file.path: file.blob for file in tree.files}["notes.md"] == digest_of(b"gain 0.4")


def test_an_unchanged_file_is_not_read_again(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = TreeRecorder(run / "workspace", run / "trees")
    monkeypatch.setattr(trees, "_SETTLED_NS", -(10**10))  # as if it were old
    first = recorded(run, recorder)
    monkeypatch.setattr(trees, "digest_of", lambda data: "0" * 64)
    recorder.record("submit_001", None, None)
    again = msgspec.json.decode((run / "trees" / "submit_001.json").read_bytes(), type=Tree)
    assert again.files[0] == first.files[0]


def test_the_policy_is_the_submitted_bundles(run: Path) -> None:
    bundle = bundles.snapshot(run / "workspace" / "system")
    (run / "workspace" / "system" / "policy.py").write_text("changed meanwhile")
    TreeRecorder(run / "workspace", run / "trees").record("submit_000", bundle, None)
    tree, _ = trees.read_tree(run, "submit_000")
    assert {file.path: file.blob for file in tree.files}["system/policy.py"] == digest_of(
        b"class Policy: ...\n"
    )


@pytest.mark.parametrize(
    "how", ["link", "linked folder", "hard link", "pipe", "key", "passed value", "history"]
)
def test_what_is_not_the_agents_to_show_is_omitted(run: Path, how: str) -> None:
    home, workspace = run / ".gateway" / "agent" / "home", run / "workspace"
    passed = Passed(key="ab" * 32).with_values(["a-value-without-a-known-look"])
    x = workspace / "x"
    {
        "link": lambda: x.symlink_to(home / "auth.json"),
        "linked folder": lambda: x.symlink_to(home),
        "hard link": lambda: os.link(home / "auth.json", x),
        "pipe": lambda: os.mkfifo(x),
        "key": lambda: x.write_text(f'{{"token": "{KEY}"}}'),
        "passed value": lambda: x.write_text("login a-value-without-a-known-look"),
        "history": lambda: (workspace / "history").mkdir(),
    }[how]()
    tree = recorded(run, passed=passed)
    assert paths(tree) == ["notes.md", "system/policy.py"]
    assert list(tree.omitted) == ["history" if how == "history" else "x"]
    assert tree.n_omitted == 1
    stored = b"".join(path.read_bytes() for path in (run / "trees").rglob("*") if path.is_file())
    assert KEY.encode() not in stored


def test_a_flood_is_bounded_and_keeps_the_policy(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trees, "MAX_FILES", 50)
    monkeypatch.setattr(trees, "MAX_STORED_BYTES", 60_000)
    monkeypatch.setattr(trees, "MAX_FILE_BYTES", 20_000)
    workspace = run / "workspace"
    (workspace / "flood").mkdir()
    for n in range(70):
        (workspace / "flood" / f"{n:03}").write_bytes(bytes(1000) + str(n).encode())
    with (workspace / "sparse").open("wb") as file:
        file.truncate(1 << 40)
    recorder = TreeRecorder(workspace, run / "trees")
    for _ in range(40):
        (workspace / "changed").write_bytes(os.urandom(1900))
        tree = recorded(run, recorder)
    assert {file.path: file.blob for file in tree.files}["system/policy.py"]
    assert len(tree.files) <= 50
    assert tree.n_omitted > 20
    stored = BlobStore(run / "trees")
    assert sum(stored.size(digest) for digest in stored.digests()) <= 60_000
    (workspace / "endless").mkdir()
    for n in range(120):
        (workspace / "endless" / str(n)).mkdir()
    assert "system/policy.py" in paths(recorded(run, recorder))


def test_a_new_process_counts_what_is_stored(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded(run)
    monkeypatch.setattr(trees, "MAX_STORED_BYTES", 30)
    (run / "workspace" / "more").write_text("x" * 10)
    assert recorded(run).omitted == {"more": "the run's trees hold 30 bytes"}


@pytest.mark.parametrize(
    "file",
    [
        TreeFile("../run.json", "0" * 64, 1),
        TreeFile("/etc/passwd", "0" * 64, 1),
        TreeFile("AGENTS.md", "0" * 64, 1),
        TreeFile("history/submit_000/summary.json", "0" * 64, 1),
        TreeFile("big", "0" * 64, 1 << 40),
    ],
)
def test_a_forged_tree_is_refused(run: Path, file: TreeFile) -> None:
    recorded(run)
    (run / "trees" / "submit_000.json").write_bytes(msgspec.json.encode(Tree(files=(file,))))
    with pytest.raises(ConfigError, match="name a submit whose workspace is recorded"):
        trees.read_tree(run, "submit_000")


@pytest.mark.parametrize("blob", ["0" * 64, "../../../../etc/passwd"])
def test_a_missing_or_odd_content_is_an_error(run: Path, tmp_path: Path, blob: str) -> None:
    recorded(run)
    with pytest.raises(StorageError, match="cannot restore x"):
        trees.restore(run, Tree(files=(TreeFile("x", blob, 1),)), tmp_path / "new")


def test_the_history_has_feedback_up_to_the_submit_and_no_links(run: Path, tmp_path: Path) -> None:
    feedback = run / "workspace" / "feedback"
    (run / "run.json").write_text("hidden scores")
    for name in ("submit_000", "submit_001", "submit_002", "submit_003.partial"):
        (feedback / name).mkdir(exist_ok=True)
        (feedback / name / "summary.json").write_text(name)
    (feedback / "submit_001" / "run.json").symlink_to(run / "run.json")
    (feedback / "submit_001" / "episodes").symlink_to(run)
    earlier = run / "workspace" / "history"
    (earlier / "submit_000").mkdir(parents=True)
    (earlier / "submit_000" / "summary.json").write_text("of its own parent")
    to = tmp_path / "child" / "history"
    omitted = trees.copy_history(feedback, earlier, 1, to)
    found = {str(path.relative_to(to)): path.read_text() for path in to.rglob("*") if path.is_file()}
    assert found == {
        "submit_000/summary.json": "submit_000",
        "submit_001/summary.json": "submit_001",
        "earlier/submit_000/summary.json": "of its own parent",
    }
    assert sorted(omitted) == ["submit_001/episodes", "submit_001/run.json"]
    assert (to / "submit_000" / "summary.json").stat().st_mode & 0o222 == 0


def test_changes_of_the_workspace_are_named(run: Path) -> None:
    recorder = TreeRecorder(run / "workspace", run / "trees")
    (run / "workspace" / "log").write_text("1")
    recorder.record("submit_000", None, None)
    assert trees.changes(run, 0) == "new log, notes.md"
    (run / "workspace" / "notes.md").unlink()
    (run / "workspace" / "log").write_text("2")
    (run / "workspace" / "new.md").symlink_to("log")
    (run / "workspace" / "system" / "policy.py").write_text("class Policy: pass\n")
    recorder.record("submit_001", None, None)
    assert trees.changes(run, 1) == "changed log; removed notes.md; 1 not recorded"
    assert trees.changes(run / "elsewhere", 1) == ""
