"""A coordinator that hears every question and answers none: each who asks gives up in time, and says so."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import structlog
from structlog.testing import capture_logs

from evopolicy_common.errors import TransportError
from evopolicy_common.messages.operator import Done, WaitRun
from evopolicy_common.wire import codec, keys, operator_client, requests, transport
from evopolicy_common.wire.credentials import Credentials, Role
from evopolicy_common.wire.requests import Requester
from evopolicy_common.wire.transport import IncomingQuery, Link
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.submits import coordinator_client
from evopolicy_gateway.submits.coordinator_client import CoordinatorClient
from evopolicy_results.evaluations import Evaluations
from evopolicy_results.verify import run as verify_run

SOON_S = 0.2
QUESTION = WaitRun(token="", run="r", wait_s=0.0)


@contextlib.asynccontextmanager
async def mute(folder: Path, role: Role = "operator") -> AsyncIterator[Link]:
    """A link to a coordinator that keeps silent."""
    heard: list[IncomingQuery] = []
    (folder / "passwords").write_text(f"{role}:secret\n")
    endpoints = (f"unixsock-stream/{folder}/sock",)
    config = transport.server_config("test", endpoints, folder / "passwords", [(role, role)])
    found = Credentials(
        cluster="test", role=role, endpoints=endpoints, user=role, password="secret", token=""
    )
    async with asyncio.timeout(60), transport.serve(config, heard.extend) as server:
        server.declare(keys.requests("test").values())
        async with transport.connect(found) as link:
            yield link


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "ANSWER_S", SOON_S)
    for module in (operator_client, verify_run):
        monkeypatch.setattr(module, "TIMEOUT_S", SOON_S)


def asking(link: Link) -> Requester[Any]:
    return Requester(link, lambda verb: keys.operator_key("test", verb), codec.operator_replies)


async def test_a_client_that_retries_reports_why_and_gives_up_at_its_timeout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "WARN_AFTER_S", 0.0)
    with capture_logs() as logs:
        monkeypatch.setattr(requests, "log", structlog.get_logger())
        async with mute(tmp_path) as link:
            with pytest.raises(TransportError, match="no answer"):
                await asking(link).once("wait", QUESTION, Done)
            with pytest.raises(TransportError):
                await asking(link).until_answered("wait", QUESTION, Done, timeout_s=0.5)
    reasons = [entry["why"] for entry in logs if entry["event"] == "still waiting for the coordinator"]
    assert reasons
    assert all("no answer" in text for text in reasons)


async def test_operators_commands_give_up(tmp_path: Path) -> None:
    async with mute(tmp_path) as link:
        with pytest.raises(TransportError):
            await Operations(link).cancel("r")
        verification: Any = object.__new__(verify_run.Verifier)
        verification._evaluations = Evaluations(link, lambda count, waits_for: None)
        verification._knows_run = True
        verification._run = SimpleNamespace(record=SimpleNamespace(run="r"))
        with pytest.raises(TransportError):
            await verification._recordings(SimpleNamespace(split="train", submit_index=0), [0])


async def test_info_is_answered_without_a_state_that_does_not_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coordinator_client, "STATE_TIMEOUT_S", SOON_S)
    async with mute(tmp_path, "gateway") as link:
        assert await CoordinatorClient(link, "r").state() is None


class StuckSession:
    """Takes questions and never ends them; does not close."""

    def __init__(self) -> None:
        self.released = threading.Event()
        self.kept: list[Any] = []

    def get(self, *args: Any, **more: Any) -> None:
        self.kept.append((args, more))

    def close(self) -> None:
        self.released.wait()


async def test_a_session_that_is_stuck_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "STUCK_S", SOON_S)
    monkeypatch.setattr(transport, "_CLOSE_S", SOON_S)
    stuck = StuckSession()
    found = Credentials(cluster="c", role="operator", endpoints=(), user="o", password="", token="")
    link = Link(stuck, found)  # type: ignore[arg-type]
    with pytest.raises(TransportError, match="no answer"):
        await link.query("evopolicy/v1/c/ops/status", b"", 0.0)
    await asyncio.to_thread(link.close)
    stuck.released.set()


async def test_a_worker_that_nobody_answers_is_told_the_causes_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_PATIENCE_S", 0.0)
    found = Credentials(
        cluster="c", role="worker", endpoints=("tcp/127.0.0.1:9",), user="worker", password="p", token="t"
    )
    with capture_logs() as logs, contextlib.suppress(TimeoutError):
        monkeypatch.setattr(transport, "log", structlog.get_logger())
        async with asyncio.timeout(3.0), transport.connect(found, timeout_s=None):
            pytest.fail("something listens there")
    told = [entry["event"] for entry in logs if "is the coordinator up there" in entry["event"]]
    assert len(told) == 1
