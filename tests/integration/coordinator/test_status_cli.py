"""`evopolicy status`, `workers` and `runs` against a real coordinator."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator

import msgspec
import pytest
from coordinator_harness import (
    FINGERPRINT,
    Coordinator,
    OperatorClient,
    bundle_of,
    gateway_of,
    operator_of,
    working,
)
from typer.testing import CliRunner, Result

from evopolicy_common.messages.status import WorkerStatus
from evopolicy_coordinator.cli.status import runs_app, status_app, workers_app

APPS = {"status": status_app, "workers": workers_app, "runs": runs_app}


@pytest.fixture(scope="module")
def coordinator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Coordinator]:
    coordinator = Coordinator(tmp_path_factory.mktemp("status") / "state")
    yield coordinator
    coordinator.kill()


def call(coordinator: Coordinator, name: str, *args: str) -> Result:
    file = coordinator.ready["credentials"]["operator"]
    return CliRunner().invoke(APPS[name], [*args, "--credentials", file])


async def called(coordinator: Coordinator, name: str, *args: str) -> Result:
    """`call` beside a loop that clients live on."""
    return await asyncio.to_thread(call, coordinator, name, *args)


async def test_status_shows_workers_runs_and_what_waits(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator:
        created = await operator.create("status")
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("# policy"), (0, 1), "key")
            text = (await called(coordinator, "status")).stdout
            assert f"{created.run} waits for" in text
            async with working(coordinator, "w-shown"):
                await gateway.results(0)
                result = await called(coordinator, "status")
                assert "0 queued, 0 running" in result.stdout
                assert result.exit_code == 0
                for text in ("cluster local", "w-shown", created.run, "toy/line", "14/16"):
                    assert text in result.stdout
                reply = json.loads((await called(coordinator, "status", "--json")).stdout)
                assert reply["cluster"] == "local"
                (shown,) = [one for one in reply["workers"] if one["worker"] == "w-shown"]
                assert shown["versions"]["evopolicy-worker"] == FINGERPRINT.code_version
                for name, version in shown["versions"].items():
                    assert f"{name} {version}" in " ".join(result.stdout.split())
                assert created.run in [run["run"] for run in reply["runs"]]


@pytest.mark.parametrize(("command", "state"), [("drain", "draining"), ("pause", "paused")])
async def test_worker_out_of_service_gets_no_work_until_it_is_taken_back(
    coordinator: Coordinator, command: str, state: str
) -> None:
    name = f"w-{state}"

    async with operator_of(coordinator) as operator, working(coordinator, name) as worker:
        await worker_shown(operator, name)
        assert (await called(coordinator, "workers", command, name)).exit_code == 0
        created = await operator.create(command)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("# policy"), (0,), "key")
            await asyncio.sleep(0.3)
            assert not [job for job in worker.jobs if created.run in job.job_id]
            assert (await worker_shown(operator, name)).state == state
            assert (await called(coordinator, "workers", "resume", name)).exit_code == 0
            await gateway.results(0)
            assert [job for job in worker.jobs if created.run in job.job_id]


async def test_a_pause_of_an_absent_worker_holds_when_it_connects(
    coordinator: Coordinator,
) -> None:
    async with operator_of(coordinator) as operator:
        async with working(coordinator, "w-there"):
            await worker_shown(operator, "w-there")
            told = (await called(coordinator, "workers", "pause", "w-later")).stdout
            assert told.startswith("w-later is not connected; it is paused when it connects. Connected: ")
            assert "w-there" in told
        async with working(coordinator, "w-later"):
            assert (await worker_shown(operator, "w-later")).state == "paused"


async def test_cancelled_run_is_finished_without_a_score(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator:
        created = await operator.create("cancel")
        assert (await called(coordinator, "runs", "cancel", created.run)).stdout.endswith("is cancelled\n")
        again = await called(coordinator, "runs", "cancel", created.run)
        assert "had ended before" in again.stdout
        finished = await operator.finished(created.run)
        assert finished.status == "cancelled"
        assert finished.final_score is None


async def test_a_run_continues_on_another_class_after_an_operators_repin(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator:
        created = await operator.create("repin", n_validation=1, n_heldout=1)
        async with gateway_of(coordinator, created) as gateway:
            async with working(coordinator, "w-old"):
                await gateway.submit(bundle_of("# policy"), (0,), "first")
                await gateway.results(0)
            newer = msgspec.structs.replace(FINGERPRINT, code_version="2")
            async with working(coordinator, "w-new", fingerprint=newer) as worker:
                await gateway.submit(bundle_of("# policy"), (0,), "second")
                while not (shown := await worker_shown(operator, "w-new")).refused:
                    await asyncio.sleep(0.02)
                assert "pinned" in shown.refused[created.run]
                assert worker.jobs == []
                repin = ("repin", created.run, shown.fingerprint, "--reason")
                assert (await called(coordinator, "runs", *repin, " ")).exit_code == 2
                assert (await called(coordinator, "runs", *repin, "old ones gone")).exit_code == 0
                _, done = await gateway.results(1)
                assert done.status == "ok"


async def worker_shown(operator: OperatorClient, name: str) -> WorkerStatus:
    while True:
        for worker in (await operator.status()).workers:
            if worker.worker == name:
                return worker
        await asyncio.sleep(0.02)
