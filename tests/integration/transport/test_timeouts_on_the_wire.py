"""A coordinator that hears every question and answers none: each who asks gives up in time, and says so."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
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
async def mute(folder: Path, role: Role) -> AsyncIterator[Link]:
    """A link to a coordinator that keeps silent."""
    heard: list[IncomingQuery] = []
    (folder / "passwords").write_text(f"{role}:secret\n")
    endpoint = f"unixsock-stream/{folder}/sock"
    config = transport.server_config("test", [endpoint], folder / "passwords", {role: role})
    async with transport.serve(config, heard.extend) as server:
        server.declare([keys.gateway_expr("test"), keys.operator_expr("test")])
        found = Credentials(
            cluster="test", role=role, endpoints=(endpoint,), user=role, password="secret", token=""
        )
        async with transport.connect(found) as link:
            yield link


def run(folder: Path, role: Role, scenario: Callable[[Link], Awaitable[None]]) -> None:
    async def main() -> None:
        async with asyncio.timeout(60), mute(folder, role) as link:
            await scenario(link)

    asyncio.run(main())


def asking(link: Link) -> Requester[Any]:
    return Requester(link, lambda verb: keys.operator_key("test", verb), codec.operator_replies)


def test_a_question_that_is_not_answered_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "ANSWER_S", SOON_S)

    async def scenario(link: Link) -> None:
        with pytest.raises(TransportError, match="no answer"):
            await asking(link).once("wait", QUESTION, Done)

    run(tmp_path, "operator", scenario)


def test_a_client_that_retries_reports_why_and_gives_up_at_its_timeout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "ANSWER_S", SOON_S)
    monkeypatch.setattr(requests, "WARN_AFTER_S", 0.0)

    async def scenario(link: Link) -> None:
        with pytest.raises(TransportError):
            await asking(link).until_answered("wait", QUESTION, Done, timeout_s=0.5)

    with capture_logs() as logs:
        monkeypatch.setattr(requests, "log", structlog.get_logger())
        run(tmp_path, "operator", scenario)
    reasons = [entry["why"] for entry in logs if entry["event"] == "still waiting for the coordinator"]
    assert reasons
    assert all("no answer" in text for text in reasons)


def test_an_operators_command_gives_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "ANSWER_S", SOON_S)
    monkeypatch.setattr(operator_client, "TIMEOUT_S", SOON_S)

    async def scenario(link: Link) -> None:
        with pytest.raises(TransportError):
            await Operations(link).cancel("r")

    run(tmp_path, "operator", scenario)


def test_a_verification_gives_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "ANSWER_S", SOON_S)
    monkeypatch.setattr(verify_run, "TIMEOUT_S", SOON_S)

    async def scenario(link: Link) -> None:
        verification: Any = object.__new__(verify_run.Verifier)
        verification._evaluations = Evaluations(link, lambda count, waits_for: None)
        verification._run = SimpleNamespace(record=SimpleNamespace(run="r"))
        with pytest.raises(TransportError):
            await verification._stored(SimpleNamespace(split="train", submit_index=0))

    run(tmp_path, "operator", scenario)


def test_info_is_answered_without_a_state_that_does_not_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coordinator_client, "STATE_TIMEOUT_S", SOON_S)

    async def scenario(link: Link) -> None:
        assert await CoordinatorClient(link, "r").state() is None

    run(tmp_path, "gateway", scenario)


class StuckSession:
    """Takes questions and never ends them; does not close."""

    def __init__(self) -> None:
        self.released = threading.Event()
        self.kept: list[Any] = []

    def get(self, *args: Any, **more: Any) -> None:
        self.kept.append((args, more))

    def close(self) -> None:
        self.released.wait()


def test_a_session_that_is_stuck_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "STUCK_S", SOON_S)
    monkeypatch.setattr(transport, "_CLOSE_S", SOON_S)
    stuck = StuckSession()
    found = Credentials(cluster="c", role="operator", endpoints=(), user="o", password="", token="")

    async def main() -> None:
        link = Link(stuck, found)  # type: ignore[arg-type]
        with pytest.raises(TransportError, match="no answer"):
            await link.ask("evopolicy/v1/c/ops/status", b"", 0.0)
        await asyncio.to_thread(link.close)

    asyncio.run(main())
    stuck.released.set()


def test_a_worker_that_nobody_answers_is_told_the_causes_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "_PATIENCE_S", 0.0)
    found = Credentials(
        cluster="c", role="worker", endpoints=("tcp/127.0.0.1:9",), user="worker", password="p", token="t"
    )

    async def scenario() -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(3.0), transport.connect(found, timeout_s=None):
                pytest.fail("something listens there")

    with capture_logs() as logs:
        monkeypatch.setattr(transport, "log", structlog.get_logger())
        asyncio.run(scenario())
    told = [entry["event"] for entry in logs if "is the coordinator up there" in entry["event"]]
    assert len(told) == 1
