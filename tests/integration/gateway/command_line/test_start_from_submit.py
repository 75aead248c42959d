"""`evopolicy run --start-from RUN@submit_NNN` on a cluster: a run of its own, from where another one was."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import SMALL, agent, evopolicy, record_in, run_dir

from evopolicy_common.records.policies import trees

pytestmark = pytest.mark.system

PARENT = """
for gain in range(3):
    with open("system/policy.py", "a") as file:
        file.write(f"\\n# edit {gain}\\n")
    open("notes.md", "a").write(f"note {gain}\\n")
    os.path.lexists("link") or os.symlink("/proc/self/environ", "link")
    submit([gain, gain + 1])
"""
CHILD = """
import pathlib

files = {
    str(path): path.read_text(errors="replace") for path in pathlib.Path(".").rglob("*") if path.is_file()
}
tried = []
for path in ("history/submit_000/summary.json", "history/new"):
    try:
        open(path, "w").write("forged")
        tried.append(path)
    except OSError:
        pass
json.dump({"found": files, "written": tried}, open("seen.json", "w"))
submit([0, 1, 2, 3, 4, 5])
"""


def run(root: Path, file: Path, exp_id: str, code: str, *more: str) -> Any:
    given = (
        "run",
        "--env",
        "toy/line",
        "--agent",
        agent(root, code),
        *SMALL,
        "--exp-id",
        exp_id,
        "--entry",
        "e",
    )
    return evopolicy(root, *given, "--credentials", str(file), *more)


@pytest.fixture(scope="module")
def parent(operator_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run with three submits, below `runs` in its parent folder."""
    root = tmp_path_factory.mktemp("p")
    played = run(root, operator_file, "first", PARENT)
    assert played.returncode == 0, played.stderr
    return run_dir(root, exp_id="first")


@pytest.fixture(scope="module")
def child(parent: Path, operator_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("c")
    played = run(root, operator_file, "second", CHILD, "--start-from", f"{parent}@submit_001")
    assert played.returncode == 0, played.stderr
    return run_dir(root, exp_id="second")


def seen(child: Path) -> dict[str, Any]:
    files: dict[str, Any] = json.loads((child / "workspace" / "seen.json").read_text())
    return files


def test_each_submit_of_a_run_has_a_tree_that_its_record_names(parent: Path) -> None:
    files = {name: trees.read_tree(parent, f"submit_00{name}") for name in record_in(parent).trees}
    assert sorted(files) == ["0", "1", "2"]
    assert record_in(parent).trees == {name: digest for name, (_, digest) in files.items()}
    assert [file.path for file in files["2"][0].files] == ["notes.md", "system/policy.py"]
    assert list(files["2"][0].omitted) == ["link"]


def test_a_start_has_the_workspace_of_that_submit(child: Path) -> None:
    files = seen(child)["found"]
    assert files["notes.md"] == "note 0\nnote 1\n"
    assert "# edit 1" in files["system/policy.py"]
    assert "# edit 2" not in files["system/policy.py"]
    assert "`history/`" in files["AGENTS.md"]
    assert not [path for path in files if path.startswith("feedback/")]


def test_the_history_is_no_part_of_the_tree(child: Path) -> None:
    tree, _ = trees.read_tree(child, "submit_000")
    assert [file.path for file in tree.files] == ["notes.md", "seen.json", "system/policy.py"]
    assert (dict(tree.omitted), tree.n_omitted) == ({}, 0)


def test_the_history_is_the_feedback_up_to_that_submit_read_only(parent: Path, child: Path) -> None:
    files = seen(child)["found"]
    for name in ("submit_000", "submit_001"):
        path = Path(name) / "summary.json"
        assert files[f"history/{path}"] == (parent / "workspace" / "feedback" / path).read_text()
    assert not [path for path in files if path.startswith("history/submit_002")]
    assert seen(child)["written"] == []


def test_no_hidden_result_of_the_parent_reaches_a_start(parent: Path, child: Path) -> None:
    outcome = record_in(parent).outcome
    assert outcome.heldout_returns
    assert outcome.val_scores
    hidden = [outcome.heldout_mean_return, *outcome.val_scores.values()]
    train = " ".join(text for path, text in seen(child)["found"].items() if "trajectory" not in path)
    assert not [
        score for score in hidden if score is not None and score != int(score) and repr(score) in train
    ]
    assert not [path for path in seen(child)["found"] if "metrics.json" in path or "run.json" in path]


def test_the_record_has_the_lineage_and_a_full_budget(parent: Path, child: Path) -> None:
    start = record_in(child).start
    assert start is not None
    assert (start.run, start.submit_index) == (record_in(parent).run, 1)
    assert start.tree == record_in(parent).trees["1"]
    assert start.parent_scored
    assert record_in(child).outcome.budget_used == 6
    assert record_in(parent).start is None


def test_a_changed_tree_is_refused_without_a_folder(
    parent: Path, operator_file: Path, tmp_path: Path
) -> None:
    forged = tmp_path / "forged"
    shutil.copytree(parent, forged)
    manifest = forged / "trees" / "submit_001.json"
    manifest.write_bytes(manifest.read_bytes().replace(b"notes.md", b"notez.md"))
    played = run(tmp_path, operator_file, "third", CHILD, "--start-from", f"{forged}@submit_001")
    assert played.returncode != 0
    assert "is not the one recorded at the submit" in " ".join(played.stderr.split())
    assert not list((tmp_path / "runs").rglob("run.json"))


def test_a_run_cannot_start_from_itself_or_from_nothing(parent: Path, operator_file: Path) -> None:
    root = parent.parents[3]
    for text, why in (
        (f"{parent}@submit_001", "cannot start from itself"),
        (f"{parent}@submit_009", "name a submit whose workspace is recorded"),
        (f"{parent}", "use the form RUN@submit_NNN"),
    ):
        played = run(root, operator_file, "first", CHILD, "--overwrite", "--start-from", text)
        assert played.returncode == 2, played.stderr
        assert why in " ".join(played.stderr.split())
    assert record_in(parent).outcome.status == "completed"
