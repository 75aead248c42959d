"""`evopolicy` as an operator uses it: real coordinator, real worker, real agents' processes, on the toy environments."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evopolicy_common import scratch
from evopolicy_common.run_record import RunRecord, decode_checkpoint_metrics, decode_run_record
from evopolicy_common.summary import decode_summary

MARK = "EVOTEST_MARK"
PATIENCE_S = 90.0
EVOPOLICY = [sys.executable, "-m", "evopolicy_gateway.cli"]
SMALL = ["--budget", "6", "--validation", "2", "--heldout", "2"]

AGENT = """
import json, os, subprocess, sys, time, urllib.request

def submit(body, **headers):
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": body}).encode(), headers=headers
    )
    try:
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        return json.load(error)

def patient_submit(body, key):
    while True:
        try:
            return submit(body, **{"Idempotency-Key": key})
        except (OSError, ValueError):
            time.sleep(0.1)
"""


def agent(tmp_path: Path, code: str) -> str:
    """`--agent` for a program with that code."""
    path = tmp_path / "agent.py"
    path.write_text(AGENT + code)
    return f"command:{sys.executable} {path}"


def marked(mark: str) -> list[int]:
    """Live processes that were started below a command with that mark."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                if state != "Z" and f"{MARK}={mark}".encode() in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
    return found


def wait_until(what: Any, patience_s: float = PATIENCE_S) -> Any:
    deadline = time.monotonic() + patience_s
    while not (value := what()):
        assert time.monotonic() < deadline, f"{what} did not come true"
        time.sleep(0.05)
    return value


class Command:
    """A command that runs, with everything below it findable."""

    def __init__(self, arguments: list[str], cwd: Path, environment: dict[str, str]) -> None:
        self.mark = uuid.uuid4().hex
        if arguments[0] in ("run", "local"):
            arguments = [*arguments, "--jail-env", MARK]
        self.process = subprocess.Popen(
            [*EVOPOLICY, *arguments],
            cwd=cwd,
            env={**os.environ, **environment, MARK: self.mark},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def finish(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, err

    def kill_all(self) -> None:
        for pid in marked(self.mark):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.communicate()


@contextlib.contextmanager
def command(cwd: Path, *arguments: str) -> Iterator[Command]:
    running = Command(list(arguments), cwd, {"XDG_STATE_HOME": str(cwd / "xdg")})
    try:
        yield running
    finally:
        running.kill_all()


def run_dir(cwd: Path, env: str = "toy_line", exp_id: str = "t") -> Path:
    found = list((cwd / "runs").glob(f"*/{env}/{exp_id}"))
    assert len(found) == 1
    return found[0]


def record_in(folder: Path) -> RunRecord:
    return decode_run_record((folder / "run.json").read_bytes())


@pytest.fixture(scope="module")
def operator_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Credentials for a coordinator with a worker of two slots, up for all tests of this module."""
    state = tmp_path_factory.mktemp("c") / "s"
    ready = state.with_name("ready.json")
    environment = {**os.environ, "XDG_STATE_HOME": str(state.with_name("xdg"))}
    log = state.with_name("log").open("wb")
    start = [sys.executable, "-m"]
    coordinator = subprocess.Popen(
        [*start, "evopolicy_coordinator.cli", "--state", str(state), "--ready-file", str(ready)],
        env=environment,
        stdout=log,
        stderr=log,
    )
    wait_until(ready.exists)
    credentials = json.loads(ready.read_text())["credentials"]
    worker = subprocess.Popen(
        [
            *(*start, "evopolicy_worker.cli", "--env", "toy", "--slots", "2", "--grace", "0"),
            *("--credentials", credentials["worker"]),
        ],
        env=environment,
        stdout=log,
        stderr=log,
    )
    try:
        yield Path(credentials["operator"])
    finally:
        for process in (worker, coordinator):
            process.terminate()
            process.wait(timeout=PATIENCE_S)
        log.close()


def run_on(operator_file: Path, tmp_path: Path, agent_name: str, *more: str) -> tuple[int, str, str]:
    arguments = ["run", "--env", "toy/line", "--agent", agent_name, "--exp-id", "t", *SMALL, *more]
    with command(tmp_path, *arguments, "--credentials", str(operator_file)) as running:
        return running.finish()


def test_local_plays_a_whole_run_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with command(
        tmp_path, "local", "--env", "toy/line", "--agent", "evolve", "--exp-id", "t", *SMALL, "--json"
    ) as running:
        code, out, err = running.finish()
        assert code == 0, err
        assert marked(running.mark) == []
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
    assert sorted(path.name for path in folder.iterdir()) == ["checkpoints", "logs", "run.json", "workspace"]
    best = folder / "checkpoints" / f"submit_{record.outcome.best_submit_index:03d}"
    assert (best / "system" / "policy.py").read_bytes() == (
        folder / "workspace/system/policy.py"
    ).read_bytes()
    metrics = decode_checkpoint_metrics((best / "metrics.json").read_bytes())
    assert metrics.val_mean == record.outcome.val_scores[str(record.outcome.best_submit_index)]
    summary = decode_summary((folder / "workspace/feedback/submit_000/summary.json").read_bytes())
    assert summary.env == "toy/line"
    assert "submit_000 ok" in err
    for line in (folder / "logs" / "harness.log").read_text().splitlines():
        assert json.loads(line)["event"]


def test_video_all_leaves_a_video_beside_each_trajectory(tmp_path: Path) -> None:
    small = ["--budget", "2", "--validation", "1", "--heldout", "1"]
    arguments = ["local", "--env", "toy/line", "--agent", "random", "--exp-id", "t", "--video", "all", *small]
    with command(tmp_path, *arguments) as running:
        code, _, err = running.finish()
    assert code == 0, err
    episodes = [path.parent for path in (run_dir(tmp_path) / "workspace").rglob("trajectory.jsonl")]
    assert episodes
    for folder in episodes:
        assert (folder / "video.mp4").read_bytes()[4:8] == b"ftyp"


def test_a_spoken_agent_gets_turns_until_it_stops_and_the_run_is_finalised(
    operator_file: Path, tmp_path: Path
) -> None:
    code = """
for line in sys.stdin:
    prompt = json.loads(line)
    answer = submit([prompt["turn"]])
    print("a line of its own")
    print(json.dumps({"turn": prompt["turn"], "text": answer["status"], "stop": prompt["turn"] == 1}), flush=True)
"""
    exit_code, out, _ = run_on(operator_file, tmp_path, agent(tmp_path, code))
    assert exit_code == 0
    record = record_in(run_dir(tmp_path))
    assert record.outcome.closed_reason == "agent_stopped"
    assert record.outcome.budget_used == 2
    assert record.agent.turns == 2
    assert "agent stopped" in out
    lines = [json.loads(line) for line in (run_dir(tmp_path) / "logs/agent.jsonl").read_text().splitlines()]
    assert [line["turn"] for line in lines if line.get("type") == "prompt"] == [0, 1]
    assert {"type": "stdout", "text": "a line of its own"} in lines
    assert "4 episodes" not in lines[0]["message"]
    assert "5 episodes of the budget are left" in next(
        line["message"] for line in lines if line.get("turn") == 1 and "message" in line
    )


def test_an_agents_children_are_gone_however_they_hide(operator_file: Path, tmp_path: Path) -> None:
    code = """
hide = (
    "import os, signal, sys, time\\n"
    "signal.signal(signal.SIGTERM, signal.SIG_IGN)\\n"
    "os.setsid() if os.getsid(0) != os.getpid() else None\\n"
    "if os.fork(): os._exit(0)\\n"
    "open(sys.argv[1], 'w').write(str(os.getpid()))\\n"
    "time.sleep(1000)\\n"
)
subprocess.Popen([sys.executable, "-c", hide, "child.pid"], start_new_session=True)
while not os.path.exists("child.pid"):
    time.sleep(0.01)
submit([0])
"""
    exit_code, _, err = run_on(operator_file, tmp_path, agent(tmp_path, code), "--jail", "none")
    assert exit_code == 0, err
    child = int((run_dir(tmp_path) / "workspace" / "child.pid").read_text())
    assert not Path(f"/proc/{child}").exists()


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
    arguments = ["run", "--env", "toy/line", "--agent", agent(tmp_path, code), "--exp-id", "t", *SMALL]
    with command(tmp_path, *arguments, "--credentials", str(operator_file)) as running:
        workspace = wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace")])[0]
        wait_until((workspace / "first").exists)
        (gateway,) = [
            pid
            for pid in marked(running.mark)
            if b"evopolicy_gateway.serve_cli" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        os.kill(gateway, signal.SIGKILL)
        (workspace / "killed").touch()
        exit_code, out, err = running.finish()
        assert exit_code == 0, err
        assert marked(running.mark) == []
    assert "starting it again" in out
    assert json.loads((workspace / "again").read_text()) == json.loads((workspace / "first").read_text())
    record = record_in(run_dir(tmp_path))
    assert record.outcome.budget_used == 4
    assert sorted(path.name for path in (workspace / "feedback").iterdir()) == ["submit_000", "submit_001"]


def test_a_killed_keeper_leaves_nothing_of_its_agent_which_is_begun_again(
    operator_file: Path, tmp_path: Path
) -> None:
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
    arguments = ["run", "--env", "toy/line", "--agent", agent(tmp_path, code), "--exp-id", "t", *SMALL]
    arguments += ["--jail", "none"]
    with command(tmp_path, *arguments, "--credentials", str(operator_file)) as running:
        found = wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/child.pid")])[0]
        wait_until(found.read_text)
        (keeper,) = [
            pid
            for pid in marked(running.mark)
            if b"evopolicy_gateway.harnesses.keeper" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        os.kill(keeper, signal.SIGKILL)
        exit_code, out, err = running.finish()
        assert exit_code == 0, err
        assert marked(running.mark) == []
    assert "keeper died; starting it again" in " ".join(out.split())
    assert (found.parent / "gone").read_text() == "True"
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.closed_reason, outcome.budget_used) == ("agent_stopped", 2)


def test_an_agent_whose_keeper_dies_again_and_again_has_failed(operator_file: Path, tmp_path: Path) -> None:
    code = "submit([0])\nos.kill(os.getppid(), 9)\ntime.sleep(1000)"
    exit_code, _, err = run_on(operator_file, tmp_path, agent(tmp_path, code), "--jail", "none")
    assert exit_code == 0, err
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.closed_reason, outcome.budget_used) == ("agent_failed", 5)


def test_a_run_whose_command_was_killed_is_gone_on_with_and_a_finished_one_is_told(
    operator_file: Path, tmp_path: Path
) -> None:
    code = """
first = patient_submit([0, 1], "one")
open("here", "w")
if len(os.listdir("feedback")) < 2:
    time.sleep(0 if os.path.exists("again") else 1000)
patient_submit([2, 3], "two")
"""
    arguments = ["run", "--env", "toy/line", "--agent", agent(tmp_path, code), "--exp-id", "t", *SMALL]
    arguments += ["--credentials", str(operator_file), "--resume"]
    with command(tmp_path, *arguments) as running:
        here = wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])[0]
        with command(tmp_path, *arguments) as second:
            code_of_second, _, err = second.finish()
        assert code_of_second == 2
        assert "another command plays this run" in err
        (here.parent / "again").touch()
        running.process.kill()
        with command(tmp_path, *arguments, "--validation", "3") as other:
            code_of_other, _, err = other.finish()
        assert code_of_other == 2
        assert "other settings" in err
        with command(tmp_path, *arguments) as again:
            exit_code, out, err = again.finish()
        assert exit_code == 0, err
        wait_until(lambda: not marked(running.mark))
    assert "goes on with run" in out
    record = record_in(run_dir(tmp_path))
    assert (record.outcome.budget_used, record.outcome.closed_reason) == (4, "agent_stopped")
    before = (run_dir(tmp_path) / "run.json").read_bytes()
    with command(tmp_path, *arguments) as finished:
        assert finished.finish()[0] == 0
    assert (run_dir(tmp_path) / "run.json").read_bytes() == before


def test_an_agent_that_stays_when_its_budget_is_spent_is_ended_even_if_it_ignores_being_asked(
    operator_file: Path, tmp_path: Path
) -> None:
    code = """
import signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
submit([0, 1, 2, 3, 4, 5])
time.sleep(1000)
"""
    exit_code, _, err = run_on(operator_file, tmp_path, agent(tmp_path, code))
    assert exit_code == 0, err
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.closed_reason, outcome.budget_used) == ("budget_spent", 6)


def test_an_agent_that_does_nothing_is_ended_by_its_wall_limit(operator_file: Path, tmp_path: Path) -> None:
    exit_code, _, err = run_on(
        operator_file, tmp_path, agent(tmp_path, "submit([0, 1])\ntime.sleep(1000)"), "--agent-wall-s", "2"
    )
    assert exit_code == 0, err
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.closed_reason, outcome.budget_used, outcome.status) == ("wall_limit", 2, "completed")


BAD_INPUT = """
from pathlib import Path
system, policy = Path("system"), Path("system/policy.py")
good = policy.read_text()
log = []

def case(name, env_instances=(0,)):
    answer = submit(env_instances if isinstance(env_instances, str) else list(env_instances))
    info = json.load(urllib.request.urlopen(os.environ["EVOPOLICYGYM_INFO_URL"]))
    errors = Path("feedback", answer.get("submit_id", "-"), "errors.txt")
    log.append([name, answer.get("status"), info["state"]["remaining_budget"],
                json.loads(errors.read_text())["message"] if errors.exists() else answer.get("error", {}).get("message")])

case("ids out of range", [64])
case("backwards", "3-1")
case("empty", [])
policy.unlink(); case("missing policy")
policy.symlink_to("/etc/passwd"); case("policy is a link"); policy.unlink()
policy.write_text(good)
(system / "link").symlink_to("/etc"); case("link beside"); (system / "link").unlink()
with open(system / "big", "wb") as big: big.truncate(2 << 30)
case("two gigabytes"); (system / "big").unlink()
policy.write_text("class Policy(:\\n"); case("syntax error")
policy.write_text("import gymnasium\\nclass Policy: ...\\n"); case("simulator")
policy.write_text("class Other: ...\\n"); case("no class")
policy.write_text(good.replace("self.action =", "raise ValueError('in init')\\n        self.action =")); case("init raises")
policy.write_text(good.replace("return self.action", "return {'no': [object]}")); case("nonsense action")
policy.write_text(good.replace("return self.action", "while True: pass")); case("never returns")
policy.write_text(good.replace("return self.action", "raise RuntimeError('at once')")); case("act raises")
Path("log.json").write_text(json.dumps(log))
"""


def test_bad_input_gets_its_verdict_and_a_message_that_helps(operator_file: Path, tmp_path: Path) -> None:
    exit_code, _, err = run_on(
        operator_file, tmp_path, agent(tmp_path, BAD_INPUT), "--budget", "20", "--limit", "act_wall_s=1"
    )
    assert exit_code == 0, err
    folder = run_dir(tmp_path)
    log = {
        name: (status, left, message)
        for name, status, left, message in json.loads((folder / "workspace" / "log.json").read_text())
    }
    expected = {
        "ids out of range": ("invalid_env_instance", 20, "0 to 63"),
        "backwards": ("invalid_env_instance", 20, "'1-3'"),
        "empty": ("budget_invalid", 20, "0 episodes"),
        "missing policy": ("missing_policy", 19, "policy.py"),
        "policy is a link": ("missing_policy", 18, "symbolic link"),
        "link beside": ("import_error", 17, "link is a symbolic link"),
        "two gigabytes": ("import_error", 16, "2,147,483,648"),
        "syntax error": ("import_error", 15, "invalid syntax"),
        "simulator": ("denied_import", 14, "gymnasium"),
        "no class": ("import_error", 13, "Policy"),
        "init raises": ("init_error", 12, "in init"),
        "nonsense action": ("ok", 11, None),
        "never returns": ("ok", 10, None),
        "act raises": ("ok", 9, None),
    }
    for name, (status, left, said) in expected.items():
        assert log[name][:2] == (status, left), (name, log[name])
        if said is not None:
            assert said in log[name][2], (name, log[name])
    feedback = folder / "workspace" / "feedback"
    told = {}
    for index, name in ((8, "nonsense action"), (9, "never returns"), (10, "act raises")):
        errors = (feedback / f"submit_{index:03d}").glob("episodes/*/error.txt")
        told[name] = [json.loads(error.read_text())["category"] for error in errors]
    assert told == {"nonsense action": [], "never returns": ["act_timeout"], "act raises": ["act_error"]}
    rows = (feedback / "submit_008/episodes").glob("*/trajectory.jsonl")
    assert all(
        json.loads(line)["info"]["action_invalid"] for path in rows for line in path.read_text().splitlines()
    )
    record = record_in(folder)
    assert [one.status for one in record.rejected_submits] == ["invalid_env_instance"] * 2 + [
        "budget_invalid"
    ]
    assert set(record.outcome.val_scores) == {"8", "9", "10"}


def test_without_an_ok_submit_there_is_no_score_and_the_exit_code_says_so(
    operator_file: Path, tmp_path: Path
) -> None:
    code = "open('system/policy.py', 'w').write('1 / 0')\nsubmit([0, 1])"
    exit_code, out, _ = run_on(operator_file, tmp_path, agent(tmp_path, code))
    assert exit_code == 3
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.status, outcome.final_score, outcome.best_submit_index) == ("no_ok_submit", None, None)
    assert outcome.budget_used == 2
    assert "no_ok_submit" in out


def test_replay_submits_the_given_policies_in_order_with_even_shares(
    operator_file: Path, tmp_path: Path
) -> None:
    policy = "class Policy:\n  def __init__(self, *a): pass\n  def reset(self, i): pass\n  def act(self, obs): return [{}]\n"
    for name, push in (("b", 0.5), ("a", -0.5)):
        (tmp_path / "given" / name / "system").mkdir(parents=True)
        (tmp_path / "given" / name / "system" / "policy.py").write_text(policy.format(push))
    exit_code, _, err = run_on(operator_file, tmp_path, "replay:given", "--budget", "5")
    assert exit_code == 0, err
    folder = run_dir(tmp_path)
    assert folder.parts[-3] == "replay-given"
    sources = [(folder / f"checkpoints/submit_00{i}/system/policy.py").read_text() for i in range(2)]
    assert "-0.5" in sources[0]
    assert "-0.5" not in sources[1]
    summaries = [
        decode_summary((folder / f"workspace/feedback/submit_00{i}/summary.json").read_bytes())
        for i in range(2)
    ]
    assert [summary.env_instances for summary in summaries] == [(0, 1, 2), (0, 1)]


def test_a_run_of_that_name_is_refused_and_replaced_only_on_demand(
    operator_file: Path, tmp_path: Path
) -> None:
    stop_at_once = agent(tmp_path, "")
    assert run_on(operator_file, tmp_path, stop_at_once)[0] == 3
    before = (run_dir(tmp_path) / "run.json").read_bytes()
    code, _, err = run_on(operator_file, tmp_path, stop_at_once)
    assert code == 2
    assert len(err.strip().splitlines()) == 1
    assert "--overwrite" in err
    assert (run_dir(tmp_path) / "run.json").read_bytes() == before
    assert run_on(operator_file, tmp_path, stop_at_once, "--overwrite")[0] == 3
    assert (run_dir(tmp_path) / "run.json").read_bytes() != before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_local_command_takes_everything_down(tmp_path: Path, number: signal.Signals) -> None:
    waits = agent(tmp_path, "submit([0])\nopen('here', 'w')\ntime.sleep(1000)")
    arguments = ["local", "--env", "toy/line", "--agent", waits, "--exp-id", "t", *SMALL]
    with command(tmp_path, *arguments) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        running.process.send_signal(number)
        code, _, err = running.finish()
        assert code == 130
        assert "Traceback" not in err
        assert marked(running.mark) == []
    outcome = record_in(run_dir(tmp_path)).outcome
    assert (outcome.status, outcome.closed_reason) == ("error", "cancelled")
    assert not (run_dir(tmp_path) / ".gateway").exists()


def test_a_killed_local_command_takes_everything_with_it(tmp_path: Path) -> None:
    waits = agent(tmp_path, "submit([0])\nopen('here', 'w')\ntime.sleep(1000)")
    arguments = ["local", "--env", "toy/line", "--agent", waits, "--exp-id", "t", *SMALL]
    with command(tmp_path, *arguments) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        below = marked(running.mark)
        assert len(below) >= 5
        states = [state for pid in below if (state := state_folder(pid)) is not None]
        running.process.kill()
        wait_until(lambda: not marked(running.mark))
    # What SIGKILL gave it no chance to clear away goes at the next start.
    assert Path(states[0]).is_dir()
    scratch.clear_stale("local")
    assert not Path(states[0]).exists()


def state_folder(pid: int) -> str | None:
    """The `--state` that a coordinator's process was started with."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    return words[words.index("--state") + 1] if "evopolicy_coordinator.cli" in words else None


def test_try_shows_returns_and_where_the_trajectories_are(operator_file: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "policy.py").write_text(
        "class Policy:\n"
        "  def __init__(self, obs_space, action_space, env_meta): pass\n"
        "  def reset(self, i): print('hello from', i)\n"
        "  def act(self, obs): return [obs[2] - obs[0]]\n"
    )
    where = ["--env", "toy/line", "--credentials", str(operator_file)]
    with command(tmp_path, "try", "mine", "--cases", "0-1,5", "--json", *where) as running:
        code, out, err = running.finish()
    assert code == 0, err
    (result,) = json.loads(out)
    assert [episode["case"] for episode in result["episodes"]] == [0, 1, 5]
    first = Path(result["episodes"][0]["folder"])
    assert len((first / "trajectory.jsonl").read_text().splitlines()) == result["episodes"][0]["length"]
    assert "hello from" in (first / "stdout.txt").read_text()
    (tmp_path / "mine" / "policy.py").write_text("import nothing_like_it\n")
    with command(tmp_path, "try", "mine", "--cases", "0", *where) as running:
        code, out, _ = running.finish()
    assert code == 1
    assert "nothing_like_it" in out


def test_random_plays_the_reference_on_a_split(operator_file: Path, tmp_path: Path) -> None:
    where = ["--env", "toy", "--cases", "0-3", "--json", "--credentials", str(operator_file)]
    with command(tmp_path, "random", *where) as running:
        code, out, err = running.finish()
    assert code == 0, err
    assert [(result["env"], len(result["episodes"])) for result in json.loads(out)] == [
        ("toy/line", 4),
        ("toy/maze", 4),
    ]


def test_an_open_run_is_taken_over_by_a_gateway_started_by_hand(operator_file: Path, tmp_path: Path) -> None:
    waits = agent(tmp_path, "submit([0, 1])\nopen('here', 'w')\ntime.sleep(1000)")
    arguments = ["run", "--env", "toy/line", "--agent", waits, "--exp-id", "t", *SMALL]
    with command(tmp_path, *arguments, "--credentials", str(operator_file)) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/here")])
        running.process.kill()
        wait_until(lambda: not marked(running.mark))
    folder = run_dir(tmp_path)
    known = re.findall(r"http://\S+/submit", (folder / "workspace" / "AGENTS.md").read_text())
    by_hand = subprocess.Popen(
        [sys.executable, "-m", "evopolicy_gateway.serve_cli", str(folder), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert by_hand.stdout is not None
        urls = json.loads(by_hand.stdout.readline())
        assert set(known) == {urls["EVOPOLICYGYM_SUBMIT_URL"]}
        body = json.dumps({"env_instances": "0-3"}).encode()
        with urllib.request.urlopen(urllib.request.Request(known[0], data=body)) as answer:
            assert json.load(answer)["submit_id"] == "submit_001"
        assert by_hand.wait(timeout=PATIENCE_S) == 0
    finally:
        by_hand.kill()
        by_hand.communicate()
    assert '"closed"' in (folder / ".gateway" / "journal.jsonl").read_text()


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
        more = ["--slots", slots, "--state", str(tmp_path / "state"), "--max-episodes", "6"]
        with command(tmp_path, *arguments, *more) as running:
            code, _, err = running.finish()
            assert code == 0, err
        feedback = run_dir(tmp_path, exp_id=f"s{slots}") / "workspace" / "feedback"
        trees.append(
            {path.relative_to(feedback): timeless(path) for path in feedback.rglob("*") if path.is_file()}
        )
    assert trees[0] == trees[1]
    assert len(trees[0]) >= 1 + 6 * 3


def timeless(path: Path) -> bytes:
    """A feedback file without what tells the time."""
    return re.sub(rb'"(timestamp|submit_\w+_at|wall_time_seconds)": ?[^,}\n]+', b"", path.read_bytes())
