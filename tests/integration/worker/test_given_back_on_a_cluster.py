"""An agent times its submits so that its hidden validation is stopped again and again: its policy's dice are thrown once.

A real coordinator, a real supervisor and its real slot; the agent is on another machine, so that its submits may be played.
The environment is the test's own: a hidden episode of it goes on until the test writes a file, however slow the machine is.
"""

from __future__ import annotations

import asyncio
import json
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from coordinator_harness import FINGERPRINT, Coordinator, bundle_of, gateway_of, operator_of
from waiting import TIMEOUT_S

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import Job
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.episodes.trajectory import decode
from evopolicy_common.wire.transport import connect
from evopolicy_coordinator.core.records import BegunRow, OutcomeRow, validation_group
from evopolicy_worker.episodes import begun
from evopolicy_worker.slots.slot import Slot
from evopolicy_worker.supervisor import Options, Supervisor

CLOCKED = """
import time

class Policy:
    def __init__(self, *spaces):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        time.sleep(0.02)
        return [(time.time_ns() // 1000 % 1_000_000) / 1e6]
"""
HELD = """
import os
import gymnasium
import numpy as np
from gymnasium import spaces

class Held(gymnasium.Env):
    observation_space = spaces.Discrete(2)
    action_space = spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5 if seed == {train} else None
        return 0, {{}}

    def step(self, action):
        if self.left is not None:
            self.left -= 1
        over = os.path.exists({end!r}) if self.left is None else not self.left
        return 0, 0.0, over, False, {{}}
"""
CASES = {"train": 11, "valid": 1_000_003, "heldout": 1_000_033}
"""The seed of each split's only case."""
ENTRY = Entry(id="acme/held", gymnasium_id="held_env:Held-v0", max_episode_steps=1_000_000)
N_STOPS = 2


def place(folder: Path) -> None:
    """The environment's package, and its cases."""
    package, cases = folder / "package", folder / "data" / "acme_held"
    package.mkdir()
    cases.mkdir(parents=True)
    source = HELD.format(train=CASES["train"], end=str(package / "end"))
    register = f"\ngymnasium.register({ENTRY.gymnasium_id.partition(':')[2]!r}, Held)\n"
    (package / "held_env.py").write_text(source + register)
    for split, seed in CASES.items():
        document = {"env": ENTRY.id, "split": split, "cases": [{"seed": seed}], "secret": True}
        (cases / f"{split}.json").write_text(json.dumps(document))


def actions_of(recording: bytes) -> list[float]:
    return [float(row.action[0]) for row in decode(recording).rows()]


def slot_of(scratch: Path) -> Slot:
    return Slot(None, "bwrap", scratch, definitions=(ENTRY,))


async def described(folder: Path) -> EnvironmentDescription:
    slot = slot_of(folder / "described")
    await slot.start()
    try:
        (found,) = await slot.describe((ENTRY.id,))
    finally:
        await slot.close()
    return found


class Stored:
    """What the coordinator has on its disk."""

    def __init__(self, state: Path, group: str) -> None:
        self._path = state / "coordinator.sqlite"
        self._blobs = BlobStore(state / "blobs")
        self._group = group

    def _rows(self, table: str) -> list[bytes]:
        with sqlite3.connect(f"file:{self._path}?mode=ro", uri=True) as db:
            return [data for (data,) in db.execute(f"SELECT data FROM {table} WHERE grp = ?", (self._group,))]

    def begun(self) -> list[float]:
        """The actions that the next attempt goes on from."""
        for data in self._rows("begun"):
            ref = msgspec.msgpack.decode(data, type=BegunRow).begun
            if ref is not None:
                job = Job(job_id="", env="", bundle="b", episodes=(), record="actions", begun=ref)
                inline = ref.inline or self._blobs.read(ref.digest)
                job = msgspec.structs.replace(job, begun=msgspec.structs.replace(ref, inline=inline))
                return [float(each.action[0]) for each in begun.unpack(job)[0].unpacked().taken]
        return []

    def played(self) -> list[float]:
        """The actions of the episode that counts."""
        for data in self._rows("outcomes"):
            recording = msgspec.msgpack.decode(data, type=OutcomeRow).outcome.trajectory
            assert recording is not None
            return actions_of(recording.inline or self._blobs.read(recording.digest))
        return []


@pytest.mark.parametrize("restart", [False, True])
def test_an_agent_that_stops_its_validation_again_and_again_gets_one_throw(
    tmp_path: Path, restart: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    thrown: list[list[float]] = []
    place(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "package"), prepend=os.pathsep)
    options = Options(
        name="w-1",
        slots=1,
        tiers=("bwrap",),
        environments=(asyncio.run(described(tmp_path)),),
        fingerprint=FINGERPRINT,
        host="test",
        boot_id="kernel-of-w-1",
        scratch=tmp_path / "w-1",
    )

    def coordinator_of() -> Coordinator:
        return Coordinator(tmp_path / "state", "--data", str(tmp_path / "data"))

    coordinators = [coordinator_of()]

    async def wait_for(look: Callable[[], bool]) -> None:
        async with asyncio.timeout(TIMEOUT_S):
            while not look():
                await asyncio.sleep(0.02)

    async def scenario() -> None:
        coordinator = coordinators[0]
        async with connect(coordinator.credentials("worker")) as link, operator_of(coordinator) as operator:
            worker = Supervisor(link, options, lambda index, tier: slot_of(tmp_path / f"slot-{index}"))
            working = asyncio.create_task(worker.run())
            created = await operator.create(env=ENTRY.id, n_validation=1, n_heldout=1)
            group = validation_group(created.run, 0)
            stored = Stored(coordinator.state, group)

            def is_played_further() -> bool:
                held, _ = worker._held.snapshot()
                return any(
                    each.job_id == f"{group}/0" and each.steps > 2 + len(stored.begun()) for each in held
                )

            async with gateway_of(coordinator, created) as gateway:
                await gateway.submit(bundle_of(CLOCKED), (0,), "first")
                await gateway.results(0)
                for number in range(N_STOPS):
                    await wait_for(is_played_further)
                    await gateway.submit(bundle_of(CLOCKED), (0,), f"again-{number}")
                    await wait_for(lambda: len(stored.begun()) > sum(map(len, thrown[-1:])))
                    thrown.append(stored.begun())
                    if restart and number == 0:
                        coordinator.kill()
                        coordinators.append(coordinator_of())
                    await gateway.results(number + 1)
                await wait_for(is_played_further)
                (tmp_path / "package" / "end").touch()
                await gateway.close()
            finished = await operator.finished(created.run)
            worker.drain()
            await asyncio.wait_for(working, TIMEOUT_S)
        assert finished.infrastructure_retries == 0
        played = stored.played()
        assert [len(actions) for actions in (*thrown, played)] == sorted({len(a) for a in (*thrown, played)})
        for actions in thrown:
            assert played[: len(actions)] == actions

    try:
        asyncio.run(scenario())
    finally:
        coordinators[-1].stop()
