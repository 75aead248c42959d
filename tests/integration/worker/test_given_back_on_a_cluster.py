"""Workers that play a hidden episode end again and again: its policy's dice are thrown once.

A real coordinator, real supervisors and their real slots. The environment is the test's own: a hidden episode of it
goes on until the test writes its length to a file, however slow the machine is.

Attacks, each with its defence:
- has a second attempt at a hidden episode whose worker ended: the worker returns the policy's actions and failure, and
  the next attempt plays them first.
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
from evopolicy_coordinator.core.contract.records import BegunRow, OutcomeRow, submit_group
from evopolicy_worker.capabilities import Capabilities
from evopolicy_worker.slot_protocol import begun
from evopolicy_worker.slots.slot import Slot
from evopolicy_worker.supervisor import Supervisor, WorkerOptions

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
        self.hidden = seed != {train}
        self.steps = 0
        return 0, {{}}

    def step(self, action):
        self.steps += 1
        length = 5
        if self.hidden:
            length = int(open({end!r}).read()) if os.path.exists({end!r}) else self.steps + 1
        return 0, 0.0, self.steps >= length, False, {{}}
"""
CASES = {"train": 11, "valid": 1_000_003, "heldout": 1_000_033}
"""The seed of each split's only case."""
ENTRY = Entry(id="acme/held", gymnasium_id="held_env:Held-v0", max_episode_steps=1_000_000)
N_STOPS = 2


def place(folder: Path) -> None:
    """The environment's package, and its cases."""
    package, told, cases = folder / "package", folder / "told", folder / "data" / "acme_held"
    for each in (package, told, cases):
        each.mkdir(parents=True)
    source = HELD.format(train=CASES["train"], end=str(told / "end"))
    register = f"\ngymnasium.register({ENTRY.gymnasium_id.partition(':')[2]!r}, Held)\n"
    (package / "held_env.py").write_text(source + register)
    for split, seed in CASES.items():
        document = {"env": ENTRY.id, "split": split, "cases": [{"seed": seed}], "secret": True}
        (cases / f"{split}.json").write_text(json.dumps(document))


def actions_of(recording: bytes) -> list[float]:
    return [float(row.action[0]) for row in decode(recording).rows()]


def slot_of(scratch: Path) -> Slot:
    entry = msgspec.structs.replace(ENTRY, data=(str(scratch.parent / "told"),))
    return Slot(None, "bwrap", scratch, definitions=(entry,))


async def described(folder: Path) -> EnvironmentDescription:
    slot = slot_of(folder / "described")
    await slot.start()
    try:
        (found,) = await slot.describe((ENTRY.id,))
    finally:
        await slot.close()
    return found


class Stored:
    """The coordinator's files."""

    def __init__(self, state: Path) -> None:
        self._path = state / "coordinator.sqlite"
        self._blobs = BlobStore(state / "blobs")

    def _rows(self, table: str, group: str) -> list[bytes]:
        with sqlite3.connect(f"file:{self._path}?mode=ro", uri=True) as db:
            return [data for (data,) in db.execute(f"SELECT data FROM {table} WHERE grp = ?", (group,))]

    def begun(self, group: str) -> list[float]:
        """The actions that the group's next attempt goes on from."""
        for data in self._rows("begun", group):
            ref = msgspec.msgpack.decode(data, type=BegunRow).begun
            if ref is not None:
                job = Job(job_id="", env="", bundle="b", episodes=(), record="actions", begun=ref)
                inline = ref.inline or self._blobs.read_blob(ref.digest)
                job = msgspec.structs.replace(job, begun=msgspec.structs.replace(ref, inline=inline))
                return [float(action[0]) for _, action in begun.unpack(job)[0].unpacked().taken]
        return []

    def played(self, group: str) -> list[float]:
        """The actions of the group's episode that counts."""
        for data in self._rows("outcomes", group):
            recording = msgspec.msgpack.decode(data, type=OutcomeRow).outcome.trajectory
            assert recording is not None
            return actions_of(recording.inline or self._blobs.read_blob(recording.digest))
        return []


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.system
def test_a_policy_whose_workers_end_again_and_again_gets_one_throw(
    tmp_path: Path, restart: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    thrown: list[list[float]] = []
    place(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "package"), prepend=os.pathsep)
    options = WorkerOptions(
        name="w-1",
        slots=2,  # the random reference goes on as long
        fingerprint=FINGERPRINT,
        host="test",
        boot_id="kernel-of-w-1",
        scratch=tmp_path / "w-1",
        grace_s=0.1,
    )
    capabilities = Capabilities(("bwrap",), (asyncio.run(described(tmp_path)),))

    def coordinator_of() -> Coordinator:
        return Coordinator(tmp_path / "state", "--data", str(tmp_path / "data"))

    coordinators = [coordinator_of()]

    async def wait_for(look: Callable[[], object]) -> None:
        async with asyncio.timeout(TIMEOUT_S):
            while not look():
                await asyncio.sleep(0.02)

    async def scenario() -> None:
        coordinator = coordinators[0]
        async with connect(coordinator.credentials("worker")) as link, operator_of(coordinator) as operator:

            def started(number: int) -> tuple[Supervisor, asyncio.Task[None]]:
                worker = Supervisor(
                    link,
                    options,
                    capabilities,
                    lambda index, tier: slot_of(tmp_path / f"slot-{number}-{index}"),
                )
                return worker, asyncio.create_task(worker.run())

            worker, working = started(0)
            created = await operator.create(env=ENTRY.id, n_validation=1, n_heldout=1)
            group = submit_group(created.run, 0, "validation")
            stored = Stored(coordinator.state)

            def played_further() -> bool:
                """Whether the episode is played, and has gone on from where it was stopped."""
                steps = {each.job_id: each.steps for each in worker._heartbeat.held.values()}
                return steps.get(f"{group}/0", 0) > 2 + len(stored.begun(group))

            async with gateway_of(coordinator, created) as gateway:
                await gateway.submit(bundle_of(CLOCKED), (0,), "first")
                await gateway.results(0)
                await gateway.close()
            for number in range(N_STOPS):
                await wait_for(played_further)
                before = len(stored.begun(group))
                worker.drain()
                await asyncio.wait_for(working, TIMEOUT_S)
                await wait_for(lambda: len(stored.begun(group)) > before)  # noqa: B023
                thrown.append(stored.begun(group))
                if restart and number == 0:
                    coordinator.kill()
                    coordinators.append(coordinator_of())
                worker, working = started(number + 1)
            await wait_for(played_further)
            # An episode that has yet to go on repeats what it began, so the end lies beyond that.
            furthest = max(map(len, thrown))
            (tmp_path / "length").write_text(str(furthest + 3))
            (tmp_path / "length").rename(tmp_path / "told" / "end")
            finished = await operator.finished(created.run)
            worker.drain()
            await asyncio.wait_for(working, TIMEOUT_S)
        assert finished.infrastructure_retries == 0
        played = stored.played(group)
        lengths = [len(actions) for actions in (*thrown, played)]
        assert lengths == sorted(set(lengths))
        assert all(played[: len(actions)] == actions for actions in thrown)

    try:
        asyncio.run(scenario())
    finally:
        coordinators[-1].stop()
