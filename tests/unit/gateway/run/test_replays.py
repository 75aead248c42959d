"""Recordings of held-out episodes, fetched into a run directory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.finished_run import finished

from evopolicy_common.errors import RefusedError, TransportError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.records.blobs import digest_of
from evopolicy_gateway.run.record import fetch_replays

MP4 = [b"mp4 %d" % index for index in range(3)]


class Cluster:
    """Stored outcomes of three episodes, which came in backwards; `fails` names blobs that cannot be had."""

    def __init__(self, recorded: Iterable[int] = (0, 1, 2)) -> None:
        self.recorded_indexes = set(recorded)
        self.fails: dict[bytes, Exception] = {}
        self.fetched: list[int] = []
        self.asked: list[tuple[str, str, int]] = []

    async def recorded(self, run: str, split: str, submit_index: int) -> AsyncIterator[EpisodeOutcome]:
        self.asked.append((run, split, submit_index))
        for index in (2, 1, 0):
            ref = BlobRef(digest=digest_of(MP4[index]), size=len(MP4[index]))
            yield EpisodeOutcome(
                index=index,
                episode_return=float(index),
                length=10 + index,
                terminated=True,
                truncated=False,
                video=ref if index in self.recorded_indexes else None,
            )

    async def fetch(self, ref: BlobRef) -> bytes:
        data = next(data for data in MP4 if digest_of(data) == ref.digest)
        if data in self.fails:
            raise self.fails[data]
        self.fetched.append(MP4.index(data))
        return data


def run_with(**settings: Any) -> RunFinished:
    run = finished(status="completed", best_submit_index=4)
    return msgspec.structs.replace(run, settings=msgspec.structs.replace(run.settings, **settings))


def fetch(root: Path, run: RunFinished, cluster: Cluster) -> Any:
    return asyncio.run(fetch_replays(root, run, cluster))  # type: ignore[arg-type]


def test_recordings_are_written_and_told_in_the_splits_order(tmp_path: Path) -> None:
    cluster = Cluster()
    kept = fetch(tmp_path, run_with(replays="all"), cluster)
    assert cluster.asked == [(run_with().run, "heldout", 4)]
    assert [(each.episode, each.submit_index, each.episode_return, each.length) for each in kept] == [
        (0, 4, 0.0, 10),
        (1, 4, 1.0, 11),
        (2, 4, 2.0, 12),
    ]
    assert [(tmp_path / each.path).read_bytes() for each in kept] == MP4


@pytest.mark.parametrize("settings", [{}, {"video": "all", "replays": "off"}])
def test_a_run_that_records_nothing_asks_for_nothing(tmp_path: Path, settings: dict[str, str]) -> None:
    cluster = Cluster()
    assert fetch(tmp_path, run_with(**settings), cluster) == ()
    assert cluster.asked == []
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_a_selected_checkpoint_has_no_recordings(tmp_path: Path) -> None:
    run = msgspec.structs.replace(run_with(replays="all"), best_submit_index=None)
    assert fetch(tmp_path, run, Cluster()) == ()


def test_feedback_videos_bring_held_out_recordings_unless_told_otherwise(tmp_path: Path) -> None:
    assert [each.episode for each in fetch(tmp_path, run_with(video="first"), Cluster([0]))] == [0]


def test_videos_fetched_before_an_interruption_are_not_fetched_again(tmp_path: Path) -> None:
    cluster = Cluster()
    cluster.fails[MP4[1]] = TransportError("cut off")
    with pytest.raises(TransportError):
        fetch(tmp_path, run_with(replays="all"), cluster)
    cluster.fails.clear()
    # One half-written by whatever else is no recording.
    (tmp_path / "replays/heldout_000").mkdir()
    (tmp_path / "replays/heldout_000/video.mp4").write_bytes(b"mp")
    assert len(fetch(tmp_path, run_with(replays="all"), cluster)) == 3
    assert cluster.fetched == [2, 1, 0]
    assert (tmp_path / "replays/heldout_000/video.mp4").read_bytes() == MP4[0]


def test_a_recording_that_the_cluster_no_longer_has_is_left_out(tmp_path: Path) -> None:
    cluster = Cluster()
    cluster.fails[MP4[1]] = RefusedError("unknown_blob", "no such blob")
    assert [each.episode for each in fetch(tmp_path, run_with(replays="all"), cluster)] == [0, 2]
