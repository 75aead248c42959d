"""Coordinators whose blobs are in an object store: down, frozen, denied, shared by two, moved; keys are nowhere."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from commands import worker_of
from coordinator_harness import (
    Coordinator,
    bundle_of,
    comparable,
    gateway_of,
    operator_of,
    play,
    run,
    working,
)
from machines.postgres import Server
from machines.seaweedfs import ObjectStore

from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, EpisodeSpec, Job
from evopolicy_common.messages.operator import RunCreated
from evopolicy_common.records.blobs import digest_of
from evopolicy_coordinator.storage import disk_use
from evopolicy_coordinator.storage.engines import BLOBS, place_of

pytestmark = pytest.mark.cluster

SUBMITS = (((0, 1, 1, 5), "# one"), ((2, 3), "# two"), ((7, 7, 7, 7, 8, 9), "# three"))
RECORDING = b"a recording that is too long for a message" * 2000


def by_digest(job: Job, spec: EpisodeSpec) -> EpisodeOutcome:
    """An outcome whose trajectory is uploaded."""
    blob = BlobRef(digest=digest_of(RECORDING), size=len(RECORDING), inline=None)
    return msgspec.structs.replace(play(job, spec), trajectory=blob if job.record == "full" else None)


async def submit(coordinator: Coordinator, created: RunCreated, number: int) -> None:
    """Uploads the recording as a worker, submits as a gateway, and reads the feedback with the recording."""
    ids, source = SUBMITS[number]
    async with working(coordinator, play=by_digest) as worker, gateway_of(coordinator, created) as gateway:
        while not worker.session:
            await asyncio.sleep(0.01)
        await worker.ask.upload(worker.name, worker.session, digest_of(RECORDING), RECORDING)
        await gateway.submit(bundle_of(source), ids, f"submit-{number}")
        episodes, done = await gateway.results(number)
        assert len({episode.index for episode in episodes}) == done.n_kept == len(ids)
        found = await gateway.ask.download(gateway.run, gateway.token, digest_of(RECORDING))
        assert found == RECORDING


async def whole(coordinator: Coordinator) -> dict[str, Any]:
    async with operator_of(coordinator) as operator:
        created = await operator.create()
        for number in range(len(SUBMITS)):
            await submit(coordinator, created, number)
        return await ended(coordinator, created)


async def ended(coordinator: Coordinator, created: RunCreated) -> dict[str, Any]:
    async with (
        operator_of(coordinator) as operator,
        working(coordinator, play=by_digest),
        gateway_of(coordinator, created) as gateway,
    ):
        await gateway.close()
        return comparable(await operator.finished(created.run))


def test_a_run_survives_the_loss_of_the_object_store_and_a_move(
    tmp_path: Path, object_store: ObjectStore
) -> None:
    """The service is killed before a submit, started while the gateway asks, and the coordinator is killed then. The
    run ends with the result of the undisturbed one in folders; keys are in no file and no argument."""
    expected = list[dict[str, Any]]()
    calm = Coordinator(tmp_path / "calm")

    async def undisturbed() -> None:
        expected.append(await whole(calm))

    try:
        run(undisturbed, 120)
    finally:
        calm.kill()
    state, address, created = tmp_path / "state", object_store.new(), list[RunCreated]()
    state.mkdir(mode=0o700)
    shutil.copy(tmp_path / "calm" / "secret", state / "secret")
    coordinator = Coordinator(state, "--blobs", address)

    async def first() -> None:
        async with operator_of(coordinator) as operator:
            created.append(await operator.create())
            await submit(coordinator, created[0], 0)
            await asyncio.to_thread(object_store.kill)
            playing = asyncio.create_task(submit(coordinator, created[0], 1))
            while "cannot write" not in (await operator.status()).trouble:
                assert not playing.done()
                await asyncio.sleep(0.1)
            trouble = (await operator.status()).trouble
            assert address in trouble
            assert "see that it answers and has room" in trouble
            await asyncio.to_thread(object_store.start)
            await playing
            assert (await operator.status()).trouble == ""

    async def second() -> None:
        await submit(again, created[0], 2)
        assert await ended(again, created[0]) == expected[0]

    try:
        run(first, 180)
    finally:
        coordinator.kill()
    assert not list((state / "blobs").glob("??"))
    assert len(object_store.paths(address)) == 3
    move = [sys.executable, "-m", "evopolicy_coordinator.cli", "move", "--blobs", str(state / "blobs")]
    done = subprocess.run([*move, "--state", str(state)], capture_output=True, text=True, check=False)
    assert (done.returncode, "3 blobs moved" in done.stdout) == (0, True), done.stderr
    again = Coordinator(state)
    try:
        run(second, 180)
    finally:
        again.kill()
    secret = object_store.keys["AWS_SECRET_ACCESS_KEY"].encode()
    for path in state.rglob("*"):
        assert not path.is_file() or secret not in path.read_bytes(), path
    assert secret not in coordinator.log.read_bytes()


PEEKING = """
import os, pathlib
class Policy:
    def __init__(self, obs_space, action_space, env_meta): pass
    def reset(self, episode_index):
        print(dict(os.environ))
        for path in (pathlib.Path("/proc/self/cmdline"), *pathlib.Path(__file__).parent.rglob("*")):
            try:
                print(path.read_text())
            except OSError as error:
                print(error)
    def act(self, obs): return 1
"""


def test_workers_and_gateways_read_from_the_object_store(tmp_path: Path, object_store: ObjectStore) -> None:
    """With `--direct-blobs` the coordinator sends no bytes of blobs that it has no copy of. Attack: a policy looks for
    the address in all that it can read; neither it nor a log or file has one."""
    state = tmp_path / "state"
    coordinator, peeked = (
        Coordinator(folder, "--blobs", object_store.new(), "--direct-blobs")
        for folder in (state, tmp_path / "peeked")
    )

    async def scenario() -> None:
        async with operator_of(coordinator) as operator:
            created = await operator.create()
            await submit(coordinator, created, 0)
            await asyncio.to_thread(shutil.rmtree, state / "blob-copies")
            (state / "blob-copies" / "parts").mkdir(parents=True)
            async with gateway_of(coordinator, created) as gateway:
                found = await gateway.ask.download(gateway.run, gateway.token, digest_of(RECORDING))
                assert found == RECORDING
            assert [path for path in (state / "blob-copies").rglob("*") if path.is_file()] == []
            assert await operator.ask.download("operator", operator.token, digest_of(RECORDING)) == RECORDING

    async def real() -> None:
        with worker_of(peeked, "--env", "toy/line"):
            async with operator_of(peeked) as operator:
                created = await operator.create()
                async with gateway_of(peeked, created) as gateway:
                    await gateway.submit(bundle_of(PEEKING), (0, 1), "peeks")
                    episodes, done = await gateway.results(0)
                    assert (done.status, {episode.index for episode in episodes}) == ("ok", {0, 1})
                    printed = b"".join(episode.stdout for episode in episodes)
                    assert b"class Policy" in printed, episodes
                    assert b"X-Amz" not in printed

    try:
        run(scenario, 120)
        run(real, 120)
    finally:
        coordinator.kill()
        peeked.kill()
    for path in tmp_path.rglob("*"):
        assert not path.is_file() or b"X-Amz" not in path.read_bytes(), path


def test_two_coordinators_share_the_object_store(
    tmp_path: Path, object_store: ObjectStore, server: Server
) -> None:
    """The second one, with a copy of the identity only, continues the run of the first with its blobs, and a collection
    from either folder takes none that is named."""
    store, address = server.new(), object_store.new()
    first = Coordinator(tmp_path / "one", "--store", store, "--blobs", address)
    created = list[RunCreated]()

    async def begin() -> None:
        async with operator_of(first) as operator:
            created.append(await operator.create())
        await submit(first, created[0], 0)
        await asyncio.to_thread(disk_use.collect, tmp_path / "one", 0.0)

    async def go_on() -> None:
        await asyncio.to_thread(disk_use.collect, tmp_path / "one", 0.0)
        await submit(second, created[0], 1)
        server.query(store, "UPDATE objects SET since = 0")
        for folder in ("one", "two"):
            assert (await asyncio.to_thread(disk_use.collect, tmp_path / folder, 0.0)).blobs == 0
        await submit(second, created[0], 2)
        finished = await ended(second, created[0])
        assert finished["budget_used"] == 12

    try:
        run(begin, 120)
    finally:
        first.kill()
    (tmp_path / "two").mkdir(mode=0o700)
    for name in ("identity.json", "secret", "signing-key"):
        shutil.copy(tmp_path / "one" / name, tmp_path / "two" / name)
    second = Coordinator(tmp_path / "two", "--store", store, "--blobs", address)
    try:
        run(go_on, 120)
    finally:
        second.kill()
    assert place_of(tmp_path / "two", BLOBS) == address
    # Their clocks and ages play no part: what the finished run names goes with it, and nothing else.
    server.query(store, "UPDATE objects SET since = 0")
    assert disk_use.collect(tmp_path / "two", 0.0).blobs == 4
    assert object_store.paths(address) == []


def test_wrong_places_are_refused(
    tmp_path: Path, object_store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = object_store.new()
    first = Coordinator(tmp_path / "one", "--blobs", address)
    assert first.stop() == 0
    serve = [sys.executable, "-m", "evopolicy_coordinator.cli"]

    def refused(state: str, *args: str) -> str:
        done = subprocess.run(
            [*serve, "--state", str(tmp_path / state), *args], capture_output=True, text=True, check=False
        )
        assert done.returncode != 0
        return done.stderr

    assert "blobs of another state folder" in refused("two", "--blobs", address)
    assert "move them there first" in refused("one", "--blobs", object_store.new())
    assert "s3://BUCKET/PREFIX" in refused("three", "--blobs", "ftp://somewhere/x")
    for name, value in object_store.reading.items():
        monkeypatch.setenv(name, value)
    denied = refused("four", "--blobs", object_store.new())
    assert "cannot claim it" in denied
    assert "AccessDenied" in denied
    assert object_store.reading["AWS_SECRET_ACCESS_KEY"] not in denied
