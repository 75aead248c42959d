"""`evopolicy suite` as an operator uses it: real cluster, toy environments, the built-in search and the fake CLIs."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from commands import Command, agent, command, ended, toy_cluster
from waiting import wait_until

from evopolicy_common.records.run_record import decode_run_record

pytestmark = pytest.mark.system

FAKES = Path(__file__).parents[3] / "support" / "fake_clis"

SUITE = """
name = "t"
environments = ["toy/line"]
[defaults]
budget = 4
validation = 2
heldout = 2
hidden_cases = "{hidden}"
[parallel]
machine = 3
claim_ttl_s = 3.0
[[agents]]
name = "evolve"
agent = "evolve"
[[agents]]
name = "fake codex"
[agents.config]
harness = "codex"
program = ["{python}", "{fakes}/codex"]
environment = {{ FAKE_STATE = ".fake", FAKE_SCENARIO = "{codex}" }}
backoff_s = 0.01
[agents.jail]
read = ["{fakes}"]
[[agents]]
name = "fake claude"
[agents.config]
harness = "claude-code"
program = ["{python}", "{fakes}/claude"]
environment = {{ FAKE_STATE = ".fake", FAKE_SCENARIO = "{claude}" }}
backoff_s = 0.01
[agents.jail]
read = ["{fakes}"]
"""


def write_suite(folder: Path, codex: str = "work", claude: str = "work", hidden: str = "shared") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "t.toml").write_text(
        SUITE.format(python=sys.executable, fakes=FAKES, codex=codex, claude=claude, hidden=hidden)
    )


def sweep(cwd: Path, *arguments: str) -> AbstractContextManager[Command]:
    """`evopolicy suite` on the file that `write_suite` wrote."""
    return command(cwd, "suite", "t.toml", *arguments)


def swept(cwd: Path, *arguments: str, ends: int = 0) -> str:
    """The output of that command until it ends."""
    return "".join(ended(cwd, "suite", "t.toml", *arguments, ends=ends))


def index_in(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / "suite.json").read_text())["runs"])


def test_a_sweep_killed_twice_goes_on_where_it_was(tmp_path: Path) -> None:
    # The second turn of either fake never ends, until the third start, which works.
    # One run is scored while the agents of the others are at work on the same machine, so they share no hidden case.
    write_suite(tmp_path, codex="work,endless,work", claude="work,endless,work", hidden="per-run")
    root = tmp_path / "runs" / "t"
    played = [root / "fake codex/toy_line/t-0", root / "fake claude/toy_line/t-0"]
    with sweep(tmp_path, "--local") as first:
        wait_until((root / "suite.json").exists, lambda: first.text)
        wait_until(
            lambda: index_in(root).get("evolve/toy/line/0", {}).get("state") == "completed",
            lambda: first.text,
        )
        wait_until(lambda: all(_starts(folder) == 2 for folder in played), lambda: first.text)
        first.kill()
    evolved = root / "evolve/toy_line/t-0/run.json"
    written = evolved.stat().st_mtime_ns
    kept = [json.loads((folder / ".gateway/session.json").read_text())["session"] for folder in played]
    with sweep(tmp_path, "--local") as second:
        wait_until(lambda: "runs:" in second.text, lambda: second.text)
        second.kill()
    with sweep(tmp_path, "--local") as third:
        assert third.wait() == 0, third.text
        assert third.alive() == []
        text = third.text
    assert "1 kept" in text
    assert "resumed in its session" in text
    assert evolved.stat().st_mtime_ns == written
    for harness, session in zip(("codex", "claude"), kept, strict=True):
        folder = root / f"fake {harness}/toy_line/t-0"
        record = decode_run_record((folder / "run.json").read_bytes())
        assert record.outcome.status == "completed"
        assert record.outcome.budget_used == 4
        assert record.attempt == 1
        assert record.agent.harness == ("codex" if harness == "codex" else "claude-code")
        assert record.agent.tokens is not None
        starts = (folder / "workspace/.fake/starts").read_text()
        assert session in starts.splitlines()[-1]
    assert {entry["state"] for entry in index_in(root).values()} == {"completed"}
    with sweep(tmp_path, "--local", "--dry-run") as after:
        assert after.wait() == 0
        assert "3 runs: 3 kept" in after.text
        assert "feedback takes" not in after.text


def test_a_dry_run_of_a_new_sweep_keeps_no_cluster(tmp_path: Path) -> None:
    write_suite(tmp_path)
    assert "3 runs: 3 new" in swept(tmp_path, "--local", "--dry-run")
    assert not (tmp_path / "runs" / "t" / ".cluster").exists()


def _starts(folder: Path) -> int:
    """How often the fake CLI of a run has been started: its scenario goes on with each."""
    try:
        return len((folder / "workspace/.fake/starts").read_text().splitlines())
    except OSError:
        return 0


def test_a_run_without_a_session_restarts_and_keeps_the_old(tmp_path: Path) -> None:
    own = agent(tmp_path, "submit([0])\ntime.sleep(3600)\n")
    (tmp_path / "t.toml").write_text(
        'name = "t"\nenvironments = ["toy/line"]\n[defaults]\nbudget = 2\nvalidation = 1\nheldout = 1\n'
        f'[[agents]]\nname = "own"\nagent = "{own}"\n'
    )
    root = tmp_path / "runs" / "t"
    feedback = root / "own/toy_line/t-0/workspace/feedback/submit_000/summary.json"
    with sweep(tmp_path, "--local") as first:
        wait_until(feedback.exists, lambda: first.text)
        first.kill()
    agent(tmp_path, "submit([0])\n")
    assert "restarted as a new attempt (its agent keeps no session" in swept(tmp_path, "--local")
    record = decode_run_record((root / "own/toy_line/t-0/run.json").read_bytes())
    assert record.attempt == 2
    assert record.outcome.auxiliary["transitions"]["steps"] > 0
    aside = root / ".attempts/own/toy_line/t-0.1/workspace/feedback/submit_000/summary.json"
    assert aside.exists()


@pytest.fixture
def operator_file(tmp_path: Path) -> Iterator[Path]:
    """Credentials for a cluster of the test's own: sweeps of one name share what a coordinator knows of them."""
    with toy_cluster(tmp_path) as file:
        yield file


def test_two_hosts_share_a_sweep_and_no_run_is_played_twice(tmp_path: Path, operator_file: Path) -> None:
    hosts = [tmp_path / "one", tmp_path / "two"]
    for host in hosts:
        write_suite(host)
    arguments = ("--credentials", str(operator_file), "--parallel", "1")
    with sweep(hosts[0], *arguments) as one, sweep(hosts[1], *arguments) as two:
        assert one.wait() == 0, one.text
        assert two.wait() == 0, two.text
    records = [path for host in hosts for path in host.glob("runs/t/*/*/*/run.json")]
    assert sorted(path.parts[-4] for path in records) == ["evolve", "fake claude", "fake codex"]
    for host in hosts:
        assert {entry["state"] for entry in index_in(host / "runs" / "t").values()} == {"completed"}
        assert len(index_in(host / "runs" / "t")) == 3


def two_hosts(root: Path, code: str, *, budget: int) -> tuple[list[Path], Path]:
    """Folders of two hosts with the same sweep of one run, and a flag that its agent, with that code, can see."""
    hosts, flag = [root / "one", root / "two"], root / "seen" / "flag"
    flag.parent.mkdir()
    own = agent(root, code)
    for host in hosts:
        host.mkdir()
        (host / "t.toml").write_text(
            f'name = "t"\nenvironments = ["toy/line"]\n[defaults]\nbudget = {budget}\nvalidation = 1\nheldout ='
            f' 1\n[parallel]\nclaim_ttl_s = 3.0\n[[agents]]\nname = "own"\nagent = "{own}'
            f' {flag}"\n[agents.jail]\nread = ["{flag.parent}"]\n'
        )
    return hosts, flag


def test_a_dead_hosts_runs_are_taken_over_and_return(tmp_path: Path, operator_file: Path) -> None:
    code = "submit([0, 1])\nwhile not os.path.exists(sys.argv[1]):\n    time.sleep(0.05)\n"
    hosts, flag = two_hosts(tmp_path, code, budget=4)
    arguments = ("--credentials", str(operator_file))
    with sweep(hosts[0], *arguments) as one:
        feedback = hosts[0] / "runs/t/own/toy_line/t-0/workspace/feedback/submit_000/summary.json"
        wait_until(feedback.exists, lambda: one.text)
        one.kill()
    flag.touch()
    assert "taken over from" in swept(hosts[1], *arguments)
    (entry,) = index_in(hosts[1] / "runs" / "t").values()
    assert (entry["state"], entry["attempt"]) == ("completed", 2)
    swept(hosts[0], *arguments)
    (indexed,) = index_in(hosts[0] / "runs" / "t").values()
    assert (indexed["state"], indexed["score"], indexed["directory"]) == ("completed", entry["score"], "")
    assert [*hosts[0].glob("runs/t/*/*/*/run.json")] == []


def test_a_host_overtaken_during_a_submit_takes_the_other_result(tmp_path: Path, operator_file: Path) -> None:
    code = (
        "slow = '' if os.path.exists(sys.argv[1]) else 'time.sleep(0.5); '\n"
        "open('system/policy.py', 'w').write(\n"
        "    'import time\\nclass Policy:\\n  def __init__(self, *a): pass\\n  def reset(self, i): pass\\n'\n"
        "    f'  def act(self, obs): {slow}return [0.0]\\n')\n"
        "json.dump(submit([0, 1]), open('answer.json', 'w'))\n"
    )
    hosts, flag = two_hosts(tmp_path, code, budget=2)
    arguments = ("--credentials", str(operator_file))
    folder = hosts[0] / "runs/t/own/toy_line/t-0"
    with sweep(hosts[0], *arguments) as one:
        wait_until((folder / "workspace/feedback/submit_000.partial").exists, lambda: one.text)
        os.kill(one.process.pid, signal.SIGSTOP)
        flag.touch()
        with sweep(hosts[1], *arguments) as two:
            wait_until(lambda: "taken over from" in two.text, lambda: two.text)
            wait_until((folder / "workspace/answer.json").exists, lambda: one.text)
            os.kill(one.process.pid, signal.SIGCONT)
            assert two.wait() == 0, two.text
        assert one.wait() == 0, one.text
        assert one.alive() == []
    # The agent was told the truth, and so was nobody else told anything else.
    kept = [*hosts[0].glob("runs/t/.attempts/**/workspace"), *hosts[0].glob("runs/t/own/*/*/workspace")]
    (workspace,) = kept
    assert json.loads((workspace / "answer.json").read_text())["status"] == "cancelled"
    assert "Traceback" not in (workspace.parent / "logs/harness.log").read_text()
    assert "starting it again" not in one.text
    (entry,) = index_in(hosts[1] / "runs" / "t").values()
    (indexed,) = index_in(hosts[0] / "runs" / "t").values()
    assert (entry["state"], entry["attempt"]) == ("completed", 2)
    assert (indexed["state"], indexed["score"], indexed["directory"]) == ("completed", entry["score"], "")


def test_a_run_with_a_wrong_key_is_played_again(tmp_path: Path, operator_file: Path) -> None:
    write_suite(tmp_path, claude="bad_key,work")
    arguments = ("--credentials", str(operator_file), "--only", "fake claude/*")
    root = tmp_path / "runs" / "t"
    assert "401" in swept(tmp_path, *arguments, ends=4)
    (entry,) = index_in(root).values()
    assert entry["state"] == "error"
    assert "before its first submit" in entry["error"]
    # The settings of the fake say what it plays, so other ones make another run of it.
    write_suite(tmp_path, claude="work")
    swept(tmp_path, *arguments, "--changed", "rerun")
    (entry,) = index_in(root).values()
    assert (entry["state"], entry["attempt"]) == ("completed", 2)


@pytest.mark.timeout(600)  # six commands with a local cluster each
def test_runs_on_published_cases_stay_where_a_rerun_of_them_is_refused(tmp_path: Path) -> None:
    file, root = tmp_path / "t.toml", tmp_path / "runs" / "t"
    write_suite(tmp_path)
    arguments = ("--local", "--only", "evolve/*")
    swept(tmp_path, *arguments)
    words = ("publish", str(root), "--local", "--state", str(root / ".cluster"), "--out", "r.evp")
    ended(tmp_path, *words)
    run = root / "evolve/toy_line/t-0"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    file.write_text(file.read_text().replace("budget = 4", "budget = 3"))
    assert "are public" in swept(tmp_path, *arguments, "--changed", "rerun", ends=1)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    assert not (root / ".attempts").exists()
    assert "budget is 3, was 4" in swept(tmp_path, *arguments, ends=2)
    swept(tmp_path, *arguments, "--changed", "keep")
    options = ["--env", "toy/line", "--agent", "random", "--budget", "3", "--overwrite", "--exp-id", "t-0"]
    options += ["--entry", "evolve", "--runs", str(root), "--state", str(root / ".cluster")]
    with command(tmp_path, "local", *options) as over:
        assert over.wait() == 2, over.text
        assert "are public" in over.text
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_json_events_tell_the_plan_and_the_results(tmp_path: Path, operator_file: Path) -> None:
    write_suite(tmp_path)
    arguments = ("--credentials", str(operator_file), "--only", "evolve/*", "--json")
    text = swept(tmp_path, *arguments)
    lines = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
    kinds = [line["event"] for line in lines]
    assert kinds[0] == "planned"
    assert kinds[1] == "started"
    assert kinds[-1] == "finished"
    assert lines[-1]["state"] == "completed"
    assert "submit" in kinds


def test_a_higher_cap_continues_the_interrupted_session(tmp_path: Path, operator_file: Path) -> None:
    write_suite(tmp_path, codex="work,endless,work")
    file = tmp_path / "t.toml"
    whole = file.read_text()
    file.write_text(whole.replace("[[agents]]", "[caps]\nmax_tokens = 1000\n[[agents]]", 1))
    arguments = ("--credentials", str(operator_file), "--only", "fake codex/*")
    root = tmp_path / "runs" / "t"
    with sweep(tmp_path, *arguments) as first:
        assert first.wait() == 1, first.text
        assert first.alive() == []
        assert "1020 of 1000 tokens are used" in first.text
        assert "1 runs are left as they are" in first.text
        assert "it was left running; see " in first.text
    (entry,) = index_in(root).values()
    assert (entry["state"], entry["tokens"]["output"]) == ("running", 20)
    # Whether the second start, which never ends, has come before the cap or not: the next one works.
    (root / "fake codex/toy_line/t-0/workspace/.fake/starts").write_text("[]\n[]\n")
    file.write_text(whole)
    text = swept(tmp_path, *arguments)
    assert "resumed in its session" in text
    assert "used in all: 2,040 tokens" in text
    (entry,) = index_in(root).values()
    assert (entry["state"], entry["attempt"], entry["tokens"]["output"]) == ("completed", 1, 40)


def test_ctrl_c_leaves_runs_open_and_the_exit_code_tells(tmp_path: Path, operator_file: Path) -> None:
    write_suite(tmp_path, codex="work,endless,work")
    arguments = ("--credentials", str(operator_file), "--only", "fake codex/*")
    played = tmp_path / "runs/t/fake codex/toy_line/t-0"
    with sweep(tmp_path, *arguments) as first:
        wait_until(lambda: _starts(played) == 2, lambda: first.text)
        first.process.send_signal(signal.SIGINT)
        assert first.wait() == 130, first.text
        assert first.alive() == []
    assert "resumed in its session" in swept(tmp_path, *arguments)


def test_a_changed_file_is_refused_and_a_scoreless_run_reported(tmp_path: Path, operator_file: Path) -> None:
    broken = tmp_path / "bundles" / "0"
    broken.mkdir(parents=True)
    (broken / "policy.py").write_text("raise ValueError('no policy')\n")
    text = (
        'name = "t"\nenvironments = ["toy/line"]\n[defaults]\nbudget = 2\nvalidation = 1\nheldout = 1\n'
        '[[agents]]\nname = "broken"\nagent = "replay:bundles"\n'
    )
    file = tmp_path / "t.toml"
    file.write_text(text)
    arguments = ("--credentials", str(operator_file))
    assert "feedback takes at most 25.8 KiB" in swept(tmp_path, *arguments, ends=3)
    file.write_text(text.replace("budget = 2", "budget = 3"))
    refused = swept(tmp_path, *arguments, ends=2)
    assert "budget is 3, was 2" in " ".join(refused.split())
    assert "1 runs: 1 kept" in swept(tmp_path, *arguments, "--changed", "keep", ends=3)


def test_a_terminal_shows_a_live_table(tmp_path: Path, operator_file: Path) -> None:
    write_suite(tmp_path)
    main, side = os.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 160, 0, 0))
    arguments = ["suite", "t.toml", "--credentials", str(operator_file), "--only", "fake codex/*"]
    shown_on = {"TERM": "xterm-256color", "COLUMNS": "160", "LINES": "40"}
    process = subprocess.Popen(
        [sys.executable, "-m", "evopolicy_gateway.cli", *arguments],
        cwd=tmp_path,
        env={**os.environ, **shown_on, "XDG_STATE_HOME": str(tmp_path / "xdg")},
        stdin=side,
        stdout=side,
        stderr=side,
    )
    os.close(side)
    shown = b""
    with contextlib.suppress(OSError):  # a terminal whose other side is gone
        while some := os.read(main, 1 << 16):
            shown += some
    os.close(main)
    assert process.wait() == 0, shown.decode()
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode())
    assert re.search(r"run +budget +submits +best mean +tokens +state +last action", text)
    assert re.search(r"fake codex/toy/line/0 +[0-4]/4 +\d", text)
    assert "0 of 1 runs done, 1 running" in text
    assert "completed, score" in text


KILLED = """
import os, sys
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run import lifecycle
from evopolicy_gateway.cli.main import main

create, save = Operations.create, lifecycle.save

async def created(*arguments):
    await create(*arguments)
    os.kill(os.getpid(), 9)

def saved(path, value):
    save(path, value)
    if getattr(value, "run", ""):
        os.kill(os.getpid(), 9)

if sys.argv.pop(1) == "created":
    Operations.create = created
else:
    lifecycle.save = saved
main()
"""
"""`evopolicy`, killed once the coordinator has opened a run, or once the run's folder says so."""


@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize("at", ["created", "saved"])
def test_a_killed_sweep_leaves_no_open_run(
    tmp_path: Path, operator_file: Path, at: str, changed: bool
) -> None:
    write_suite(tmp_path)
    given = ["--credentials", str(operator_file)]
    arguments = ["suite", "t.toml", *given, "--only", "evolve/*"]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, at, *arguments],
        cwd=tmp_path,
        env={**os.environ, "XDG_STATE_HOME": str(tmp_path / "xdg")},
        capture_output=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    if changed:
        file = tmp_path / "t.toml"
        file.write_text(file.read_text().replace("budget = 4", "budget = 5"))
        arguments += ["--changed", "rerun"]
    ended(tmp_path, *arguments)
    (entry,) = index_in(tmp_path / "runs" / "t").values()
    assert entry["state"] == "completed"
    # The agent continues what it has begun, which is nothing here.
    assert entry["attempt"] == (2 if changed else 1)
    with command(tmp_path, "status", "--json", *given) as listed:
        assert listed.wait() == 0, listed.text
        assert json.loads(listed.out)["runs"] == []
