"""An agent is gone when nothing of it lives, and not before: a real agent supervisor with processes that cannot be
killed."""

from __future__ import annotations

import asyncio
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from machines.cgroups import freezer
from rigs.finished_run import mark_opened
from stages.supervisor_process import TIMEOUT_S, SupervisorProcess

from evopolicy_gateway.processes.child_messages import (
    AgentEnded,
    AgentSurvives,
    StopAgent,
    SubmitsSeen,
)
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run_folder import locks
from evopolicy_gateway.run_folder.layout import RunFolder, save
from evopolicy_gateway.run_folder.listener import Listener


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[SupervisorProcess]:
    started = SupervisorProcess(tmp_path)
    yield started
    started.process.kill()
    started.process.communicate()


def test_a_surviving_agent_is_reported_until_it_is_gone(supervisor: SupervisorProcess) -> None:
    with freezer() as held:
        agent = supervisor.agent()
        held.freeze(agent)
        supervisor.tell(StopAgent())
        event = supervisor.until(AgentSurvives)
        assert agent in event.pids
        assert supervisor.holds_its_lock()
        held.thaw()
        ended = supervisor.until(AgentEnded)
        assert ended.reason == "told"
    assert supervisor.process.wait(TIMEOUT_S) == 0
    assert not supervisor.holds_its_lock()


def test_a_supervisor_waits_for_an_earlier_ones_agent(supervisor: SupervisorProcess, tmp_path: Path) -> None:
    first = supervisor.agent()
    second = SupervisorProcess(tmp_path)
    try:
        time.sleep(0.5)
        assert os.listdir(supervisor.folder) == [str(first)]
        supervisor.tell(StopAgent())
        supervisor.until(AgentEnded)
        os.unlink(supervisor.folder / str(first))
        assert second.agent() != first
    finally:
        second.tell(StopAgent())
        second.until(AgentEnded)
        second.process.communicate()


def test_an_agents_file_that_is_gone_by_its_start_is_named(tmp_path: Path) -> None:
    supervisor = SupervisorProcess(tmp_path, agent="file:gone.toml")
    ended = supervisor.until(AgentEnded)
    supervisor.process.communicate()
    assert (ended.reason, "gone.toml" in ended.detail) == ("agent_failed", True)


def test_time_that_submits_were_held_is_given_back(tmp_path: Path) -> None:
    supervisor = SupervisorProcess(tmp_path, wall_limit_s=3.0)
    started = time.monotonic()
    supervisor.agent()
    supervisor.tell(SubmitsSeen(asked=0, running=False, held_s=4.0))
    ended = supervisor.until(AgentEnded)
    assert ended.reason == "wall_limit"
    assert time.monotonic() - started >= 7.0
    supervisor.process.communicate()


class Cluster(Operations):
    """Records the requests that it gets."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    async def cancel(self, run: str) -> None:
        self.asked.append(f"cancel {run}")

    async def agent_gone(self, run: str, boot_id: str = "") -> None:
        self.asked.append(f"gone {run}")


async def test_a_killed_commands_run_waits_for_its_agent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(locks, "_PAUSE_S", 0.01)
    folder = RunFolder(tmp_path / "run")
    folder.state.mkdir(parents=True)
    cluster = Cluster()

    await cluster.drop(folder)
    assert cluster.asked == []
    mark_opened(folder)
    with folder.supervisor_lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        dropping = asyncio.create_task(cluster.drop(folder))
        await asyncio.sleep(0.1)
        assert cluster.asked == []
    await asyncio.wait_for(dropping, TIMEOUT_S)
    assert cluster.asked == ["cancel r-1", "gone r-1"]
    # Of a remote agent nobody here knows whether it has ended.
    save(folder.listener, Listener(host="127.0.0.1", port=0))
    await cluster.drop(folder)
    assert cluster.asked[2:] == ["cancel r-1"]
