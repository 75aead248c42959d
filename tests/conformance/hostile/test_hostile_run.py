"""The breakers as submits of one run: a worker of two slots gives each its verdict, then plays an honest policy as
ever.

While one is played, another's hidden episodes are: hostile policies are beside each other all the time.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from breakers import BREAKERS, PATIENT
from slots import HONEST

pytestmark = pytest.mark.system

PLAYED = [attack for attack in BREAKERS if attack.limits == PATIENT]
SOURCES = {attack.name: attack.source for attack in PLAYED}
VERDICTS = {attack.name: attack.verdict for attack in PLAYED}
AGENT = """
import json, os, sys, urllib.request

for source in json.load(open(sys.argv[1])):
    with open("system/policy.py", "w") as file:
        file.write(source)
    # Not alone, so that an episode follows in the same slot; ids as they come: the second is played anew.
    body = json.dumps({"env_instances": [0, 1]}).encode()
    urllib.request.urlopen(urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=body)).read()
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run's folder; its last submit, and its first, are the honest policy."""
    root = tmp_path_factory.mktemp("run")
    sources = [HONEST, *SOURCES.values(), HONEST]
    agent, attacks = root / "agent.py", root / "attacks.json"
    agent.write_text(AGENT)
    attacks.write_text(json.dumps(sources))
    command = [sys.executable, "-m", "evopolicy_gateway.cli", "local", "--env", "toy/line", "--slots", "2"]
    command += ["--budget", str(2 * len(sources)), "--validation", "1", "--heldout", "1", "--jail", "none"]
    # With a package, so that those who need it are among them; without one they are played in test_hostile_policies.py.
    command += ["--policy-package", "scipy"]
    command += ["--agent", f"command:{sys.executable} {agent} {attacks}", "--runs", str(root / "runs")]
    for name, value in msgspec.structs.asdict(PATIENT).items():
        if value is not None:
            command += ["--limit", f"{name}={value}"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next((root / "runs").glob("*/*/*/run.json")).parent


def submits(run: Path) -> list[Path]:
    return sorted((run / "workspace/feedback").glob("submit_*"))


def summary(submit: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((submit / "summary.json").read_text())
    return found


def category(submit: Path) -> str | None:
    """Of its first episode; of the submit itself where the bundle yields no policy."""
    status = str(summary(submit)["status"])
    if status != "ok":
        return status
    errors = sorted(submit.glob("episodes/*/error.txt"))
    found = [json.loads(path.read_text())["category"] for path in errors]
    assert len(set(found)) <= 1
    assert len(found) in (0, 2), "both episodes are of the same policy"
    return found[0] if found else None


def test_every_attack_gets_its_verdict_through_worker_and_coordinator(run: Path) -> None:
    _, *hostile, _ = submits(run)
    assert {name: category(submit) for name, submit in zip(SOURCES, hostile, strict=True)} == VERDICTS


def test_the_worker_plays_an_honest_policy_after_all_of_them_as_before(run: Path) -> None:
    first, *_, last = submits(run)
    for name in ("status", "returns", "episode_lengths", "errors"):
        assert summary(first)[name] == summary(last)[name]
    rows = [(submit / "episodes").glob("*/trajectory.jsonl") for submit in (first, last)]
    assert [path.read_bytes() for path in sorted(rows[0])] == [path.read_bytes() for path in sorted(rows[1])]


def test_no_attack_was_taken_for_a_failure_of_ours(run: Path) -> None:
    """Attack: ends itself, its sandbox, or its environment after bad luck, to be played again. Defence:
    every end that it can cause is its result; after a restart, the actions that it returned remain
    valid (table in `docs/explanation/hostile-policies.md`)."""
    outcome = json.loads((run / "run.json").read_text())["outcome"]
    assert outcome["status"] == "completed"
    assert outcome["quarantined_submits"] == []
    assert outcome["auxiliary"]["infrastructure_retries"] == 0
