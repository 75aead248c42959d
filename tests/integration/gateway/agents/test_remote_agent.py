"""An agent on another host, or in a container: a bearer token with every request, and a run that waits for it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import stat
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from gateway_double import Served, answering, gateway_on, prepared
from typer.testing import CliRunner
from waiting import wait_until

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.run_record import RunRecord, decode_run_record
from evopolicy_gateway.cli.main import app as evopolicy
from evopolicy_gateway.run_folder.layout import RunFolder, save
from evopolicy_gateway.run_folder.listener import Listener, finish, listener_of

HOST = "127.0.0.2"
"""Of this machine, and not what a gateway listens on by itself."""
TIMEOUT_S = 120.0


@asynccontextmanager
async def open_listener(tmp_path: Path, listener: Listener | None = None) -> AsyncIterator[Served]:
    """A gateway that serves a remote agent."""
    async with prepared(tmp_path) as (folder, double):
        save(folder.listener, listener or Listener(host=HOST, port=0))
        async with gateway_on(folder, double) as service:
            yield service


def token_of(folder: RunFolder) -> str:
    return folder.bearer.read_text().strip()


async def test_without_the_bearer_token_everything_is_the_same_401(tmp_path: Path) -> None:
    async with open_listener(tmp_path) as s:
        token = token_of(s.folder)
        root = s.urls.info.removesuffix("/info")
        given: list[dict[str, str] | list[tuple[str, str]]] = [
            {},
            {"Authorization": "Bearer"},
            {"Authorization": f"Bearer {token[:-1]}"},
            {"Authorization": f"Bearer {token}0"},
            {"Authorization": f"Basic {token}"},
            {"Authorization": token},
            [("Authorization", f"Bearer {token}"), ("Authorization", "Bearer other")],
        ]
        answers = [
            await s.http.request(method, url, headers=headers, content=b"{}" if method == "POST" else None)
            for headers in given
            for method, url in (
                ("GET", s.urls.info),
                ("GET", s.urls.task),
                ("POST", s.urls.submit),
                ("GET", f"{root}/submit/submit_000"),
                ("GET", f"{root}/../../etc/passwd"),
                ("DELETE", root),
            )
        ]
        assert {answer.status_code for answer in answers} == {401}
        assert len({(answer.content, tuple(answer.headers.items())) for answer in answers}) == 1
        assert answers[0].headers["WWW-Authenticate"] == "Bearer"
        assert not any(secret in answers[0].text for secret in (token, s.double.capability, str(tmp_path)))
        assert s.double.submits == []
        assert s.pipeline.machine.n_rejected == 0


async def test_with_the_bearer_token_a_remote_agent_is_served_as_any_other(tmp_path: Path) -> None:
    async with open_listener(tmp_path) as s:
        for scheme in ("Bearer", "bearer"):
            headers = {"Authorization": f"{scheme} {token_of(s.folder)}"}
            assert (await s.http.get(s.urls.info, headers=headers)).status_code == 200
        answer = await s.http.post(s.urls.submit, json={"env_instances": [1]}, headers=headers)
        assert answer.json()["status"] == "ok"
        elsewhere = s.urls.info.replace("/info", "/nothing")
        assert (await s.http.get(elsewhere, headers=headers)).status_code == 404
        assert urlsplit(s.urls.info).hostname == HOST


async def test_a_large_body_of_a_stranger_is_not_read_to_its_end(tmp_path: Path) -> None:
    async with open_listener(tmp_path) as s:
        address = urlsplit(s.urls.submit)
        _, writer = await asyncio.open_connection(address.hostname, address.port)
        head = f"POST {address.path} HTTP/1.1\r\nHost: x\r\nContent-Length: {1 << 30}\r\n\r\n"
        writer.write(head.encode())
        sent = 0
        with contextlib.suppress(ConnectionError):
            while sent < 1 << 30:
                writer.write(b"x" * (1 << 16))
                sent += 1 << 16
                await writer.drain()
        assert sent < 64 << 20
        writer.close()


async def test_the_token_is_a_lasting_file_for_the_operator_alone(tmp_path: Path) -> None:
    async with open_listener(tmp_path) as s:
        assert stat.S_IMODE(s.folder.bearer.stat().st_mode) == 0o600
        first = (s.urls, token_of(s.folder))
        assert len(bytes.fromhex(first[1])) * 8 == 256
        assert not s.folder.bearer.is_relative_to(s.folder.workspace)
        assert first[1] not in (s.folder.workspace / "AGENTS.md").read_text()
        folder, double = s.folder, s.double
    async with answering(tmp_path, double), gateway_on(folder, double) as s:
        assert (s.urls, token_of(s.folder)) == first


async def test_every_command_in_a_remote_agents_rules_runs_as_it_stands(tmp_path: Path) -> None:
    async with open_listener(tmp_path) as s:
        text = (s.folder.workspace / "AGENTS.md").read_text()
        surroundings = {**os.environ, "EVOPOLICYGYM_TOKEN": token_of(s.folder)}
        shell = [block.split("```")[0] for block in text.split("```bash\n")[1:]]
        python = text.split("```python\n")[1].split("```")[0]
        lines = []
        for command in [*(["bash", "-euc", one] for one in shell), [sys.executable, "-c", python]]:
            process = await asyncio.create_subprocess_exec(
                *command,
                cwd=s.folder.workspace,
                env=surroundings,
                stdout=asyncio.subprocess.PIPE,
            )
            out, _ = await process.communicate()
            assert process.returncode == 0, command
            lines.append(out.decode())
        assert lines[0].startswith("# A line")
        assert json.loads(lines[2])["status"] == "ok"
        assert lines[-1].startswith("feedback/submit_001 ok")


async def test_the_rules_tell_the_url_by_which_the_agent_reaches_the_service(tmp_path: Path) -> None:
    async with open_listener(tmp_path, Listener(host=HOST, port=0, url="https://gym.example/run-7")) as s:
        assert s.urls.submit.startswith("https://gym.example/run-7/")
        assert s.urls.submit in (s.folder.workspace / "AGENTS.md").read_text()


@pytest.mark.parametrize(
    ("http", "url", "problem"),
    [
        ("10.0.0.5", None, "HOST:PORT"),
        (":80", None, "HOST:PORT"),
        ("10.0.0.5:http", None, "HOST:PORT"),
        ("10.0.0.5:65536", None, "HOST:PORT"),
        ("0.0.0.0:80", None, "--http-url"),
        ("[::]:80", None, "--http-url"),
        ("10.0.0.5:80", "ftp://gym.example", "https://HOST"),
        ("10.0.0.5:80", "https://gym.example/'; rm -rf x", "without quotes"),
    ],
)
def test_an_address_that_cannot_be_served_is_refused_by_name(
    http: str, url: str | None, problem: str
) -> None:
    with pytest.raises(ConfigError, match=problem):
        listener_of(http, url)


def test_a_listener_has_the_address_that_the_operator_named() -> None:
    assert listener_of("[fd00::5]:8080", None) == Listener(host="fd00::5", port=8080)
    assert listener_of("0.0.0.0:80", "https://gym.example/") == Listener(
        host="0.0.0.0", port=80, url="https://gym.example"
    )


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("remote", "needs --http"),
        ("evolve --http 10.0.0.5:8080 --jail none", "applies only with --agent remote"),
        ("remote --http 127.0.0.1:0 --jail open-network", "not started by this command"),
        ("remote --http-url https://gym.example", "needs"),
        ("evolve --agent-host elsewhere", "applies only with --agent remote"),
        ("remote --http 127.0.0.1:0 --agent-host my-laptop", "boot_id"),
        ("evolve --set hidden_cases=mine", "'shared', 'per-run'"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path: Path, options: str, problem: str) -> None:
    words = ["run", "--env", "toy/line", "--runs", str(tmp_path), "--agent", *options.split()]
    done = CliRunner().invoke(evopolicy, words)
    assert done.exit_code == 2, done.stderr
    assert problem in done.stderr
    assert list(tmp_path.iterdir()) == []


class RemoteRun:
    """`evopolicy run --agent remote` on the module's cluster, and what it tells its operator."""

    record: RunRecord

    def __init__(self, operator_file: Path, root: Path, *options: str) -> None:
        self.folder = RunFolder(root / "runs" / "theirs" / "toy_line" / "r")
        words = ["run", "--credentials", str(operator_file), "--env", "toy/line", "--agent", "remote"]
        words += ["--http", f"{HOST}:0", "--entry", "theirs", "--exp-id", "r", "--runs", str(root / "runs")]
        words += ["--budget", "4", "--validation", "1", "--heldout", "1", *options]
        self.log = root / "log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "evopolicy_gateway.cli", *words],
                cwd=root,
                env={**os.environ, "XDG_STATE_HOME": str(root / "xdg")},
                stdout=log,
                stderr=log,
            )

    @property
    def said(self) -> str:
        return self.log.read_text()

    def submit(self, episodes: list[int], token: str = "") -> tuple[int, str]:
        """Status of the answer, and of the submit."""
        url = next(line.split()[-1] for line in self.said.splitlines() if "served at" in line)
        body = json.dumps({"env_instances": episodes}).encode()
        headers = {"Authorization": f"Bearer {token or token_of(self.folder)}"}
        try:
            with urllib.request.urlopen(
                urllib.request.Request(url, body, headers), timeout=TIMEOUT_S
            ) as answer:
                return answer.status, json.load(answer)["status"]
        except urllib.error.HTTPError as error:
            with error:
                return error.code, ""


@contextlib.contextmanager
def remote_run(operator_file: Path, root: Path, *options: str, code: int = 0) -> Iterator[RemoteRun]:
    """A run that is served. It has to end with the `with`, with this status; its record is there then."""
    run = RemoteRun(operator_file, root, *options)
    try:
        served = "when it is done before its budget"
        wait_until(lambda: served in run.said or run.process.poll() is not None, lambda: run.said)
        yield run
        assert run.process.wait(timeout=TIMEOUT_S) == code, run.said
        run.record = decode_run_record(run.folder.run_json.read_bytes())
    finally:
        run.process.terminate()
        run.process.wait(timeout=TIMEOUT_S)


def test_a_remote_run_ends_when_the_operator_says_so(operator_file: Path, tmp_path: Path) -> None:
    with remote_run(operator_file, tmp_path) as run:
        token = token_of(run.folder)
        assert str(run.folder.bearer) in run.said
        assert token not in run.said
        assert run.submit([0, 1], "guess") == (401, "")
        assert run.submit([0, 1]) == (200, "ok")
        assert (run.folder.feedback / "submit_000" / "summary.json").exists()
        with pytest.raises(SystemExit) as ended:
            evopolicy(["finish", str(run.folder.root)])
        assert ended.value.code == 0
    record = run.record
    assert (record.agent.harness, record.jail, record.outcome.budget_used) == ("remote", "none", 2)
    assert record.outcome.closed_reason == "agent_stopped"
    assert token not in run.said + run.folder.harness_log.read_text()
    assert not run.folder.state.exists()


def test_a_spent_remote_run_is_scored_once_its_agent_has_ended(operator_file: Path, tmp_path: Path) -> None:
    with remote_run(operator_file, tmp_path) as run:
        assert "it may be any: no hidden case" in run.said
        assert run.submit([0, 1, 2, 3]) == (200, "ok")
        wait_until(lambda: "waiting for the agent's end" in run.said)
        assert run.submit([0])[0] == 409
        assert run.process.poll() is None
        finish(run.folder)
    assert (run.record.outcome.closed_reason, run.record.hidden_isolation) == ("budget_spent", "exclusive")


def test_a_remote_run_ends_when_its_agents_time_is_over(operator_file: Path, tmp_path: Path) -> None:
    options = ("--agent-wall-s", "1", "--agent-host", "elsewhere")
    with remote_run(operator_file, tmp_path, *options, code=3) as run:
        pass
    assert run.record.outcome.closed_reason == "wall_limit"
