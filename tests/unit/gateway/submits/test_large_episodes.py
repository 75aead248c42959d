"""A hostile worker's recordings of a gigabyte take neither the gateway's memory nor all its threads."""

from __future__ import annotations

import asyncio
import io
import threading
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard
from gateway_double import served
from rigs.finished_run import played_episode

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.episode import BlobRef, ResourceLimits
from evopolicy_common.messages.worker import BlobChunk, BlobGet
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes import npz, rendered, trajectory
from evopolicy_common.records.episodes.trajectory import Recorder
from evopolicy_common.wire import codec
from evopolicy_gateway.submits import feedback
from evopolicy_gateway.submits.coordinator_client import LARGE_BYTES, CoordinatorClient
from evopolicy_gateway.submits.episode_files import episode_files, episode_share

ROW = b'{"t":0,"obs":null,"action":0,"reward":0.5,"terminated":true,"truncated":false,"info":{}}\n'


def rendered_episode(observations: bytes) -> bytes:
    files = [
        {"name": rendered.ROWS, "size": len(ROW), "packed": "zstd"},
        {"name": rendered.OBSERVATIONS, "size": len(observations), "packed": "as it is"},
    ]
    log = Recorder("actions")
    log.append(None, 0, 0.5, True, False, {})
    parts = [
        msgspec.msgpack.encode({"observations": "arrays", "n": 1, "files": files}),
        log.finish(),
        zstandard.ZstdCompressor().compress(ROW),
        observations,
    ]
    return rendered.MAGIC + b"".join(len(part).to_bytes(4, "little") + part for part in parts)


def client_of(whole: bytes, scratch: Path) -> CoordinatorClient:
    """A client of a coordinator that has these bytes."""
    link = SimpleNamespace(credentials=SimpleNamespace(token="", cluster="c"))
    client = CoordinatorClient(link, "r", scratch)  # type: ignore[arg-type]

    async def answer(verb: str, message: BlobGet, wanted: type) -> BlobChunk:
        return BlobChunk(size=len(whole), data=whole[message.offset : message.offset + codec.CHUNK_BYTES])

    client._requests.until_answered = answer  # type: ignore[assignment,method-assign]
    return client


def peak_of(work: Callable[[], Any]) -> tuple[Any, int]:
    """The result, and the most memory that was taken meanwhile, bytes."""
    tracemalloc.start()
    try:
        result = work()
        return result, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_files_of_a_large_episode_are_made_without_its_bytes_in_memory(tmp_path: Path) -> None:
    out = io.BytesIO()
    np.savez(out, observations=np.random.default_rng(0).bytes(3 * LARGE_BYTES))
    observations = out.getvalue()
    whole = rendered_episode(observations)
    ref = BlobRef(digest=digest_of(whole), size=len(whole))
    episode = played_episode(episode_return=0.5, trajectory=ref)

    def work() -> dict[str, bytes]:
        packed = asyncio.run(client_of(whole, tmp_path).fetch(ref))
        share = episode_share(ResourceLimits(), 128)
        return episode_files(episode, packed, None, "npz", at=0.0, share=share)

    files, peak = peak_of(work)
    assert peak < LARGE_BYTES
    assert files[rendered.OBSERVATIONS] == observations
    assert files[rendered.ROWS] == ROW
    assert list(tmp_path.iterdir()) == []


def test_a_recording_larger_than_announced_is_refused(tmp_path: Path) -> None:
    whole = bytes(2 * codec.CHUNK_BYTES)
    ref = BlobRef(digest=digest_of(whole), size=10)
    with pytest.raises(ProtocolError, match="10 are the limit"):
        asyncio.run(client_of(whole, tmp_path).fetch(ref))


def test_an_archive_of_very_many_arrays_is_refused_before_they_are_listed() -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for n in range(100_000):
            archive.writestr(f"{n}.npy", b"")

    def work() -> None:
        with pytest.raises((ValueError, zipfile.BadZipFile)):
            npz.check_archive(memoryview(out.getvalue()), trajectory.MAX_BYTES)
        with pytest.raises(ValueError, match="no file of arrays"):
            npz.read_arrays(out.getvalue(), trajectory.MAX_BYTES)

    assert peak_of(work)[1] < 24 << 20


async def test_large_episodes_are_written_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    at_work, most, lock = 0, 0, threading.Lock()
    real = feedback.episode_files

    def slow(*args: Any, **more: Any) -> dict[str, bytes]:
        nonlocal at_work, most
        with lock:
            at_work += 1
            most = max(most, at_work)
        time.sleep(0.1)
        with lock:
            at_work -= 1
        return real(*args, **more)

    monkeypatch.setattr(feedback, "episode_files", slow)
    async with served(tmp_path) as s:
        # Their recordings are not rendered, so nothing is known of their size; those of even cases come as blobs.
        answer = await s.submit([0, 2, 4, 6])
        assert answer.json()["status"] == "ok"
    assert most == 1
