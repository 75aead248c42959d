"""Answers from disk: pages that show a gateway its own train episodes only, blobs in checked chunks."""

from __future__ import annotations

import queue
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.store_rows import blob, outcome_row, run_row, state_row, submit_row

from evopolicy_common.messages.gateway import EpisodeFeedback, ResultsPage
from evopolicy_common.messages.operator import EvaluationPage
from evopolicy_common.messages.worker import BlobAck, BlobChunk, BlobGet, BlobPut, Message, Refused
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec
from evopolicy_coordinator.core.contract import records
from evopolicy_coordinator.core.contract.effects import ReadEvaluation, ReadFinished, ReadResults
from evopolicy_coordinator.server import uploads as uploads_module
from evopolicy_coordinator.server.reader import MAX_PAGE_BYTES, ServiceReader
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.storage.store import Store

TRAIN = records.submit_group("r-1", 0, "train")


class Rig:
    """Answers on a store, waited for."""

    def __init__(self, root: Path) -> None:
        self.store = Store(root / "db")
        self.blobs = BlobStore(root / "blobs")
        self.uploads = Uploads()
        self.reader = ServiceReader(root / "db", self.blobs, self.uploads, root)
        self._answered: queue.Queue[Message | None] = queue.Queue()

    def page(self, effect: ReadResults | ReadEvaluation | ReadFinished) -> Any:
        self.reader.answer_read(effect, self._answered.put)
        return self._answered.get(timeout=10)

    def results(self, cursor: int, upto: int | None) -> Any:
        return self.page(ReadResults(request=1, run="r-1", submit_index=0, cursor=cursor, upto=upto))

    def put(
        self, message: BlobPut, most: int = 1 << 20, run: str | None = None, submitted: Collection[str] = ()
    ) -> Any:
        sender = f"gw/{run}" if run else "sender"
        self.reader.put(sender, run, message, most, self._answered.put, submitted)
        return self._answered.get(timeout=10)

    def get(self, run: str | None, digest: str, offset: int = 0) -> Any:
        self.reader.get(run, BlobGet(sender="", token="", digest=digest, offset=offset), self._answered.put)
        return self._answered.get(timeout=10)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.store.write([run_row(), state_row(), submit_row()])
    yield rig
    rig.reader.close()
    rig.store.close()


def put(whole: bytes, /, **changes: Any) -> BlobPut:
    ref = blob(whole)
    values = {"sender": "", "token": "", "digest": ref.digest, "size": len(whole), "offset": 0, "data": whole}
    return BlobPut(**{**values, **changes})


def test_page_shows_what_is_released_and_no_more(rig: Rig) -> None:
    rig.store.write([outcome_row(TRAIN, index, index) for index in range(4)])
    page = rig.results(0, 2)
    assert isinstance(page, ResultsPage)
    assert [episode.index for episode in page.episodes] == [0, 1]
    assert (page.cursor, page.done, page.more) == (2, None, False)
    # A place that is not written yet does not count as more: the gateway would ask without a pause.
    assert rig.results(4, 9).more is False
    assert rig.results(2, 2).episodes == ()


def test_end_comes_with_the_page_that_reaches_it(rig: Rig) -> None:
    big = blob(b"x" * (MAX_PAGE_BYTES // 2))
    rig.store.write([outcome_row(TRAIN, index, index, big) for index in range(4)])
    rig.store.write([submit_row(status="ok", completed_at=2.0, released=4, n_kept=4)])
    cursor, pages = 0, []
    while True:
        page = rig.results(cursor, 2)
        pages.append(page)
        cursor = page.cursor
        if page.done is not None:
            break
    assert [episode.index for page in pages for episode in page.episodes] == [0, 1, 2, 3]
    assert len(pages) > 1
    assert [page.more for page in pages] == [True] * (len(pages) - 1) + [False]
    assert pages[-1].done.status == "ok"
    assert rig.results(0, None).episodes[0].trajectory == big


def test_feedback_of_an_episode_carries_what_an_agent_may_see(rig: Rig) -> None:
    rig.store.write([outcome_row(TRAIN, 0, 0)])
    (episode,) = rig.results(0, 1).episodes
    assert set(msgspec.to_builtins(episode)) == set(EpisodeFeedback.__struct_fields__)
    assert not {"wall_s", "policy_cpu_s", "worker", "seed"} & set(EpisodeFeedback.__struct_fields__)


def test_unknown_submit_and_unfinished_run_are_refused(rig: Rig) -> None:
    effect = ReadResults(request=1, run="r-1", submit_index=7, cursor=0, upto=None)
    assert rig.page(effect).status == "unknown_submit"
    assert rig.page(ReadFinished(request=1, run="r-1")).status == "unknown_run"


def test_evaluation_is_finished_on_the_page_that_reaches_its_end(rig: Rig) -> None:
    group = records.evaluation_group("e")
    rig.store.write([outcome_row(group, index, index, blob(b"x" * MAX_PAGE_BYTES)) for index in range(2)])
    effect = ReadEvaluation(request=1, evaluation="e", cursor=0, upto=2, total=2, finished=True)
    first = rig.page(effect)
    assert isinstance(first, EvaluationPage)
    assert (len(first.outcomes), first.finished) == (1, False)
    second = rig.page(msgspec.structs.replace(effect, cursor=first.cursor))
    assert (len(second.outcomes), second.finished) == (1, True)


def test_blob_put_in_chunks_is_got_in_chunks(rig: Rig) -> None:
    data = bytes(range(256)) * 1000
    size, half = len(data), len(data) // 2
    assert rig.put(put(data, data=data[:half])) == BlobAck(have=half)
    assert rig.put(put(data, offset=0, data=data[half:])) == BlobAck(have=size - half)
    assert rig.put(put(data, offset=7, data=b"")) == BlobAck(have=size - half)
    assert rig.put(put(data, offset=0, data=data[:half])) == BlobAck(have=half)
    assert rig.put(put(data, offset=half, data=data[half:])) == BlobAck(have=size)
    got = bytearray()
    while len(got) < size:
        chunk = rig.get(None, blob(data).digest, len(got))
        assert isinstance(chunk, BlobChunk)
        assert chunk.size == size
        assert 0 < len(chunk.data) <= codec.CHUNK_BYTES
        got += chunk.data
    assert bytes(got) == data


def test_an_upload_given_up_halfway_is_forgotten_and_restarted(rig: Rig) -> None:
    data = b"bundle" * 100
    assert rig.put(put(data, data=data[:50])) == BlobAck(have=50)
    rig.blobs.drop_unfinished()
    assert rig.put(put(data, offset=50, data=data[50:])) == BlobAck(have=0)
    assert rig.put(put(data)) == BlobAck(have=len(data))


def test_a_gateway_is_not_told_whether_others_have_stored_a_blob(rig: Rig) -> None:
    data = b"another run's bundle"
    digest, size, half = blob(data).digest, len(data), len(data) // 2
    unknown = put(b"x" * size, data=b"x")
    rig.blobs.put(data)
    # Asked about a blob that is here exactly as about one that is not.
    for guess in ({"data": b""}, {"offset": 3, "data": b""}, {"offset": size, "data": b""}):
        reply = rig.put(put(data, **guess), run="r-1")
        assert reply == rig.put(msgspec.structs.replace(unknown, **guess), run="r-1") == BlobAck(have=0)
    for claim in ({"size": 0, "data": b""}, {"size": 4, "data": b"fake"}):
        assert rig.put(put(data, **claim), run="r-1").status == "bad_blob"
        assert not rig.uploads.has_sent("r-1", digest)
    assert rig.put(put(data, data=data[:half]), run="r-1") == BlobAck(have=half)
    assert rig.put(put(data, size=half, offset=3, data=b""), run="r-1") == BlobAck(have=half)
    assert not rig.uploads.has_sent("r-1", digest)
    assert rig.put(put(data, offset=half, data=data[half:]), run="r-1") == BlobAck(have=size)
    assert rig.uploads.has_sent("r-1", digest)
    assert not rig.uploads.has_sent("r-2", digest)
    # What it has sent once it need not send again.
    assert rig.put(put(data, data=b""), run="r-1") == BlobAck(have=size)


def test_unclaimed_uploads_of_a_run_are_limited(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attack: uploads bundles that it never submits, until the coordinator's disk is full. Defence: 16
    uploads of 256 MiB together may be named by no submit of the run; they are deleted within a minute
    after it was closed (after a restart of the coordinator, by `evopolicy-coordinator gc`)."""
    monkeypatch.setattr(uploads_module, "MAX_UNCLAIMED", 3)
    monkeypatch.setattr(uploads_module, "MAX_UNCLAIMED_BYTES", 100)
    bundles = [b"a", b"bb", b"ccc", b"dddd"]
    digests = [blob(each).digest for each in bundles]
    for each in bundles[:3]:
        assert rig.put(put(each), run="r-1") == BlobAck(have=len(each))
        assert rig.put(put(each), run="r-1") == BlobAck(have=len(each))  # a repeated one is no further upload
    answer = rig.put(put(bundles[3]), run="r-1")
    assert answer.status == "too_large"
    assert "submit one of them" in answer.message
    assert not rig.blobs.has(digests[3])
    # Another run has its own, and submits make room.
    assert rig.put(put(bundles[3]), run="r-2") == BlobAck(have=4)
    assert rig.put(put(bundles[3]), run="r-1", submitted=digests[:1]) == BlobAck(have=4)
    # The size counts from the first chunk on, and is the largest that was announced.
    small, large = put(b"e" * 99, size=1, data=b"e"), put(b"e" * 99, data=b"e")
    assert rig.put(small, run="r-3").status == "bad_blob"
    assert rig.put(large, run="r-3") == BlobAck(have=1)
    assert rig.put(put(b"ff"), run="r-3").status == "too_large"


def test_what_a_run_has_sent_is_remembered_within_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads_module, "MAX_RUNS", 2)
    monkeypatch.setattr(uploads_module, "MAX_OF_A_RUN", 2)
    uploads = Uploads()
    for run, digest in (("a", "1"), ("a", "2"), ("a", "1"), ("a", "3"), ("b", "1"), ("a", "3"), ("c", "1")):
        uploads.note(run, digest)
    kept = {(run, digest) for run in "abc" for digest in "123" if uploads.has_sent(run, digest)}
    assert kept == {("a", "1"), ("a", "3"), ("c", "1")}


@pytest.mark.parametrize(
    "changes", [{"digest": "../../etc/passwd"}, {"size": -1}, {"size": 1 << 40}, {"digest": "0" * 64}]
)
def test_blob_that_cannot_be_is_refused(rig: Rig, changes: dict[str, Any]) -> None:
    answer = rig.put(put(b"data", **changes))
    assert isinstance(answer, Refused)
    assert answer.status == "bad_blob"


def test_run_gets_only_the_blobs_that_its_train_feedback_names(rig: Rig) -> None:
    named, other = blob(b"named", inline=False), blob(b"other", inline=False)
    rig.blobs.put(b"named")
    rig.blobs.put(b"other")
    rig.store.write(
        [outcome_row(TRAIN, 0, 0, named), outcome_row(records.submit_group("r-1", 0, "heldout"), 0, 0, other)]
    )
    assert rig.get("r-1", named.digest).data == b"named"
    assert rig.get("r-1", other.digest).status == "unknown_blob"
    assert rig.get("r-2", named.digest).status == "unknown_blob"
    assert rig.get(None, other.digest).data == b"other"
    assert rig.get(None, "no digest").status == "unknown_blob"


def test_a_row_that_cannot_be_read_is_reported_as_damaged(rig: Rig) -> None:
    rig.store._db.execute("UPDATE submits SET data = x'00'")
    assert rig.results(0, 1).status == Refusal.DAMAGED
