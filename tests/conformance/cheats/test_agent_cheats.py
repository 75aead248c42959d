"""Agents that cheat, beside honest ones: what the jail stops, and that nothing else would."""

from __future__ import annotations

import json
import os
import stat
import sys
import time
from datetime import datetime
from pathlib import Path

import pytest
from attacks.cheated import Cheated, CheatingRun

from evopolicy_common.records.run_record import decode_run_record

STOPPED = (
    *("forge feedback", "add feedback", "move feedback away", "rewrite the rules", "replace the rules"),
    *("mount over feedback", "move the workspace away", "read the gateway's memory"),
    *("list the coordinator's state", "read the operator's credentials", "read the gateway's credentials"),
    *("read another run", "read the operator's variables", "stop the coordinator"),
    *("find the cluster's processes", "knock at the coordinator's socket", "open a Zenoh session"),
    *("connect to a port of this machine", "connect to an abstract socket", "ask the proxy for another port"),
    *("import a simulator", "find a simulator's files", "send to the world", "list the runs"),
    *("open a socket to the machine below", "open a ring that makes sockets"),
    "open a socket by a system call of 32-bit programs",
    *("read another process's variables", "change the kernel's settings"),
    *("read a key of the operator's login", "leave a note for other runs in a keyring"),
    *("read what is hidden from the jail's own command", "find a process of the jail that no filter holds"),
    *("read what the kernel counts for the whole machine", "see when the machine is at work"),
    *("read the kernel's log", "leave a program that runs with the operator's rights"),
    "have later files made for everybody by an access control list",
)
HOME = "read the operator's home"
NEEDS_MORE_THAN_NO_JAIL = {
    *("mount over feedback", "send to the world", "change the kernel's settings", "read the kernel's log"),
    # File systems without such lists refuse it.
    "have later files made for everybody by an access control list",
    # There is none outside.
    "read what is hidden from the jail's own command",
    # Stopped without a jail too: its agent supervisor leaves the login's keyring behind.
    "read a key of the operator's login",
    *("read another process's variables", "read the gateway's memory"),
    *("open a socket to the machine below", "open a ring that makes sockets"),
    "open a socket by a system call of 32-bit programs",
}
"""Whether they succeed without a jail depends on the machine: on root, on a route, on what processes keep to
themselves."""


@pytest.mark.parametrize("cheat", STOPPED)
def test_the_jail_stops_a_cheat(jailed: CheatingRun, cheat: str) -> None:
    assert "stopped" in jailed.report[cheat] or not jailed.report[cheat]["got"], jailed.report[cheat]


@pytest.mark.parametrize("cheat", [name for name in STOPPED if name not in NEEDS_MORE_THAN_NO_JAIL])
def test_the_cheat_is_one_where_there_is_no_jail(unjailed: CheatingRun, cheat: str) -> None:
    assert unjailed.report[cheat].get("got"), unjailed.report[cheat]


def test_the_operators_home_is_seen_only_where_the_operator_binds_it(
    jailed: CheatingRun, unjailed: CheatingRun
) -> None:
    assert unjailed.report[HOME]["got"]
    if jailed.folder.name == "jailed":
        assert "stopped" in jailed.report[HOME]


def test_nothing_of_the_jail_reaches_a_port_of_this_machine(
    jailed: CheatingRun, unjailed: CheatingRun
) -> None:
    assert jailed.heard == []
    assert any("/simple/nothing" in heard for heard in unjailed.heard)
    assert any("/nothing.git" in heard for heard in unjailed.heard)


def test_nothing_left_in_a_closed_run_is_for_other_users(jailed: CheatingRun, unjailed: CheatingRun) -> None:
    """Attack: leaves access control lists, capabilities, folders that all may write, files of other
    owners, sockets, pipes. Defence: extended attributes cannot be set; closing the run takes all of
    these away."""
    for folder in (jailed.folder, unjailed.folder):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        left = [folder, *(path for path in folder.rglob("*") if not path.is_symlink())]
        loose = stat.S_ISUID | stat.S_ISGID | stat.S_IWOTH
        assert {path.name for path in left if path.stat().st_mode & loose} == set()
        assert {path.name for path in left if "system.posix_acl_default" in os.listxattr(path)} == set()
        assert (folder / "workspace" / "left-open-to-all").read_text() == "for everybody"


def test_a_cheating_run_is_scored_by_its_honest_submit_alone(jailed: CheatingRun) -> None:
    feedback = jailed.folder / "workspace" / "feedback"
    assert [path.name for path in feedback.iterdir()] == ["submit_000"]
    document = json.loads((feedback / "submit_000" / "summary.json").read_text())
    assert document == jailed.report["submit"]["summary"]
    assert jailed.record.outcome.status == "completed"
    assert jailed.record.outcome.budget_used == 2


def check_child_gone(run: CheatingRun) -> None:
    """The child that was left behind was at work, is gone, and was so when the run was closed."""
    assert run.report["leave a child behind"]["got"]
    beat = run.folder / "workspace" / "beat"
    last = beat.read_text()
    time.sleep(0.3)
    assert beat.read_text() == last
    lines = map(json.loads, (run.folder / "logs" / "harness.log").read_text().splitlines())
    (closed,) = [line for line in lines if line["event"] == "run closed"]
    assert float(last) < datetime.fromisoformat(closed["timestamp"]).timestamp()


def test_a_hidden_child_is_gone_with_its_jail_before_the_close(jailed: CheatingRun) -> None:
    check_child_gone(jailed)


def test_an_unjailed_hidden_child_is_gone_before_the_run_is_closed(unjailed: CheatingRun) -> None:
    check_child_gone(unjailed)


def test_what_was_used_is_recorded(jailed: CheatingRun, unjailed: CheatingRun) -> None:
    assert (jailed.record.jail, unjailed.record.jail) == ("bwrap", "none")
    widened = jailed.record.agent.settings.get("jail", {})
    assert ("read" in widened) == (jailed.folder.name == "bound")


@pytest.mark.parametrize("agent", ["evolve", "random"])
def test_an_honest_agent_plays_its_run_in_the_jail(cheated: Cheated, agent: str) -> None:
    code, output, folder = cheated.play(agent, f"honest-{agent}")
    assert code == 0, output
    record = decode_run_record((folder / "run.json").read_bytes())
    assert (record.outcome.status, record.outcome.budget_used, record.jail) == ("completed", 4, "bwrap")


def test_an_honest_agent_reaches_what_the_operator_names_and_nothing_else(
    cheated: Cheated, tmp_path: Path
) -> None:
    code = """
import json, os, socket, urllib.request
port = PORT
with socket.create_connection(("127.0.0.1", port), 5) as sock:
    direct = sock.recv(5).decode()
host, _, proxy = os.environ["HTTPS_PROXY"].rpartition("/")[2].partition(":")
with socket.create_connection((host, int(proxy)), 5) as sock:
    sock.sendall(f"CONNECT localhost:{port} HTTP/1.1\\r\\n\\r\\n".encode())
    received = b""
    while not received.endswith(b"hello"):
        received += sock.recv(100)
home = os.path.expanduser("~")
notes = open(os.path.join(home, "notes")).read()
open(os.path.join(home, "mine"), "w").close()
body = json.dumps({"env_instances": [0]}).encode()
urllib.request.urlopen(urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=body)).read()
open("report.json", "w").write(json.dumps([direct, received.decode(), notes, os.environ["OPERATORS_SECRET"]]))
"""
    program = tmp_path / "agent.py"
    program.write_text(code.replace("PORT", str(cheated.listener.port)))
    options = ["--allow-host", f"localhost:{cheated.listener.port}", "--jail-env", "OPERATORS_SECRET"]
    options += ["--jail-bind", str(cheated.home / "notes")]
    exit_code, output, folder = cheated.play(f"command:{sys.executable} {program}", "named", *options)
    assert exit_code == 0, output
    direct, proxied, notes, variable = json.loads((folder / "workspace" / "report.json").read_text())
    assert (direct, proxied[:12]) == ("hello", "HTTP/1.1 200")
    assert notes == variable
    assert not (cheated.home / "mine").exists()
    settings = decode_run_record((folder / "run.json").read_bytes()).agent.settings["jail"]
    assert settings["environment"] == ["OPERATORS_SECRET"]


def test_without_bubblewrap_there_is_no_run_unless_the_jail_is_given_up(
    cheated: Cheated, tmp_path: Path
) -> None:
    path = cheated.environment["PATH"]
    cheated.environment["PATH"] = str(tmp_path)
    try:
        code, output, folder = cheated.play("evolve", "no-bubblewrap")
    finally:
        cheated.environment["PATH"] = path
    assert code == 2
    assert "--jail none" in output
    assert not folder.exists()


def test_an_agent_out_of_time_is_asked_before_its_jail_ends(cheated: Cheated, tmp_path: Path) -> None:
    program = tmp_path / "agent.py"
    program.write_text(
        "import signal, sys, time\n"
        "def bye(*_):\n"
        "    open('bye', 'w').close()\n"
        "    sys.exit(0)\n"
        "signal.signal(signal.SIGTERM, bye)\n"
        "open('ready', 'w').close()\n"
        "time.sleep(1000)\n"
    )
    options = ["--agent-wall-s", "3"]
    code, output, folder = cheated.play(f"command:{sys.executable} {program}", "asked", *options)
    assert code == 3, output
    assert (folder / "workspace" / "ready").exists()
    assert (folder / "workspace" / "bye").exists()
