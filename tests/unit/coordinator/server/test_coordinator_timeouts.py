"""Timeouts of the coordinator's shell fire: what it waits for never comes."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from rigs.service_world import started

from evopolicy_common.errors import StorageError
from evopolicy_coordinator.server import service
from evopolicy_coordinator.storage import disk_use, store
from evopolicy_coordinator.storage.store import Store

SOON_S = 0.2


async def test_a_query_that_nobody_waits_for_any_more_is_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "_SWEEP_S", SOON_S / 4)

    async with started(tmp_path) as world:
        created = await world.create()
        monkeypatch.setattr(service, "_FORGET_S", SOON_S)
        assert await world.answer(world.waiting(created.run, 60)) is None


def test_a_database_that_another_keeps_locked_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "BUSY_TIMEOUT_S", SOON_S)
    monkeypatch.setattr(disk_use, "BUSY_TIMEOUT_S", SOON_S)
    (tmp_path / "blobs").mkdir()
    ours = Store(tmp_path / "coordinator.sqlite")
    other = sqlite3.connect(tmp_path / "coordinator.sqlite", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(StorageError, match="locked"):
        ours.write_claim("suite", "name", b"")
    with pytest.raises(StorageError, match="locked"):
        disk_use.collect(tmp_path, -1.0)
    other.execute("ROLLBACK")
    ours.write_claim("suite", "name", b"")
    other.close()
    ours.close()
