"""No agent is started or told of before its permit, and no run is closed before its agent is gone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from gateway_double import Double, gateway_on, opened, prepared, served
from rigs.finished_run import mark_opened

from evopolicy_common.messages.gateway import CloseRun, OpenRun, RequestPermit
from evopolicy_common.messages.run_settings import ELSEWHERE, RunSettings
from evopolicy_common.messages.worker import Message
from evopolicy_common.processes import proc
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.run.gateway import Gateway
from evopolicy_gateway.run_folder import listener
from evopolicy_gateway.run_folder.layout import RunFolder, save
from evopolicy_gateway.run_folder.listener import AgentPlace, Listener
from evopolicy_gateway.submits import coordinator_client

Asked = TypeVar("Asked", bound=Message)
KERNEL = "0f2e9a7c-11d0-4b35-8d2f-5a3c9e7b1d60"


def asked(double: Double, kind: type[Asked]) -> list[Asked]:
    return [message for message in double.asked if isinstance(message, kind)]


def quiet(folder: RunFolder) -> tuple[Gateway, list[object]]:
    """A gateway, and what it has said: URLs once it serves, texts of what it waits for."""
    events: list[object] = []
    gateway = Gateway(
        folder,
        on_ready=lambda urls, pipeline: events.append(urls),
        on_change=lambda pipeline: None,
        on_wait=events.append,
    )
    return gateway, events


async def until(what: Callable[[], object]) -> None:
    async with asyncio.timeout(60.0):
        while not what():
            await asyncio.sleep(0.01)


def remote(folder: RunFolder, agent_host: str) -> None:
    save(folder.listener, Listener(host="127.0.0.1", port=0))
    settings = RunSettings(env="toy/line", entry="e", model="m", exp_id="x", agent_host=agent_host)
    mark_opened(folder, folder.run, settings)


async def test_nothing_is_served_before_the_permit_and_the_operator_hears_why(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        await double.score_another_run(proc.boot_id())
        gateway, events = quiet(folder)
        task = asyncio.create_task(gateway.run())
        await until(lambda: events)
        assert set(events) == {"hidden cases of another run to be scored"}
        assert not folder.workspace.exists()
        double.scoring.clear()
        await until(lambda: len(events) > 1 and events[-2] == "")
        assert gateway.permit_s > 0.0
        gateway.tell(None)
        assert not await task
    assert asked(double, OpenRun)[0].asks_permit
    first = asked(double, RequestPermit)[0]
    assert (first.run, first.boot_id) == (double.run_id, proc.boot_id())


async def test_gateway_that_is_started_again_asks_again(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        for _ in range(2):
            async with gateway_on(folder, double):
                pass
    assert len(asked(double, RequestPermit)) >= 2
    assert double.closed is None


async def test_a_permit_ended_by_mistake_is_renewed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coordinator_client, "RENEWAL_S", 1.0)

    async with prepared(tmp_path) as (folder, double):
        async with gateway_on(folder, double):
            await double.agent_gone()
            assert not double.has_permit()
            await until(double.has_permit)
        assert double.closed is None


async def test_run_that_is_cancelled_while_it_waits_is_over(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        await double.score_another_run(proc.boot_id())
        gateway, events = quiet(folder)
        task = asyncio.create_task(gateway.run())
        await until(lambda: events)
        await double.cancel()
        assert await task
    assert events[-1] == ""


async def test_an_ended_agents_gateway_closes_the_run_without_a_permit(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        await double.score_another_run(proc.boot_id())
        gateway, _ = quiet(folder)
        gateway.tell(child_messages.CloseGateway(reason="agent_stopped"))
        assert await gateway.run()
    assert double.closed is not None


@pytest.mark.parametrize(("agent_host", "asks_for"), [("", ""), (KERNEL, KERNEL), (ELSEWHERE, "")])
def test_a_remote_agents_permit_names_its_kernel(tmp_path: Path, agent_host: str, asks_for: str) -> None:
    folder = RunFolder(tmp_path)
    folder.state.mkdir()
    remote(folder, agent_host)
    assert listener.agent_place(folder) == AgentPlace(boot_id=asks_for)
    assert listener.ends_unseen(folder) == (agent_host != ELSEWHERE)


async def test_a_remote_agents_run_closes_on_its_operators_word(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        remote(folder, KERNEL)
        async with gateway_on(folder, double) as service:
            service.gateway.tell(child_messages.CloseGateway(reason="budget_spent"))
            await until(lambda: len(service.waits) > 1)
            assert "evopolicy finish" in service.waits[1]
            assert double.closed is None
            assert service.pipeline.machine.closed
            listener.finish(folder)
            assert await service.task
    assert [message.reason for message in asked(double, CloseRun)] == ["budget_spent"]


async def test_run_whose_operator_vouches_for_its_agent_is_closed_at_once(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        remote(folder, ELSEWHERE)
        async with gateway_on(folder, double) as service:
            assert await service.close()
    assert double.closed is not None


async def test_a_gateway_stopped_before_its_agents_end_leaves_the_run_open(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        remote(folder, "")
        async with gateway_on(folder, double) as service:
            service.gateway.tell(child_messages.CloseGateway(reason="wall_limit"))
            await until(lambda: len(service.waits) > 1)
            service.gateway.tell(None)
            assert not await service.task
    assert double.closed is None


async def test_time_held_by_hidden_episodes_counts_against_no_limit(tmp_path: Path) -> None:
    double = Double(opened())
    double.held_s = 5.0
    double.go.clear()
    async with served(tmp_path, double) as service:
        assert service.pipeline.machine.held_s == 5.0
        await service.submit([1], wait=False)
        double.held_s = 7.5
        await until(lambda: service.pipeline.machine.held_s == 7.5)
        running = (await service.info())["submit_in_flight"]
        assert running["waits_for"] == "a free slot"
        assert running["held_s"] >= 2.5
        double.go.set()
        await service.pipeline.idle()
        assert service.pipeline.machine.tickets[0].held_s == 2.5
