"""Timeouts of the coordinator's shell fire: what it waits for never comes."""

from __future__ import annotations

import asyncio
import signal
import sqlite3
import sys
from pathlib import Path
from typing import Any

import pytest
import test_service
from test_service import Asked, World

from evopolicy_common import keys
from evopolicy_common.errors import ConfigError, StorageError
from evopolicy_common.messages import operator
from evopolicy_coordinator import own_cluster, service, store, upkeep
from evopolicy_coordinator.store import Store

SOON_S = 0.2
STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(1000)"


def test_a_query_that_nobody_waits_for_any_more_is_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "_FORGET_S", SOON_S)

    async def scenario(world: World) -> None:
        created = await world.create()
        wait = operator.WaitRun(token="operate", run=created.run, wait_s=60)
        waiting = Asked(keys.operator_key("c", "wait"), wait)
        world.ask(waiting)
        assert await waiting.message() is None

    test_service.play(tmp_path, scenario)


def test_a_database_that_another_keeps_locked_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "BUSY_TIMEOUT_S", SOON_S)
    monkeypatch.setattr(upkeep, "BUSY_TIMEOUT_S", SOON_S)
    (tmp_path / "blobs").mkdir()
    ours = Store(tmp_path / upkeep.DATABASE)
    other = sqlite3.connect(tmp_path / upkeep.DATABASE, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(StorageError, match="locked"):
        ours.write_claim("suite", "name", b"")
    with pytest.raises(StorageError, match="locked"):
        upkeep.collect(tmp_path, -1.0)
    other.execute("ROLLBACK")
    ours.write_claim("suite", "name", b"")
    other.close()
    ours.close()


def test_a_coordinator_of_ones_own_that_does_not_start_is_told_and_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither does it end when asked to."""
    monkeypatch.setattr(own_cluster, "START_PATIENCE_S", SOON_S)
    monkeypatch.setattr(own_cluster, "END_GRACE_S", SOON_S)
    started: list[asyncio.subprocess.Process] = []

    async def start(program: Any, log: Path) -> asyncio.subprocess.Process:
        child = await asyncio.create_subprocess_exec(
            sys.executable, "-c", STUBBORN, stdout=asyncio.subprocess.PIPE
        )
        assert child.stdout is not None
        await child.stdout.readline()
        started.append(child)
        return child

    async def main() -> None:
        with pytest.raises(ConfigError, match="did not start"):
            async with own_cluster.own_cluster(state=tmp_path):
                pass

    monkeypatch.setattr(own_cluster, "_start", start)
    asyncio.run(main())
    assert started[0].returncode == -signal.SIGKILL
