"""Killed at any instant and started again on the same folder, a coordinator goes on where it was."""

from __future__ import annotations

import asyncio
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from coordinator_harness import (
    Coordinator,
    InstantWorker,
    bundle_of,
    comparable,
    gateway_of,
    operator_of,
    run,
    working,
)

from evopolicy_common.messages.operator import RunCreated, RunFinished
from evopolicy_common.wire.transport import connect

SUBMITS = (((0, 1, 1, 5), "# one"), ((2, 3), "# two"), ((7, 7, 7, 7, 8, 9), "# three"))


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[list[Coordinator]]:
    """The coordinator that runs now."""
    holder = [Coordinator(tmp_path / "state")]
    yield holder
    holder[0].kill()


async def whole_run(coordinator: Coordinator) -> RunFinished:
    """A run of three submits."""
    async with operator_of(coordinator) as operator:
        created = await operator.create()
        async with gateway_of(coordinator, created) as gateway:
            for number, (ids, source) in enumerate(SUBMITS):
                await gateway.submit(bundle_of(source), ids, f"submit-{number}")
                episodes, done = await gateway.results(number)
                assert sorted(episode.index for episode in episodes) == list(range(len(ids)))
                assert len({episode.index for episode in episodes}) == done.n_kept == len(ids)
            await gateway.close()
        return await operator.finished(created.run)


def test_coordinator_killed_through_a_whole_run_ends_with_the_same_outcome(tmp_path: Path) -> None:
    """Killed by a clock of its own that knows nothing of what the run is at."""
    outcomes = []
    for name, kills in (("calm", 0), ("stormy", 4)):
        state = tmp_path / name
        state.mkdir(mode=0o700)
        if name == "stormy":
            (state / "secret").write_bytes((tmp_path / "calm" / "secret").read_bytes())
            (state / "secret").chmod(0o600)
        holder = [Coordinator(state)]

        async def scenario(
            holder: list[Coordinator] = holder, state: Path = state, kills: int = kills
        ) -> None:
            dice = random.Random(7)
            ended = asyncio.Event()

            async def storm() -> None:
                for _ in range(kills):
                    await asyncio.sleep(dice.uniform(0.05, 0.6))
                    if ended.is_set():
                        return
                    await asyncio.to_thread(holder[0].kill)
                    holder[0] = await asyncio.to_thread(Coordinator, state)

            storming = asyncio.create_task(storm())
            pause_s = 0.03 if kills else 0.0
            async with working(holder[0], "w-1", pause_s=pause_s), working(holder[0], "w-2", pause_s=pause_s):
                outcomes.append(comparable(await whole_run(holder[0])))
            ended.set()
            await storming
            if kills:
                assert '"incarnation": 4' in holder[0].log.read_text(), (
                    "the run was over before it was disturbed"
                )

        try:
            run(scenario, 120)
        finally:
            holder[0].kill()
    assert outcomes[0]["budget_used"] == 12
    assert outcomes[1] == outcomes[0]


@pytest.mark.slow
def test_a_run_goes_on_from_a_backup_on_another_machine(tmp_path: Path) -> None:
    """Another path, socket, worker and kernels; the first machine is gone with its worker's leases and its agent's
    permit."""
    state, backup, moved = tmp_path / "state", tmp_path / "backup", tmp_path / "elsewhere" / "state"
    first = Coordinator(state)

    async def begun() -> RunCreated:
        async with (
            operator_of(first) as operator,
            gateway_of(first, created := await operator.create()) as gateway,
        ):
            async with working(first, "w-1"):
                await gateway.submit(bundle_of(SUBMITS[0][1]), SUBMITS[0][0], "submit-0")
                await gateway.results(0)
            async with connect(first.credentials("worker")) as link:
                lost = InstantWorker(link, "w-2")
                await lost.register()
                await gateway.submit(bundle_of(SUBMITS[1][1]), SUBMITS[1][0], "submit-1")
                # A poll that the first worker left behind may be answered with them first; they come back from it.
                while not await lost.lease(1, 10.0):
                    pass
                words = f"-m evopolicy_coordinator.cli backup {backup} --state {state}".split()
                program = [sys.executable, *words]
                await asyncio.to_thread(subprocess.run, program, check=True)
            return created

    async def went_on(second: Coordinator, created: RunCreated) -> dict[str, Any]:
        async with operator_of(second) as operator, working(second, "w-9"):
            assert await operator.create() == created
            async with gateway_of(second, created, "agents elsewhere") as gateway:
                await gateway.results(1)
                await gateway.submit(bundle_of(SUBMITS[2][1]), SUBMITS[2][0], "submit-2")
                await gateway.results(2)
                await gateway.close()
            return comparable(await operator.finished(created.run))

    async def calm(third: Coordinator) -> dict[str, Any]:
        async with working(third):
            return comparable(await whole_run(third))

    try:
        created = asyncio.run(asyncio.wait_for(begun(), 60))
    finally:
        first.kill()
    moved.parent.mkdir()
    shutil.copytree(backup, moved)
    shutil.rmtree(state)
    second = Coordinator(moved)
    try:
        outcome = asyncio.run(asyncio.wait_for(went_on(second, created), 90))
    finally:
        second.kill()
    undisturbed = tmp_path / "undisturbed"
    undisturbed.mkdir(mode=0o700)
    shutil.copy2(moved / "secret", undisturbed / "secret")
    third = Coordinator(undisturbed)
    try:
        assert asyncio.run(asyncio.wait_for(calm(third), 60)) == outcome
    finally:
        third.kill()


def test_workers_find_the_same_coordinator_after_an_orderly_restart(tmp_path: Path) -> None:
    holder = [Coordinator(tmp_path / "state", "--listen", "tcp/127.0.0.1:0")]
    endpoint = holder[0].ready["endpoints"][-1]
    assert endpoint.startswith("tcp/127.0.0.1:")

    async def scenario() -> None:
        async with operator_of(holder[0]) as operator, working(holder[0]) as worker:
            created = await operator.create()
            async with gateway_of(holder[0], created) as gateway:
                worker.hold.clear()
                await gateway.submit(bundle_of("# policy"), (0, 1), "key")
                while not worker.jobs:
                    await asyncio.sleep(0.01)
                assert await asyncio.to_thread(holder[0].stop) == 0
                holder[0] = await asyncio.to_thread(Coordinator, tmp_path / "state", "--listen", endpoint)
                worker.hold.set()
                _, done = await gateway.results(0)
                assert done.status == "ok"

    try:
        run(scenario, 120)
    finally:
        holder[0].kill()


def test_a_request_under_way_is_answered_by_the_next_coordinator(
    tmp_path: Path, holder: list[Coordinator]
) -> None:
    async def scenario() -> None:
        async with operator_of(holder[0]) as operator:
            created = await operator.create()
            async with gateway_of(holder[0], created) as gateway:
                await asyncio.to_thread(holder[0].kill)
                closing = asyncio.create_task(gateway.close())
                waiting = asyncio.create_task(operator.finished(created.run))
                await asyncio.sleep(0.1)
                holder[0] = await asyncio.to_thread(Coordinator, tmp_path / "state")
                await closing
                async with working(holder[0]):
                    assert (await waiting).status == "no_ok_submit"

    run(scenario, 120)
