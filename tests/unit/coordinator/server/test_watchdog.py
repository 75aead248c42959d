"""The loop's watchdog: tells a gap, names where the loop stands, says nothing of a loop that runs."""

from __future__ import annotations

import asyncio
import time

import pytest
import structlog
from structlog.testing import capture_logs

from evopolicy_coordinator.server import watchdog


def test_gap_is_reported_and_its_place_named(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario() -> None:
        watching = watchdog.LoopWatchdog(gap_s=0.1)
        await asyncio.sleep(0.3)
        time.sleep(1.2)
        await asyncio.sleep(0.3)
        watching.close()

    with capture_logs() as logs:
        monkeypatch.setattr(watchdog, "log", structlog.get_logger())
        asyncio.run(scenario())
    gaps = [entry["gap_s"] for entry in logs if entry["event"] == "the event loop was blocked"]
    assert any(gap >= 0.9 for gap in gaps)
    stacks = [entry["stack"] for entry in logs if entry["event"] == "the event loop is blocked"]
    assert any("time.sleep(1.2)" in stack for stack in stacks)


def test_loop_that_runs_is_not_spoken_of(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario() -> None:
        watching = watchdog.LoopWatchdog(gap_s=30.0)
        await asyncio.sleep(0.6)
        watching.close()

    with capture_logs() as logs:
        monkeypatch.setattr(watchdog, "log", structlog.get_logger())
        asyncio.run(scenario())
    assert not logs


def test_a_place_that_cannot_be_named_does_not_end_the_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> list[str]:
        raise RuntimeError("the frame has changed")

    async def scenario() -> bool:
        watching = watchdog.LoopWatchdog(gap_s=0.1)
        await asyncio.sleep(0.3)
        time.sleep(1.2)
        alive = watching._thread.is_alive()
        watching.close()
        return alive

    monkeypatch.setattr("traceback.format_stack", broken)
    with capture_logs() as logs:
        monkeypatch.setattr(watchdog, "log", structlog.get_logger())
        assert asyncio.run(scenario())
    assert {"event": "the event loop is blocked", "log_level": "warning", "stack": ""} in logs
