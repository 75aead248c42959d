"""The coordinator's process: how it starts, tells that it is ready, refuses, fails and ends."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import resource
import signal
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Awaitable
from pathlib import Path

import msgspec
import pytest
from coordinator_harness import TIMEOUT_S, Coordinator, bundle_of, gateway_of, operator_of, working

from evopolicy_common.errors import RefusedError
from evopolicy_common.wire import credentials
from evopolicy_coordinator.core.contract.records import RunRow


async def refusal(answer: Awaitable[object]) -> RefusedError:
    with pytest.raises(RefusedError) as refused:
        await answer
    return refused.value


def command(*args: object, **env: str) -> subprocess.CompletedProcess[str]:
    """A coordinator that is expected to end by itself."""
    return subprocess.run(
        [sys.executable, "-m", "evopolicy_coordinator.cli", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        env={**os.environ, **env},
    )


def test_ready_file_tells_where_to_connect_and_goes_with_the_process(coordinator: Coordinator) -> None:
    ready = coordinator.ready
    assert ready["cluster"] == "local"
    assert ready["endpoints"] == [f"unixsock-stream/{coordinator.state}/coordinator.sock"]
    assert set(ready["credentials"]) == {"worker", "gateway", "operator"}
    assert re.search(r"workers join with: (\S*/)?evopolicy-worker ", coordinator.log.read_text())
    assert coordinator.stop() == 0
    assert not coordinator.ready_file.exists()


async def test_a_state_that_no_core_loads_ends_the_process(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator:
        created = await operator.create()
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("policy"), (0, 1), "k")
    assert coordinator.stop() == 0
    with contextlib.closing(sqlite3.connect(coordinator.state / "coordinator.sqlite")) as database:
        ((data,),) = database.execute("SELECT data FROM runs")
        row = msgspec.structs.replace(msgspec.msgpack.decode(data, type=RunRow), budget=1)
        database.execute("UPDATE runs SET data = ?", (msgspec.msgpack.encode(row),))
        database.commit()
    ended = command("--state", coordinator.state)
    assert ended.returncode == 1
    assert "error: loading the state failed: InvariantError: cannot reserve 2" in ended.stderr


def test_everything_in_the_state_folder_is_private(coordinator: Coordinator) -> None:
    assert stat.S_IMODE(coordinator.state.stat().st_mode) == 0o700
    for path in coordinator.state.rglob("*"):
        if path.suffix in (".json", ".sqlite") or path.name in ("secret", "passwords", "lock"):
            assert stat.S_IMODE(path.stat().st_mode) == 0o600, path


def test_commands_of_the_same_user_find_the_cluster_by_its_endpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coordinator = Coordinator(tmp_path / "state", "--listen", "tcp/127.0.0.1:0")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    try:
        endpoint = coordinator.ready["endpoints"][1]
        found = credentials.find("operator", (endpoint,))
        assert found == msgspec.structs.replace(coordinator.credentials("operator"), endpoints=(endpoint,))
    finally:
        coordinator.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_signal_ends_it_in_good_order_also_while_others_wait_for_it(
    tmp_path: Path, number: int
) -> None:
    coordinator = Coordinator(tmp_path / "state")

    try:
        async with operator_of(coordinator) as operator, working(coordinator):
            created = await operator.create()
            waiting = asyncio.create_task(operator.progress(created.run, 30))
            await asyncio.sleep(0.1)
            coordinator.process.send_signal(number)
            assert await asyncio.to_thread(coordinator.process.wait, 15) == 0
            waiting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await waiting
    finally:
        coordinator.kill()
    assert "everything is on disk" in coordinator.log.read_text()
    assert not list(coordinator.state.glob("*-wal"))


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--listen", "7447"), "tcp/HOST:PORT"),
        (("--data", "no/such/folder"), "--data no/such/folder is not a folder"),
        (("--log-level", "loud"), "'--log-level': 'loud' is not one of"),
        (("--no-such-option",), "--no-such-option"),
    ],
)
def test_wrong_option_is_reported_in_a_line_and_exits_2(
    tmp_path: Path, args: tuple[str, ...], message: str
) -> None:
    ended = command("--state", tmp_path / "state", *args)
    assert ended.returncode == 2
    assert message in ended.stderr.splitlines()[-1]


def test_damaged_database_is_reported_and_not_overwritten(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    damaged = b"not a database at all, really" * 100
    (state / "coordinator.sqlite").write_bytes(damaged)
    ended = command("--state", state)
    assert ended.returncode == 2  # So that no unit starts it again and again.
    assert "restore it from a backup" in ended.stderr.splitlines()[-1]
    assert (state / "coordinator.sqlite").read_bytes() == damaged


async def test_splits_come_from_the_data_folder_where_one_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "data" / "toy_line"
    folder.mkdir(parents=True)
    for stem, seeds in (("train", [1, 2]), ("valid", [3]), ("heldout", [4, 5])):
        cases = [{"seed": seed} for seed in seeds]
        (folder / f"{stem}.json").write_text(json.dumps({"env": "toy/line", "split": stem, "cases": cases}))
    coordinator = Coordinator(tmp_path / "state", "--data", str(tmp_path / "data"))

    try:
        async with operator_of(coordinator) as operator, working(coordinator) as worker:
            created = await operator.create()
            async with gateway_of(coordinator, created) as gateway:
                assert (await gateway.open()).n_env_instances == 2
                await gateway.submit(bundle_of("# policy"), (1,), "key")
                await gateway.results(0)
                await gateway.close()
            finished = await operator.finished(created.run)
            assert not finished.cases_secret
            assert len(finished.heldout_returns) == 2
            assert {spec.case.seed for job in worker.jobs for spec in job.episodes} == {2, 3, 4, 5}
            for settings in ({"env": "toy/maze"}, {"n_heldout": 3}, {"env": "no/such"}, {"budget": 0}):
                with pytest.raises(RefusedError) as refused:
                    await operator.create(f"wrong {settings}", **settings)
                assert refused.value.status == "invalid_settings"
    finally:
        coordinator.kill()


async def test_a_full_disk_refuses_new_work_and_loses_nothing(coordinator: Coordinator) -> None:
    """The disk is made full for the running process by a limit on the size of its files."""

    pid = coordinator.process.pid
    unlimited = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    async with operator_of(coordinator) as operator, working(coordinator) as worker:
        created = await operator.create(budget=64)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("# one"), tuple(range(8)), "before")
            await gateway.results(0)
            worker.hold.clear()
            second = bundle_of("# two")
            await gateway.submit(second, tuple(range(8)), "held")
            wal = coordinator.state / "coordinator.sqlite-wal"
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (wal.stat().st_size, unlimited[1]))
            worker.hold.set()
            # "busy" until the results that are reported meet the full disk.
            while (
                refused := await refusal(gateway.submit_digest(second.digest, (0,), "during"))
            ).status == "busy":
                await asyncio.sleep(0.02)
            assert refused.status == "unavailable"
            assert "cannot write its store" in refused.message
            status = await operator.status()
            assert "accepts no changes until it can: " in status.trouble
            assert [run.run for run in status.runs] == [created.run]
            resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
            episodes, done = await gateway.results(1)
            assert (len(episodes), done.status) == (8, "ok")
            while (await gateway.state()).n_submits < 3:
                with contextlib.suppress(RefusedError):
                    await gateway.submit_digest(second.digest, (0,), "during")
            assert (await gateway.state()).remaining_budget == 64 - 17
    assert "the store cannot write" in coordinator.log.read_text()
    assert coordinator.stop() == 0


async def test_coordinator_hears_at_once_of_a_worker_that_is_gone(tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "state", "--log-level", "debug")

    async def seen(text: str) -> None:
        while text not in coordinator.log.read_text():
            await asyncio.sleep(0.02)

    try:
        async with working(coordinator, "w-1") as worker:
            worker.declare_alive()
            await seen('"worker": "w-1", "alive": true')
        await seen('"worker": "w-1", "alive": false')
    finally:
        coordinator.kill()
