"""An operator cancels a run while its agent is at work: everybody is told so, and nobody is told anything else."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import Command, agent, command, record_in, run_arguments, run_dir
from waiting import wait_until

from evopolicy_gateway.run_folder.layout import RunFolder

pytestmark = pytest.mark.system

SLOW = """
open("system/policy.py", "w").write(
    "import time\\n"
    "class Policy:\\n"
    "  def __init__(self, *a): pass\\n"
    "  def reset(self, i): pass\\n"
    "  def act(self, obs): time.sleep(0.5); return [0.0]\\n"
)
open("submitting", "w").close()
answers = [submit([0, 1, 2])]
open("first.json", "w").write(json.dumps(answers))
answers.append(submit([0]))
answers.append(json.load(urllib.request.urlopen(os.environ["EVOPOLICYGYM_INFO_URL"])))
open("answers.json.new", "w").write(json.dumps(answers))
os.rename("answers.json.new", "answers.json")
time.sleep(1000)
"""


@pytest.fixture
def cancelled(operator_file: Path, tmp_path: Path) -> Iterator[Command]:
    """`evopolicy run` whose run was cancelled while its first submit was played."""
    with command(tmp_path, *run_arguments(operator_file, agent(tmp_path, SLOW))) as running:
        partial = "runs/*/toy_line/t/workspace/feedback/submit_000.partial"
        wait_until(lambda: [*tmp_path.glob(partial)], lambda: running.text)
        cancel(operator_file, tmp_path)
        yield running


def cancel(operator_file: Path, cwd: Path, env: str = "toy_line") -> None:
    run = RunFolder(run_dir(cwd, env)).run
    with command(cwd, "runs", "cancel", run, "--credentials", str(operator_file)) as cancelling:
        assert cancelling.finish()[0] == 0


def test_a_run_cancelled_during_a_submit_is_cancelled_everywhere(cancelled: Command, tmp_path: Path) -> None:
    code, out, err = cancelled.finish()
    folder = run_dir(tmp_path)
    assert code == 5, err
    assert "cancelled" in out
    first, second, info = json.loads((folder / "workspace/answers.json").read_text())
    assert first["status"] == "cancelled"
    assert first["summary"]["status"] == "cancelled"
    assert (first["summary"]["n_episodes"], first["summary"]["remaining_budget"]) == (0, 6)
    assert second["status"] == "cancelled"
    assert (info["state"]["is_finalized"], info["state"]["remaining_budget"]) == (True, 6)
    errors = (folder / "workspace/feedback/submit_000/errors.txt").read_text()
    assert json.loads(errors)["category"] == "cancelled"
    outcome = record_in(folder).outcome
    assert (outcome.status, outcome.closed_reason) == ("cancelled", "cancelled")
    assert outcome.budget_used == 0
    assert outcome.final_score is None
    assert "gateway" not in (outcome.error or "")
    log = (folder / "logs/harness.log").read_text()
    assert "Traceback" not in log
    assert "starting it again" not in out + err


def test_an_agent_that_thinks_is_ended_when_its_run_is_cancelled(operator_file: Path, tmp_path: Path) -> None:
    thinking = agent(tmp_path, "submit([0])\nopen('here', 'w')\ntime.sleep(1000)")
    with command(tmp_path, *run_arguments(operator_file, thinking)) as running:
        wait_until(lambda: [*tmp_path.glob("runs/*/toy_line/t/workspace/here")], lambda: running.text)
        cancel(operator_file, tmp_path)
        code, _, err = running.finish()
        assert code == 5, err
        assert running.alive() == []
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.status, outcome.closed_reason, outcome.budget_used) == ("cancelled", "cancelled", 1)


def test_a_run_cancelled_while_it_waits_for_a_worker_ends(operator_file: Path, tmp_path: Path) -> None:
    arguments = run_arguments(operator_file, agent(tmp_path, ""))
    arguments[arguments.index("toy/line")] = "gym/acrobot"  # which no worker of this cluster offers
    with command(tmp_path, *arguments) as running:
        wait_until(
            lambda: (
                [*tmp_path.glob("runs/*/gym_acrobot/t/logs/harness.log")]
                and "cannot serve this now"
                in (run_dir(tmp_path, "gym_acrobot") / "logs/harness.log").read_text()
            )
        )
        cancel(operator_file, tmp_path, "gym_acrobot")
        code, _, err = running.finish()
        assert code == 5, err
    folder = run_dir(tmp_path, "gym_acrobot")
    assert record_in(folder).outcome.status == "cancelled"
    assert "Traceback" not in (folder / "logs/harness.log").read_text()


def test_a_gateway_restarted_after_the_cancellation_ends_its_run(operator_file: Path, tmp_path: Path) -> None:
    with command(tmp_path, *run_arguments(operator_file, agent(tmp_path, SLOW))) as running:
        partial = "runs/*/toy_line/t/workspace/feedback/submit_000.partial"
        wait_until(lambda: [*tmp_path.glob(partial)], lambda: running.text)
        gateway = running.running("evopolicy_gateway.cli.serve")
        os.kill(gateway, signal.SIGSTOP)
        cancel(operator_file, tmp_path)
        os.kill(gateway, signal.SIGKILL)
        code, _, err = running.finish()
        assert code == 5, err
        assert running.text.count("starting it again") == 1
    assert record_in(run_dir(tmp_path)).outcome.status == "cancelled"
