"""Backups of a running coordinator and what they restore to; what `evopolicy gc` takes and what it must leave."""

from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path

import msgspec
import pytest
from coordinator_harness import (
    Coordinator,
    bundle_of,
    gateway_of,
    operator_of,
    play,
    working,
)
from typer.testing import CliRunner

from evopolicy_common.errors import ConfigError, StorageError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, EpisodeSpec, Job
from evopolicy_common.records.blobs import BlobStore, digest_of
from evopolicy_coordinator.cli import gc as gc_cli
from evopolicy_coordinator.storage import backup, disk_use

WEEK_S = 7 * 24 * 3600.0


async def whole_run(coordinator: Coordinator, key: str, source: str) -> str:
    """One submit of eight episodes, closed and finished; the run's id."""
    async with operator_of(coordinator) as operator:
        created = await operator.create(key=key, n_validation=2, n_heldout=2)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of(source), tuple(range(8)), "k")
            await gateway.results(0)
            await gateway.close()
        assert (await operator.finished(created.run)).status == "completed"
    return created.run


def test_a_backup_is_whole_or_not_there(coordinator: Coordinator, tmp_path: Path) -> None:
    target = tmp_path / "backup"
    with pytest.raises(ConfigError, match=r"it has no coordinator\.sqlite"):
        backup.back_up(tmp_path / "nothing", target)
    blobs = BlobStore(coordinator.state / "blobs")
    digest = blobs.put(b"a bundle")
    os.truncate(blobs.path(digest), 3)
    with pytest.raises(StorageError, match="damaged"):
        backup.back_up(coordinator.state, target)
    assert not list(tmp_path.glob("*backup*"))
    backup.back_up(coordinator.state, target)  # the damaged one was set aside
    assert (target / "coordinator.sqlite").stat().st_mode & 0o077 == 0
    assert target.stat().st_mode & 0o077 == 0
    with pytest.raises(ConfigError, match="already exists"):
        backup.back_up(coordinator.state, target)


def trajectory_of(digest: str | None) -> bytes:
    return f"trajectory of {digest}".encode() * 2000


def by_digest(job: Job, spec: EpisodeSpec) -> EpisodeOutcome:
    """An outcome whose trajectory has been uploaded."""
    data = trajectory_of(job.bundle)
    blob = BlobRef(digest=digest_of(data), size=len(data), inline=None)
    return msgspec.structs.replace(play(job, spec), trajectory=blob if job.record == "full" else None)


async def test_gc_takes_old_finished_runs_and_leaves_the_others(coordinator: Coordinator) -> None:
    blobs = BlobStore(coordinator.state / "blobs")

    kept, gone = bundle_of("open policy").digest, bundle_of("old policy").digest
    async with working(coordinator, play=by_digest) as worker:
        while not worker.session:
            await asyncio.sleep(0.01)
        for data in (trajectory_of(kept), trajectory_of(gone)):
            await worker.ask.upload(worker.name, worker.session, digest_of(data), data)
        old = await whole_run(coordinator, "old", "old policy")
        async with operator_of(coordinator) as operator:
            created = await operator.create(key="open", n_validation=2, n_heldout=2)
            async with gateway_of(coordinator, created) as gateway:
                await gateway.submit(bundle_of("open policy"), tuple(range(8)), "k")
                await gateway.results(0)
                fresh = disk_use.collect(coordinator.state, WEEK_S)
                assert (fresh.runs, fresh.episodes, fresh.blobs) == (0, 0, 0)
                later = time.time() + WEEK_S + 3600.0
                planned = disk_use.collect(coordinator.state, WEEK_S, now=later, dry_run=True)
                assert blobs.has(gone)
                done = await asyncio.to_thread(disk_use.collect, coordinator.state, WEEK_S, now=later)
                assert (done.runs, done.blobs, done.bytes) == (planned.runs, planned.blobs, planned.bytes)
                # 8 train, 2 validation, 2 held-out, 2 random.
                assert (done.runs, done.episodes, done.blobs, done.shrunk) == (1, 14, 2, False)
                assert blobs.has(kept)
                assert blobs.has(digest_of(trajectory_of(kept)))
                assert not blobs.has(gone)
                assert not blobs.has(digest_of(trajectory_of(gone)))
                # The outcome stays known, and the open run goes on.
                assert (await operator.finished(old)).status == "completed"
                episodes, _ = await gateway.results(0)
                assert len(episodes) == 8
                await gateway.submit(bundle_of("open policy"), (0,), "k1")
                await gateway.results(1)
                await gateway.close()
            assert (await operator.finished(created.run)).status == "completed"
    assert coordinator.stop() == 0
    assert disk_use.collect(coordinator.state, 0.0).shrunk
    assert Coordinator(coordinator.state).stop() == 0


def test_a_blob_that_nothing_names_goes_once_it_is_old(coordinator: Coordinator) -> None:
    blobs = BlobStore(coordinator.state / "blobs")
    digest = blobs.put(b"uploaded for nothing")
    assert disk_use.collect(coordinator.state, WEEK_S).blobs == 0
    os.utime(blobs.path(digest), (0, 0))
    # Uploaded again, it may be about to be named.
    assert blobs.append_chunk("w", digest, 20, 0, b"uploaded for nothing") == 20
    assert disk_use.collect(coordinator.state, WEEK_S).blobs == 0
    os.utime(blobs.path(digest), (0, 0))
    assert disk_use.collect(coordinator.state, WEEK_S).blobs == 1
    assert not blobs.has(digest)


async def test_disk_tells_what_runs_take_and_whether_a_sweep_fits(coordinator: Coordinator) -> None:
    async with working(coordinator):
        await whole_run(coordinator, "one", "a policy")
    (found,) = disk_use.use(coordinator.state)
    assert (found.env, found.runs, found.train_episodes) == ("toy/line", 1, 8)
    assert found.bytes > 8 * 100
    estimate = disk_use.estimate(coordinator.state, {"toy/line": 80, "gym/acrobot": 8})
    assert estimate.bytes == pytest.approx(11 * found.bytes, rel=0.01)
    assert estimate.guessed == ("gym/acrobot",)
    assert estimate.fits
    cli = CliRunner()
    arguments = ["--state", str(coordinator.state), "--env", "toy/line", "--budget", "80"]
    invoked = cli.invoke(gc_cli.disk_app, arguments)
    assert (invoked.exit_code, "planned: about" in invoked.stdout) == (0, True)
    assert "run directories, in addition: at most" in invoked.stdout
    too_much = cli.invoke(gc_cli.disk_app, [*arguments, "--runs", "1000000000"])
    assert too_much.exit_code == 1
    assert "estimated without earlier runs" not in too_much.stdout
    cleaned = cli.invoke(gc_cli.gc_app, ["--state", str(coordinator.state), "--dry-run"])
    assert "would remove 0 episodes" in cleaned.stdout
