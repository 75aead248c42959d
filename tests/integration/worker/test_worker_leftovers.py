"""Workers that are killed: what they had started goes with them, and what they had made goes at the next start."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from machines.own_processes import alive

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.processes import proc
from evopolicy_worker import capabilities
from evopolicy_worker.slots.slot import Slot

WORKER = """
import asyncio, sys
from pathlib import Path
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_worker import capabilities
from evopolicy_worker.slots.slot import Slot
from evopolicy_worker.slots.slot import available_tiers

print("begun", flush=True)
tiers = available_tiers()
print("tiers", flush=True)
async def describe(scratch):
    slot = Slot(None, tiers[0], scratch / "slot")
    try:
        await capabilities.describe_all(["gym/acrobot", "gym/bipedal"], slot)
    finally:
        await slot.close()
with scratch_folder("worker") as scratch:
    asyncio.run(describe(scratch))
    print("described", flush=True)
"""
"""The steps of a worker before it waits for its coordinator."""


def start(temporary: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", WORKER],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "TMPDIR": str(temporary)},
    )


async def described(
    env_ids: list[str], scratch: Path
) -> tuple[tuple[EnvironmentDescription, ...], dict[str, str]]:
    slot = Slot(None, "bwrap", scratch / "slot")
    try:
        return await capabilities.describe_all(env_ids, slot)
    finally:
        await slot.close()


def semaphores() -> set[str]:
    return {name for name in os.listdir("/dev/shm") if name.startswith("sem.")}


def test_a_worker_killed_during_its_start_leaves_nothing(tmp_path: Path) -> None:
    before = semaphores()
    seen: set[int] = set()
    for k in range(5):
        worker = start(tmp_path)
        assert worker.stdout is not None
        assert worker.stdout.readline() == b"begun\n"
        end = time.monotonic() + 0.5 * k
        while worker.poll() is None and time.monotonic() < end:
            seen.update(proc.descendants(worker.pid))
            time.sleep(0.005)
        seen.update(proc.descendants(worker.pid))
        worker.kill()
        worker.communicate()
    deadline = time.monotonic() + 30
    while (remaining := [pid for pid in seen if alive(pid)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not remaining
    assert seen
    for folder in tmp_path.iterdir():
        # Its maker may have been killed before it was owned: such a one goes when it is a minute old.
        os.utime(folder, (0, 0))
    worker = start(tmp_path)
    assert b"described" in worker.communicate(timeout=120)[0]
    assert list(tmp_path.glob("evopolicy-tier-*")) == list(tmp_path.glob("evopolicy-worker-*")) == []
    assert semaphores() <= before


@pytest.mark.parametrize("kills", [2, pytest.param(capabilities.TRIES, marks=pytest.mark.system)])
def test_a_describing_process_that_is_killed_is_started_again(
    tmp_path: Path, kills: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capabilities, "PAUSE_S", 0.0)
    describe = Slot.describe
    kills_to_come = kills

    async def killed(self: Slot, env_ids: list[str]) -> object:
        nonlocal kills_to_come
        if kills_to_come:
            kills_to_come -= 1
            assert self._process is not None
            inside = proc.descendants(self._process.pid)
            os.kill(inside[1], signal.SIGKILL)
        return await describe(self, env_ids)

    monkeypatch.setattr(Slot, "describe", killed)
    found, _ = asyncio.run(described(["toy/line", "gym/acrobot"], tmp_path))
    # An environment that ends its process again and again is not offered.
    assert [each.env for each in found] == ["toy/line", "gym/acrobot"][kills == capabilities.TRIES :]
    assert kills_to_come == 0
    kills_to_come = capabilities.TRIES
    found, failed = asyncio.run(described(["toy/line"], tmp_path))
    assert not found
    assert re.search(r"environment toy/line: .* ended with status", failed["toy/line"])


def test_what_cannot_be_described_is_reported_at_once(tmp_path: Path) -> None:
    found, failed = asyncio.run(described(["no/such"], tmp_path))
    assert not found
    assert "no/such" in failed["no/such"]
