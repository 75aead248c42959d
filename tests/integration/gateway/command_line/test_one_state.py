"""Local runs share one state: what a user plays belongs together, and an agent without a jail learns nothing of later
runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import SMALL, STILL, agent, command, ended, record_in, run_dir
from waiting import wait_until

from evopolicy_common.messages.environment import Split
from evopolicy_common.records.splits import SPLITS, cases_hash
from evopolicy_coordinator.core.contract.records import KernelRow
from evopolicy_coordinator.splits import derive
from evopolicy_coordinator.storage.store import Store

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(900)]


def played(folder: Path, exp_id: str, *arguments: str) -> tuple[dict[str, str], str]:
    """The cases' hashes of a run of `evopolicy local`, and what the command said on stderr."""
    words = [
        "local",
        "--env",
        "toy/line",
        "--agent",
        "random",
        "--exp-id",
        exp_id,
        *SMALL,
        "--json",
        *arguments,
    ]
    out, err = ended(folder, *words)
    (result,) = json.loads(out)
    versions = record_in(Path(result["run_directory"])).versions
    return {split: versions.cases_hash(split) for split in SPLITS}, err


def kernels(state: Path) -> tuple[KernelRow, ...]:
    """Where the coordinator knows workers to have been."""
    store = Store(state / "coordinator.sqlite")
    try:
        return store.load().kernels
    finally:
        store.close()


STEAL = """
import os
submit([0])
found = {}
for folder, _, files in os.walk(STATE):
    for name in files:
        if "secret" in name:
            with open(os.path.join(folder, name), "rb") as file:
                found[name] = file.read().hex()
with open("system/stolen.json", "w") as file:
    json.dump(found, file)
submit([1])
"""


def test_a_users_runs_share_cases_until_one_without_a_jail(tmp_path: Path) -> None:
    state = tmp_path / "xdg" / "evopolicy" / "local"
    before, note = played(tmp_path, "a")
    assert "note: " not in note
    assert before == played(tmp_path, "b")[0]
    # The first run's worker has ended, and nobody waits for it.
    assert len(kernels(state)) == 1
    ended(tmp_path, "report", "runs", "--out", "report")
    fresh, _ = played(tmp_path, "c", "--fresh")
    assert fresh["heldout"] != before["heldout"]
    assert "--fresh" in ended(tmp_path, "report", "runs", "--out", "report", ends=3)[1]
    steals = agent(tmp_path, f"STATE = {str(state)!r}\n" + STEAL)
    words = [
        "local",
        "--env",
        "toy/line",
        "--agent",
        steals,
        "--entry",
        "thief",
        "--exp-id",
        "s",
        "--jail",
        "none",
    ]
    assert "note: agents of this run have no full jail" in ended(tmp_path, *words, *SMALL)[1]
    thief = run_dir(tmp_path, exp_id="s")
    versions = record_in(thief).versions
    stolen = json.loads((thief / "workspace" / "system" / "stolen.json").read_text())
    assert set(stolen) == {"secret-unjailed"}  # it reads what there is: the secret of its own run
    after, note = played(tmp_path, "d")
    assert "the cases are new from here on" in note
    for split in SPLITS:
        hashes = {before[split], versions.cases_hash(split), after[split]}
        assert len(hashes) == 3, split
    for text in stolen.values():
        known = {known_hash(bytes.fromhex(text), split, after) for split in SPLITS}
        assert not known & {*before.values(), *after.values()}
    # The first run's cases are gone from the secret, not from the state.
    assert "identical" in ended(tmp_path, "verify", str(run_dir(tmp_path, exp_id="a")), "--local")[0]


def known_hash(secret: bytes, split: Split, hashes: dict[str, str]) -> str:
    """The cases of `toy/line` in SMALL runs, as derived from the secret."""
    counts: dict[Split, int] = {"train": 16, "validation": 2, "heldout": 2}
    return f"sha256:{cases_hash(derive(secret, 'toy', 'toy/line', counts)[split])}"


def test_no_run_waits_for_a_killed_one_or_its_workers(tmp_path: Path) -> None:
    waits = agent(tmp_path, "submit([0])\nopen('here', 'w')\ntime.sleep(1000)")
    words = ["local", "--env", "toy/line", "--agent", waits, "--entry", "waits", "--exp-id", "t", *SMALL]
    with command(tmp_path, *words) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        running.kill()
    assert len(kernels(tmp_path / "xdg" / "evopolicy" / "local")) == 1
    played(tmp_path, "after")
    assert len(kernels(tmp_path / "xdg" / "evopolicy" / "local")) == 1


def test_state_and_fresh_do_not_go_together(tmp_path: Path) -> None:
    words = ("try", STILL, "--env", "toy/line", "--fresh", "--state", "x")
    assert "give only one of them" in ended(tmp_path, *words, ends=2)[1]
    words = ("try", "examples", "--env", "toy/line", "--credentials", "x", "--set", "env_timeout=5")
    assert "to each evopolicy-worker" in ended(tmp_path, *words, ends=2)[1]
