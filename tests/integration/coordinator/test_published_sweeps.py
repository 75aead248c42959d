"""A sweep is published as it is: failed runs too, without what is no finished run, which the output names by folder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import evopolicy

pytestmark = pytest.mark.system

SWEEP = """
name = "sweep"
environments = ["toy/line"]
[defaults]
budget = 2
validation = 1
heldout = 2
[[agents]]
agent = "random"
name = "good"
[[agents]]
agent = "command:false"
name = "bad"
"""


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sweep")
    (root / "sweep.toml").write_text(SWEEP)
    done = evopolicy(root, "suite", "sweep.toml", "--local")
    assert "1 failed" in done.stdout + done.stderr, done.stdout + done.stderr
    return root


def publish(root: Path, out: str, *args: str) -> tuple[int, str]:
    state = ("--local", "--state", "runs/sweep/.cluster")
    done = evopolicy(root, "publish", "runs/sweep", "--out", out, *state, *args)
    return done.returncode, done.stdout + done.stderr


def test_a_sweep_with_failed_unfinished_and_replaced_runs_is_published(sweep: Path) -> None:
    stuck = sweep / "runs/sweep/stuck/toy_line/sweep-0"
    for folder in ("workspace", "logs", ".gateway"):
        (stuck / folder).mkdir(parents=True)
    (stuck / ".gateway/intended.json").write_text('{"run": "r-1"}')
    good = sweep / "runs/sweep/good/toy_line/sweep-0"
    shutil.copytree(good, sweep / "runs/sweep/.attempts/good/toy_line/sweep-0.1")
    shutil.copytree(good, sweep / "runs/sweep/good/toy_line/copy")
    code, text = publish(sweep, "all.evp")
    assert code == 0, text
    assert "2 runs," in text
    for folder, why in (
        ("stuck/toy_line/sweep-0", "the run did not finish: it has no run.json"),
        (".attempts/good/toy_line/sweep-0.1", "another attempt replaced it"),
        ("good/toy_line/sweep-0", "it repeats the run in"),
    ):
        assert any(f"{folder}: {why}" in line for line in text.splitlines() if line.startswith("left out: "))
    assert "of these entries and their starts are here; 3 folders were left out" in text
    evopolicy(sweep, "check", "all.evp", "--replay", "all", code=0)
    shutil.rmtree(stuck)


def test_a_run_of_another_coordinator_is_named_by_its_folder(sweep: Path) -> None:
    good = sweep / "runs/sweep/good/toy_line/sweep-0"
    strange = sweep / "runs/sweep/strange/toy_line/sweep-0"
    shutil.copytree(good, strange)
    record = json.loads((strange / "run.json").read_text())
    (strange / "run.json").write_text(json.dumps(record | {"run": "r-0123456789abcdef"}))
    code, text = publish(sweep, "strange.evp")
    assert code != 0
    assert str(strange) in text
    assert not (sweep / "strange.evp").exists()
    shutil.rmtree(strange)


def test_folders_without_a_run_are_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = evopolicy(tmp_path, "publish", "empty", "--out", "x.evp", "--local", "--state", "st")
    assert done.returncode == 2
    assert f"{'empty'}: no run directory in it or below" in done.stderr
