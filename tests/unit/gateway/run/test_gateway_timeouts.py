"""Timeouts of the agent's side fire: what it waits for never comes, and it goes on, gives up or ends it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateway_double import served
from program_runs import put_program, run_python
from stages import cli_stage, command_stage
from stages.cli_stage import settings
from starlette.responses import PlainTextResponse

from evopolicy_common.errors import ConfigError
from evopolicy_common.wire import http as server
from evopolicy_gateway.agents.client import Client, GatewayError
from evopolicy_gateway.harnesses import command
from evopolicy_gateway.harnesses.coding_agents import cli_agent, turn
from evopolicy_gateway.harnesses.interface import base
from evopolicy_gateway.http import service as http
from evopolicy_gateway.jail import settings as jail_settings
from evopolicy_gateway.processes import agent_process
from evopolicy_gateway.processes.child_messages import Child
from evopolicy_gateway.run import lifecycle
from evopolicy_gateway.run.lifecycle import RunLifecycle

SOON_S = 0.2
STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(1000)"  # noqa: E501


@contextlib.contextmanager
def mute_server() -> Iterator[str]:
    """Where connections are taken and nothing is ever said."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"


# The agents' own side.


def test_an_agent_gives_up_on_a_gateway_that_says_nothing() -> None:
    with mute_server() as url:
        client = Client(info_url=url, task_url=url, submit_url=url, answer_s=SOON_S, timeout_s=SOON_S)
        with pytest.raises(GatewayError, match="did not answer"):
            client.info()


def test_info_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "_INFO_TIMEOUT_S", SOON_S)
    with mute_server() as url, pytest.raises(OSError, match="timed out"):
        base._get_json(url)


def test_info_of_a_gateway_killed_while_answering_did_not_come() -> None:
    def begin_to_answer(listening: socket.socket) -> None:
        link, _ = listening.accept()
        with link:
            link.recv(1000)
            link.sendall(b'HTTP/1.1 200 OK\r\ncontent-length: 700\r\n\r\n{"state"')

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=begin_to_answer, args=(listening,))
        thread.start()
        with pytest.raises(OSError, match="did not answer to the end"):
            base._get_json(f"http://127.0.0.1:{listening.getsockname()[1]}")
        thread.join()


def test_a_program_that_stays_after_stop_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "_STOP_TIMEOUT_S", SOON_S)
    code = """
import json, os, sys, time
open("pid", "w").write(str(os.getpid()))
turn = json.loads(sys.stdin.readline())["turn"]
print(json.dumps({"turn": turn, "text": "", "stop": True}), flush=True)
time.sleep(1000)
"""
    try:
        ending, _, turns = command_stage.play(tmp_path, code)
        assert (ending.reason, turns) == ("agent_stopped", [(1, "")])
    finally:
        # Closing the pipes to it kills it: by now it may be gone.
        with contextlib.suppress(ProcessLookupError):
            os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)


def test_pipes_that_a_child_holds_are_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "_PIPE_TIMEOUT_S", SOON_S)
    monkeypatch.setattr(agent_process, "_LAST_WORDS_S", SOON_S)
    assert command_stage.play_with_a_child_that_holds_the_pipes(tmp_path).reason == "agent_stopped"


# Coding agents' CLIs.


def test_a_cli_that_tells_no_version_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli_agent, "_PROBE_TIMEOUT_S", SOON_S)
    mute = put_program(tmp_path / "bin" / "claude", "exec sleep 1000")
    path = f"{mute.parent}:{os.environ['PATH']}"
    with pytest.raises(base.AgentError, match=r"does not answer --version.*timed out"):
        cli_stage.play(tmp_path, settings("claude-code"), "work", PATH=path)


@pytest.mark.parametrize("scenario", ["lingers", "lingers_stubborn"])
def test_a_cli_that_does_not_exit_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenario: str
) -> None:
    """Also one that ignores SIGTERM."""
    monkeypatch.setattr(turn, "DONE_TIMEOUT_S", SOON_S)
    monkeypatch.setattr(turn, "_KILL_GRACE_S", SOON_S)
    played = cli_stage.play(tmp_path, settings("claude-code"), scenario, budget=2)
    assert (played.ending.reason, played.ending.turns, played.ending.retries) == ("agent_stopped", 1, 0)


def test_a_child_with_a_clis_pipe_delays_no_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turn, "_PIPE_TIMEOUT_S", SOON_S)
    try:
        played = cli_stage.play(tmp_path, settings("claude-code"), "leaves_child", budget=2)
        assert (played.ending.reason, played.ending.turns) == ("agent_stopped", 1)
    finally:
        os.kill(int((tmp_path / "fake" / "child").read_text()), signal.SIGKILL)


SUPERVISOR = """
import asyncio, sys
from evopolicy_gateway.processes.child_messages import StartAgent, StopAgent
from evopolicy_gateway.agent_supervisor import supervisor
from evopolicy_gateway.harnesses.interface.base import Harness

class Deaf(Harness):
    name, command = "deaf", []
    async def run_agent(self, stage):
        await asyncio.sleep(1000)

class Orders:
    async def next(self):
        return StopAgent()

supervisor.make = lambda *given: Deaf()
supervisor.LAST_WORDS_S = 0.2
order = StartAgent(agent="deaf", folder=".", urls={}, started_in=".", wall_limit_s=1000.0)
print(asyncio.run(supervisor.keep(order, Orders())).reason)
"""


def test_a_harness_that_does_not_end_with_its_programs_is_cut_off(tmp_path: Path) -> None:
    done = run_python(SUPERVISOR, cwd=tmp_path)
    assert done.stdout.splitlines()[-1:] == ["told"], done.stderr


# The jail.


def test_a_bubblewrap_that_hangs_builds_no_jail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jail_settings, "_TIMEOUT_S", SOON_S)
    put_program(tmp_path / "bwrap", "exec sleep 1000")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(ConfigError, match="timed out"):
        jail_settings.check_bubblewrap()


# The gateway's service.


async def _sent(url: str, text: str) -> bytes:
    """The service's answer to a client that sends this and then nothing more."""
    host, _, rest = url.removeprefix("http://").partition("/")
    reader, writer = await asyncio.open_connection(*host.split(":"))
    writer.write(text.replace("PATH", f"/{rest}").encode())
    try:
        return await asyncio.wait_for(reader.read(), 30)
    finally:
        writer.close()


async def test_a_body_of_a_stranger_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "STRANGER_LINGER", (1 << 20, SOON_S))
    received: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        await asyncio.sleep(1000)
        return {}

    async def send(message: Any) -> None:
        received.append(message)

    gate = http._TokenGate(PlainTextResponse("never"), "token", "bearer")
    scope = {"type": "http", "method": "POST", "path": "/token/submit", "headers": []}
    async with asyncio.timeout(60):
        await gate(scope, receive, send)  # type: ignore[arg-type]
    assert received[0]["status"] in (401, 403)
    assert received[-1]["more_body"] is False


async def test_an_unawaited_submit_is_answered_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "DECIDED_WAIT_S", SOON_S)

    async with served(tmp_path) as s:
        s.double.up = False
        answer = await s.submit([0], wait=False)
        assert answer.status_code == 202
        s.double.up = True
        await s.pipeline.idle()


async def test_an_idle_connection_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "KEEP_ALIVE_S", 1)
    async with served(tmp_path) as s:
        answer = await _sent(s.urls.info, "GET PATH HTTP/1.1\r\nhost: x\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200")


async def test_an_endless_request_does_not_delay_the_services_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "CLOSE_GRACE_S", 1)

    asked = asyncio.Event()

    async def never(scope: Any, receive: Any, send: Any) -> None:
        asked.set()
        await asyncio.sleep(1000)
        await PlainTextResponse("late")(scope, receive, send)

    sock = socket.socket()
    sock.bind(("127.0.0.1", 0))
    async with asyncio.timeout(60), server.serving(never, sock):
        _, writer = await asyncio.open_connection(*sock.getsockname())
        writer.write(b"GET / HTTP/1.1\r\nhost: x\r\n\r\n")
        await asked.wait()
    writer.close()


# The operator's side.


async def test_a_child_that_ignores_being_asked_is_killed(tmp_path: Path) -> None:
    child = await Child.start([sys.executable, "-c", STUBBORN], tmp_path / "log", talks=True)
    assert child._process.stdout is not None
    await child._process.stdout.readline()
    await child.end(SOON_S)
    assert child.exit_code == -signal.SIGKILL


async def test_giving_up_ends_without_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifecycle, "GIVE_UP_TIMEOUT_S", SOON_S)

    class Deaf:
        async def cancel(self, run: str) -> None:
            await asyncio.sleep(1000)

    plan: Any = SimpleNamespace(folder=None, name="", settings=SimpleNamespace(env="toy/line"))
    running = RunLifecycle(plan, Deaf(), None, None)  # type: ignore[arg-type]
    async with asyncio.timeout(60):
        await running._give_up(None)


UNKILLABLE = """
import subprocess, sys
from evopolicy_gateway.processes import trees as processes
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
processes.KILL_PATIENCE_S = 0.2
signal_all, processes._signal_all = processes._signal_all, lambda pids, number: None
print(processes.end_descendants(0.0) == [child.pid])
child.kill()
child.wait()
"""


def test_processes_that_survive_killing_are_reported() -> None:
    assert run_python(UNKILLABLE).stdout == "True\n"
