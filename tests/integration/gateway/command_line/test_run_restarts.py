"""A run goes on when its gateway, its agent supervisor or its command dies."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from commands import Plays, agent, command, ended, record_in, run_arguments, run_dir, toy_cluster
from coordinator_harness import Coordinator
from waiting import wait_until

from evopolicy_gateway.run_folder.layout import RunFolder

pytestmark = pytest.mark.system


def test_a_killed_gateway_comes_back_while_its_agent_goes_on(operator_file: Path, tmp_path: Path) -> None:
    code = """
first = patient_submit([0, 1], "one")
open("first", "w").write(json.dumps(first))
while not os.path.exists("killed"):
    time.sleep(0.02)
second = patient_submit([2, 3], "two")
again = patient_submit([0, 1], "one")
open("again", "w").write(json.dumps(again))
"""
    with command(tmp_path, *run_arguments(operator_file, agent(tmp_path, code))) as running:
        workspace = wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace")])[0]
        wait_until((workspace / "first").exists)
        os.kill(running.running("evopolicy_gateway.cli.serve"), signal.SIGKILL)
        (workspace / "killed").touch()
        exit_code, out, err = running.finish()
        assert exit_code == 0, err
        assert running.alive() == []
    assert "starting it again" in out
    assert json.loads((workspace / "again").read_text()) == json.loads((workspace / "first").read_text())
    record = record_in(run_dir(tmp_path))
    assert record.outcome.budget_used == 4
    assert sorted(path.name for path in (workspace / "feedback").iterdir()) == ["submit_000", "submit_001"]


def test_a_resumed_run_waits_for_a_coordinator_that_is_away(tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "state")
    try:
        operator_file = tmp_path / "state/credentials/operator.json"
        arguments = run_arguments(operator_file, agent(tmp_path, "submit([0])"))
        with command(tmp_path, *arguments) as running:
            wait_until(lambda: any(RunFolder(found).run for found in tmp_path.glob("runs/*/*/t")))
            running.kill_all()
        coordinator.stop()
        with command(tmp_path, *arguments, "--resume") as running:
            # Longer than the patience of a new run.
            wait_until(lambda: "no connection to" in running.err)
            assert "within 30 s" in running.err
            coordinator = Coordinator(tmp_path / "state")
            wait_until(lambda: "resumes run" in running.text)
    finally:
        coordinator.stop()


def test_a_killed_supervisors_agent_is_ended_and_started_again(operator_file: Path, tmp_path: Path) -> None:
    code = """
if os.path.exists("child.pid"):
    open("gone", "w").write(str(not os.path.exists("/proc/" + open("child.pid").read())))
    submit([1])
    sys.exit()
submit([0])
hide = "import os, time\\nos.setsid()\\nopen('child.pid', 'w').write(str(os.getpid()))\\ntime.sleep(1000)"
subprocess.Popen([sys.executable, "-c", hide])
time.sleep(1000)
"""
    arguments = run_arguments(operator_file, agent(tmp_path, code))
    with command(tmp_path, *arguments, "--jail", "none") as running:
        pid_file = wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/child.pid")])[0]
        wait_until(pid_file.read_text)
        os.kill(running.running("evopolicy_gateway.agent_supervisor.supervisor"), signal.SIGKILL)
        exit_code, out, err = running.finish()
        assert exit_code == 0, err
        assert running.alive() == []
    assert "supervisor died; starting it again" in " ".join(out.split())
    assert (pid_file.parent / "gone").read_text() == "True"
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.closed_reason, outcome.budget_used) == ("agent_stopped", 2)


def test_an_agent_whose_supervisor_dies_again_and_again_has_failed(ran: Plays) -> None:
    code = "submit([0])\nos.kill(os.getppid(), 9)\ntime.sleep(1000)"
    record = ran(code, "--jail", "none", ends=4).record
    assert (record.outcome.closed_reason, record.outcome.budget_used) == ("agent_failed", 5)
    assert record.agent.settings["program"], (
        "what was known beforehand does not depend on who is left to tell"
    )


def test_a_killed_commands_run_continues_and_is_then_reported(operator_file: Path, tmp_path: Path) -> None:
    code = """
first = patient_submit([0, 1], "one")
open("here", "w")
if len(os.listdir("feedback")) < 2:
    time.sleep(0 if os.path.exists("again") else 1000)
patient_submit([2, 3], "two")
"""
    arguments = [*run_arguments(operator_file, agent(tmp_path, code)), "--resume"]
    with command(tmp_path, *arguments) as running:
        here = wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])[0]
        _, err = ended(tmp_path, *arguments, ends=2)
        assert "is in use by process" in err
        (here.parent / "again").touch()
        running.process.kill()
        _, err = ended(tmp_path, *arguments, "--validation", "3", ends=2)
        assert "other settings" in err
        out, err = ended(tmp_path, *arguments)
        wait_until(lambda: not running.alive())
    assert "resumes run" in out
    record = record_in(run_dir(tmp_path))
    assert (record.outcome.budget_used, record.outcome.closed_reason) == (4, "agent_stopped")
    before = (run_dir(tmp_path) / "run.json").read_bytes()
    with command(tmp_path, *arguments) as finished:
        assert finished.finish()[0] == 0
    assert "it is finished, and this is its result" in " ".join(finished.text.split())
    (tmp_path / "other").mkdir()
    with (
        toy_cluster(tmp_path / "other") as other_file,
        command(tmp_path, *arguments[:-2], str(other_file), "--resume") as elsewhere,
    ):
        assert elsewhere.finish()[0] == 0
    assert f"the cluster has no result of run {record.run}, so that nothing" in " ".join(
        elsewhere.text.split()
    )
    assert (run_dir(tmp_path) / "run.json").read_bytes() == before


def test_interruptions_do_not_reset_the_agents_time(operator_file: Path, tmp_path: Path) -> None:
    code = "os.path.exists('here') or submit([0, 1])\nopen('here', 'w')\ntime.sleep(1000)"
    arguments = [*run_arguments(operator_file, agent(tmp_path, code)), "--resume"]
    with command(tmp_path, *arguments) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        kept = run_dir(tmp_path) / ".gateway" / "times.json"
        wait_until(kept.exists)
        wait_until(lambda: json.loads(kept.read_text())["agent_s"] > 0)
        running.kill()
    times = json.loads(kept.read_text())
    assert times["agent_s"] > 0
    assert times["open_s"] >= times["in_flight_s"]
    # As if it had been at work for a day.
    kept.write_text(json.dumps({**times, "agent_s": 86400.0, "open_s": 86400.0}))
    ended(tmp_path, *arguments)
    record = record_in(run_dir(tmp_path))
    assert (record.outcome.closed_reason, record.outcome.budget_used) == ("wall_limit", 2)
    assert record.timing.agent_s > 86000.0
