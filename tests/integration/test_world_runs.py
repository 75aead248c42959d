"""A whole run in a world: its key reaches nothing that the agent or the operator can read, and the run can be
verified."""

from __future__ import annotations

import hmac
from pathlib import Path

import pytest
from attacks.leak_search import Needles
from commands import command, evopolicy, record_in, run_dir

pytestmark = pytest.mark.system

WORLD = "gym/acrobot@w1"
CLUSTER = ("--state", "state")


@pytest.mark.timeout(600)
def test_the_key_of_a_world_is_in_no_file_of_a_run(tmp_path: Path) -> None:
    numbers = ("--budget", "3", "--validation", "2", "--heldout", "2")
    with command(
        tmp_path, "local", "--env", WORLD, "--agent", "evolve", "--exp-id", "t", *numbers, *CLUSTER
    ) as running:
        code, out, err = running.finish(500)
    assert code == 0, err
    secret = (tmp_path / "state" / "secret").read_bytes()
    key = hmac.digest(secret, f"world|{WORLD}".encode(), "sha256").hex()[:32]
    needles = Needles()
    needles.add_text("key", key)
    stored = (tmp_path / "state").glob("coordinator.sqlite*")
    assert set().union(*(needles.found_in(each.read_bytes()) for each in stored)) == {"key"}
    files = [each for each in (tmp_path / "runs").rglob("*") if each.is_file()]
    files += [each for each in (tmp_path / "state" / "logs").rglob("*") if each.is_file()]
    assert [each for each in files if needles.found_in(each.read_bytes())] == []
    assert needles.found_in((out + err).encode()) == set()
    folder = run_dir(tmp_path, env="gym_acrobot@w1")
    assert record_in(folder).outcome.status == "completed"
    verified = evopolicy(tmp_path, "verify", str(folder), "--local", *CLUSTER)
    assert verified.returncode == 0, verified.stderr
