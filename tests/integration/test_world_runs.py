"""A whole run in a world: neither its key nor a parameter reaches anything that the agent or the operator
can read, and the run can be verified.

Attacks, each with its defence:
- looks for the rules of a world before it plays: they follow from a key in the options of its cases, which no
  gateway, run folder, or log gets; spaces and texts are equal for all keys, and the journal of candidates has
  neither key nor rules.
"""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path

import pytest
from attacks.leak_search import Needles
from commands import command, evopolicy, record_in, run_dir

from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.worlds.rules import FACTORS, Rules
from evopolicy_coordinator.worlds import key_of
from evopolicy_worker import environments

pytestmark = pytest.mark.system

WORLD = "gym/acrobot@w1"
CLUSTER = ("--state", "state")


@pytest.mark.timeout(600)
def test_secrets_of_a_world_are_in_no_file_of_a_run(tmp_path: Path) -> None:
    described = environments.make(WORLD).description
    given = described.obs_space, described.action_space, tuple(described.definition["parameters"])
    secrets = (hashlib.sha256(str(n).encode()).digest() for n in range(1000))
    secret, factors = next(
        (each, found)
        for each in secrets
        if (found := Rules(key_of(each, WORLD, 0), *given).factors)
        and {min(FACTORS), max(FACTORS)}.isdisjoint(found.values())  # which the definition names
    )
    (tmp_path / "state").mkdir(mode=0o700)
    write_atomically(tmp_path / "state" / "secret", secret, mode=0o600)
    numbers = ("--budget", "3", "--validation", "2", "--heldout", "2")
    with command(
        tmp_path, "local", "--env", WORLD, "--agent", "evolve", "--exp-id", "t", *numbers, *CLUSTER
    ) as running:
        code, out, err = running.finish(500)
    assert code == 0, err
    assert (tmp_path / "state" / "secret").read_bytes() == secret
    key = key_of(secret, WORLD, 0).partition("-")[0]
    needles = Needles()
    needles.add_text("key", key)
    for name, factor in factors.items():
        # Fewer digits would be found by chance in this many observations.
        needles.add_text(name, repr(factor))
        needles.add_text(name, f"{factor:.12g}")
        needles._add(name, struct.pack("<d", factor), struct.pack(">d", factor))
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
