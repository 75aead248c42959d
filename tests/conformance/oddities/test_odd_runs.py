"""Whole runs with odd environments: their recordings reach feedback, and `verify` says of each what holds."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from commands import evopolicy, record_in

pytestmark = [pytest.mark.system, pytest.mark.slow]


class Run(NamedTuple):
    """An environment of `package/oddities.py`, and how its run is verified."""

    name: str
    says: str
    code: int = 0
    file: str = ""
    """Further lines of its environment file; empty: it has none."""


RUNS = (
    Run("ChangesItsAction", "episodes: identical"),
    Run("Noise", "episodes: identical"),
    Run(
        "Unseeded",
        "not played again: the environment is marked as not deterministic",
        3,
        "deterministic = false",
    ),
)


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_a_run_with_an_odd_environment_is_recorded_and_verified(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent / "package"))
    env = f"oddities:{run.name}-v0"
    if run.file:
        (tmp_path / "odd.toml").write_text(f'id = "my/odd"\ngymnasium_id = "{env}"\n{run.file}\n')
        env = "odd.toml"
    local = ("--env", env, "--agent", "evolve", "--exp-id", "t", "--runs", "runs", "--state", "state")
    evopolicy(tmp_path, "local", *local, "--budget", "2", "--validation", "1", "--heldout", "1", code=0)
    (file,) = tmp_path.glob("runs/evolve/*/t/run.json")
    record = record_in(file.parent)
    assert record.outcome.status == "completed"
    assert record.versions.env_deterministic is not bool(run.file)
    if run.name == "Noise":
        for path in file.parent.glob("workspace/feedback/submit_*/episodes/ep_*/observations.npz"):
            assert path.stat().st_size > 17 << 20
            assert np.load(path)["observations"].shape == (12, 512, 1024, 3)
    again = evopolicy(tmp_path, "verify", str(file.parent), "--local", "--state", "state", code=run.code)
    assert run.says in again.stdout, again.stdout + again.stderr
