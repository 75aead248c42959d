"""`recorded_run`, a run of the built-in agent with a scripted model, is played again by today's version."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import pytest
from commands import command

RECORDED = Path(__file__).parent / "recorded_run"


@pytest.mark.system
def test_the_shipped_recorded_run_is_replayed_to_the_byte(tmp_path: Path) -> None:
    with tarfile.open(RECORDED / "run.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    run = tmp_path / "run"
    again = ["replay", str(run), "--trust", "--data", str(RECORDED / "data"), "--fresh"]
    with command(tmp_path, *again) as running:
        assert running.finish()[:2] == (0, "identical\n"), running.text
    (other,) = (tmp_path / "replayed").glob("*/*/first")
    ours, theirs = (json.loads((each / "run.json").read_bytes()) for each in (run, other))
    assert ours["outcome"]["final_score"] == theirs["outcome"]["final_score"] == -13.0
    assert theirs["replay_of"] == ours["run"] != theirs["run"]
