"""`evopolicy-coordinator accept-worlds` tries candidates in order; a repeated command continues."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from evopolicy_common.catalogue.worlds import CANDIDATES
from evopolicy_coordinator import worlds
from evopolicy_coordinator.splits import SECRET
from evopolicy_coordinator.worlds import JOURNAL, Base, Candidate, key_of

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]


def accept(folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "evopolicy_coordinator.cli", "accept-worlds", "--state", "state", *more]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=500, check=False)


@pytest.mark.timeout(900)
def test_a_repeated_command_completes_the_same_journal(tmp_path: Path) -> None:
    wanted = ("gym/continuouscar", "--policies", str(ROOT / "examples" / "policies"))
    played = accept(tmp_path, *wanted)
    assert played.returncode == 0, played.stderr
    state = tmp_path / "state"
    journal = (state / JOURNAL).read_bytes()
    base, *tried = worlds.read_journal(state / JOURNAL)
    assert isinstance(base, Base)
    assert base.random is not None
    assert base.canonical is not None
    assert base.canonical > base.random
    candidates = [each for each in tried if isinstance(each, Candidate)]
    assert [each.number for each in candidates] == list(range(len(tried)))
    for each in candidates:
        assert each.accepted == (
            worlds.loses(base, each.canonical)
            and each.ceiling is not None
            and worlds.reaches(base, each.ceiling)
        )
        assert (each.ceiling is not None) == worlds.loses(base, each.canonical)
    assert len(tried) == CANDIDATES or sum(each.accepted for each in candidates) == 3
    root = key_of((state / SECRET).read_bytes(), "gym/continuouscar", 0).partition("-")[0]
    assert root not in played.stdout + played.stderr + journal.decode()

    (state / JOURNAL).write_bytes(b"".join(journal.splitlines(keepends=True)[:-1]))
    assert accept(tmp_path, *wanted).returncode == 0
    assert (state / JOURNAL).read_bytes() == journal

    other = tmp_path / "policies" / "gym_continuouscar"
    other.mkdir(parents=True)
    (other / "policy.py").write_text("class Policy:\n    pass\n")
    refused = accept(tmp_path, "gym/continuouscar", "--policies", "policies")
    assert refused.returncode == 2
    assert "is not the policy" in refused.stderr


@pytest.mark.timeout(300)
def test_an_environment_without_a_policy_is_told_and_not_accepted(tmp_path: Path) -> None:
    played = accept(tmp_path, "gym/continuouscar", "--policies", ".")
    assert played.returncode == 0, played.stderr
    assert "no policy is known, so no world is accepted" in played.stdout
    assert [type(each) for each in worlds.read_journal(tmp_path / "state" / JOURNAL)] == [Base]


def test_nothing_is_tried_without_a_folder_of_policies(tmp_path: Path) -> None:
    refused = accept(tmp_path, "gym/continuouscar")
    assert (refused.returncode, [*tmp_path.iterdir()]) == (2, [])
    assert "--policies" in refused.stderr
