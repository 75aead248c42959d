"""`evopolicy local`: a cluster of its own comes up, plays and goes, however the command ends."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path

import pytest
from commands import SMALL, agent, command, ended, record_in, run_dir
from waiting import wait_until

from evopolicy_common.processes import scratch
from evopolicy_common.records.policies.checkpoints import read_meta
from evopolicy_common.records.secrets import PASSED, read_passed
from evopolicy_common.records.summary import decode_summary

pytestmark = pytest.mark.system


def test_local_plays_a_whole_run_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with command(
        tmp_path, "local", "--env", "toy/line", "--agent", "evolve", "--exp-id", "t", *SMALL, "--json"
    ) as running:
        code, out, err = running.finish()
        assert code == 0, err
        assert running.alive() == []
    folder = run_dir(tmp_path)
    (result,) = json.loads(out)
    record = record_in(folder)
    assert result["run_directory"] == str(folder)
    assert result["final_score"] == record.outcome.final_score == record.outcome.heldout_mean_return
    assert record.outcome.status == "completed"
    assert record.outcome.closed_reason == "budget_spent"
    assert record.outcome.budget_used == 6
    assert len(record.outcome.heldout_returns) == 2
    assert record.outcome.random_reference is not None
    assert record.agent.harness == record.agent.entry == "evolve"
    assert record.versions.fingerprint["numpy"]
    entries = {path.name for path in folder.iterdir()}
    assert entries == {PASSED, "checkpoints", "logs", "run.json", "trees", "workspace"}
    # Digests of what the agent got by the tests' `--jail-env`, and of nothing else.
    passed = read_passed(folder)
    assert passed is not None
    assert len(passed.values) == 1
    assert [*passed.places(running.mark.encode())] == [(0, len(running.mark))]
    best = folder / "checkpoints" / f"submit_{record.outcome.best_submit_index:03d}"
    assert (best / "policy.py").read_bytes() == (folder / "workspace/system/policy.py").read_bytes()
    meta = read_meta(best)
    assert meta is not None
    assert record.outcome.val_scores is not None
    assert meta.val_mean == record.outcome.val_scores[str(record.outcome.best_submit_index)]
    summary = decode_summary((folder / "workspace/feedback/submit_000/summary.json").read_bytes())
    assert summary.env == "toy/line"
    assert "submit_000 ok" in err
    for line in (folder / "logs" / "harness.log").read_text().splitlines():
        assert json.loads(line)["event"]


@pytest.mark.parametrize(
    "jail", ["--jail none", "--jail open-network --jail-env http_proxy", "--jail-env http_proxy"]
)
def test_the_operators_proxy_is_not_used_for_submits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jail: str
) -> None:
    """In each mode of the jail, with a proxy that answers nobody."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    monkeypatch.setenv("NO_PROXY", "intranet.example")
    one = agent(tmp_path, "assert 'summary' in submit([0, 1, 2, 3, 4, 5])\nprint(os.environ['no_proxy'])")
    ended(tmp_path, "local", "--env", "toy/line", "--agent", one, "--exp-id", "t", *jail.split(), *SMALL)
    assert record_in(run_dir(tmp_path)).outcome.budget_used == 6
    shown = (run_dir(tmp_path) / "logs" / "agent.jsonl").read_text()
    assert ("intranet.example,127.0.0.1" in shown) == (jail == "--jail none")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_local_command_takes_everything_down(tmp_path: Path, number: signal.Signals) -> None:
    waits = agent(tmp_path, "submit([0])\nopen('here', 'w')\ntime.sleep(1000)")
    arguments = ["local", "--env", "toy/line", "--agent", waits, "--exp-id", "t", *SMALL]
    with command(tmp_path, *arguments) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        running.process.send_signal(number)
        code, _, err = running.finish()
        assert code == 130
        assert (
            err.splitlines()[-1]
            == "error: interrupted; runs whose agent was at work are cancelled and cannot be resumed"
        )
        assert "Traceback" not in err
        assert running.alive() == []
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.status, outcome.closed_reason) == ("cancelled", "cancelled")
    assert outcome.error == "interrupted by you (Ctrl-C or SIGTERM)"
    assert not (run_dir(tmp_path) / ".gateway").exists()


def test_a_killed_local_command_takes_everything_with_it(tmp_path: Path) -> None:
    waits = agent(tmp_path, "submit([0])\nopen('here', 'w')\ntime.sleep(1000)")
    arguments = ["local", "--env", "toy/line", "--agent", waits, "--exp-id", "t", "--fresh", *SMALL]
    with command(tmp_path, *arguments) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        below = running.alive()
        assert len(below) >= 5
        states = [state for pid in below if (state := state_folder(pid)) is not None]
        running.process.kill()
        wait_until(lambda: not running.alive())
    # Files that a killed command could not clear away go at the next start.
    assert Path(states[0]).is_dir()
    scratch.clear_stale("local")
    assert not Path(states[0]).exists()


def state_folder(pid: int) -> str | None:
    """The `--state` that a coordinator's process was started with."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    return words[words.index("--state") + 1] if "evopolicy_coordinator.cli" in words else None


def test_feedback_is_the_same_with_one_slot_and_with_two(tmp_path: Path) -> None:
    (tmp_path / "given").mkdir()
    (tmp_path / "given" / "policy.py").write_text(
        "class Policy:\n"
        "  def __init__(self, *a): pass\n"
        "  def reset(self, i): self.i = i; print('episode', i)\n"
        "  def act(self, obs): return [obs[2] - obs[0]] if self.i != 2 else {'not': 'an action'}\n"
    )
    trees = []
    for slots in ("1", "2"):
        arguments = ["local", "--env", "toy/line", "--agent", "replay:given", "--exp-id", f"s{slots}", *SMALL]
        more = ["--slots", slots, "--state", str(tmp_path / "state"), "--set", "max_episodes=6"]
        ended(tmp_path, *arguments, *more)
        feedback = run_dir(tmp_path, exp_id=f"s{slots}") / "workspace" / "feedback"
        trees.append(
            {path.relative_to(feedback): timeless(path) for path in feedback.rglob("*") if path.is_file()}
        )
    assert trees[0] == trees[1]
    assert len(trees[0]) >= 1 + 6 * 3


def timeless(path: Path) -> bytes:
    """A feedback file without what tells the time."""
    return re.sub(rb'"(timestamp|submit_\w+_at|wall_time_seconds)": ?[^,}\n]+', b"", path.read_bytes())
