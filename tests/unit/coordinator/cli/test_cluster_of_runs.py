"""Commands on finished runs: which local cluster they start."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from program_runs import run_python

from evopolicy_results.cli.cluster import Where


def _sweep(folder: Path) -> Path:
    state = folder / "sweep" / ".cluster"
    state.mkdir(parents=True)
    (state / "coordinator.sqlite").touch()
    return folder / "sweep"


@pytest.mark.parametrize("given", [".", "agent/gym_acrobot/0", ".."])
def test_a_sweep_with_its_own_cluster_is_named_with_the_option(
    tmp_path: Path, given: str, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = _sweep(tmp_path)
    (sweep / "agent/gym_acrobot/0").mkdir(parents=True)
    with pytest.raises(SystemExit):
        Where(None, None, True, None, runs=[sweep / given])
    assert f"add --state {sweep}/.cluster\n" in capsys.readouterr().err


def test_named_states_and_running_clusters_are_taken_as_they_are(tmp_path: Path) -> None:
    sweep = _sweep(tmp_path)
    alone = tmp_path / "runs" / "evolve"
    alone.mkdir(parents=True)
    assert Where(None, None, True, None, runs=[alone]).state is None
    assert Where(None, None, True, sweep / ".cluster", runs=[sweep]).state == sweep / ".cluster"
    assert not Where(["tls/host:7447"], None, False, None, runs=[sweep]).local


def test_another_users_folder_beside_the_runs_does_not_end_the_command() -> None:
    program = """
import os, sys
from pathlib import Path
from evopolicy_results.cli.cluster import Where

if os.getuid() == 0:
    os.setuid(65534)
Where(None, None, True, None, runs=[Path(sys.argv[1])])
"""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        Path(folder, "others").mkdir(mode=0)
        done = run_python(program, folder)
    assert done.returncode == 0, done.stderr
