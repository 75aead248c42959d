"""Replies that are read from the store or the blob folder on threads of their own, and sent from there.

Rules that this module owns:
- A gateway's page contains train outcomes of its own run only. Fields of `EpisodeOutcome` that `EpisodeFeedback`
  lacks (wall times, CPU) are not sent.
- A page never exceeds `MAX_PAGE_BYTES` (unless one episode does), so that no reply blocks its lane for long.
- One thread writes the chunks of one blob, in order.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

from evopolicy_common.errors import (
    DamagedStoreError,
    LeadLostError,
    ProtocolError,
    RefusedError,
    StorageError,
)
from evopolicy_common.logs import log
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.gateway import EpisodeFeedback, ResultsPage
from evopolicy_common.messages.operator import (
    EvaluationPage,
    JournalPage,
    JournalRequest,
    OpeningRequest,
    RecordedRequest,
    RunFinished,
    RunOpening,
    RunProgress,
    Signed,
    SignRequest,
)
from evopolicy_common.messages.run_settings import Start
from evopolicy_common.messages.worker import BlobAck, BlobChunk, BlobGet, BlobPut, Message, Refused
from evopolicy_common.records import journal
from evopolicy_common.records.blobs import BlobStore, FileState, digest_of, is_digest
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec
from evopolicy_common.wire.transport import IncomingQuery
from evopolicy_coordinator.core.contract import records
from evopolicy_coordinator.core.contract.effects import ReadEvaluation, ReadFinished, ReadResults
from evopolicy_coordinator.core.contract.records import (
    DocumentRow,
    JournalRow,
    OutcomeRow,
    RunRow,
    RunStateRow,
    SubmitRow,
)
from evopolicy_coordinator.pki import identity
from evopolicy_coordinator.server.reason_texts import env_failure, operator_words, reason_text
from evopolicy_coordinator.server.request_checks import MAX_COUNT, finite_cursor, require
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.storage.engines import Place
from evopolicy_coordinator.storage.store import Reader

MAX_PAGE_BYTES = 1 << 20
_READERS = 2
_BLOB_LANES = 4
_NO_BYTES = BlobRef(digest=digest_of(b""), size=0, inline=b"")

Answer = Callable[[Message | None], None]
"""Sends the reply, from any thread; None ends the query without one, so that the client retries."""


class ServiceReader:
    """Reads pages and blobs. The methods that take an `Answer` return at once; a thread sends the reply later.
    Those that read the database at once raise DamagedStoreError when a row cannot be read."""

    def __init__(self, database: Place, blobs: BlobStore, uploads: Uploads, state: Path) -> None:
        self.state = state
        self.storage_error = ""
        """Why the last chunk of a blob could not be written; empty: it was."""
        self._database = database
        self.blobs = blobs
        self._uploads = uploads
        self._local = threading.local()
        self._pages = ThreadPoolExecutor(_READERS, thread_name_prefix="pages")
        self._lanes = [ThreadPoolExecutor(1, thread_name_prefix=f"blobs-{n}") for n in range(_BLOB_LANES)]

    def answer_read(self, asked: object, answer: Answer) -> None:
        """Replies to a `ReadEffect` of the core or an operator's request (`_READS`): with a page of results,
        outcomes of a finished run, published records of runs whose cases are disclosed, or a signature."""
        self._pages.submit(self._answer, partial(_READS[type(asked)], self, asked), answer)

    def put(
        self,
        sender: str,
        run: str | None,
        message: BlobPut,
        max_bytes: int,
        answer: Answer,
        submitted: Collection[str | None] = (),
    ) -> None:
        """Stores one chunk of a blob of at most `max_bytes`. The caller must check the sender's right to upload.

        With `run`, the gateway's own, the reply does not reveal which bytes others have stored: all bytes are
        requested, then recorded. `submitted`: the bundles that its submits name.
        """
        self._lane(message.digest).submit(
            self._answer, lambda: self._put(sender, run, message, max_bytes, submitted), answer
        )

    def drop_uploads(self, over: Callable[[str], bool]) -> None:
        """Deletes the uploads of runs that are over, except those that a stored submit names or others have stored."""
        for run, stored in self._uploads.forget(over).items():
            self._lanes[0].submit(self.blobs.drop_unfinished, f"gw/{run}")
            for digest, state in stored.items():
                self._lane(digest).submit(self._drop, run, digest, state)

    def get(self, run: str | None, message: BlobGet, answer: Answer) -> None:
        """Sends one chunk of a blob; with `run`, only if this run's train feedback names the blob."""
        self._lane(message.digest).submit(self._answer, lambda: self._get(run, message), answer)

    def epochs(self, runs: tuple[str, ...]) -> tuple[str, ...]:
        """The distinct epochs of finished runs that are to be published. Reads the database.

        Raises RefusedError for a run that is unknown or unfinished.
        """
        rows = {run: self.finished_run(run) for run in runs}
        for run, row in rows.items():
            if row is None:
                raise RefusedError(Refusal.UNKNOWN_RUN, f"there is no finished run {run[:64]!r} here")
        return tuple(dict.fromkeys(row.epoch for row in rows.values() if row is not None))

    def finished_with_result(self, run: str) -> tuple[RunRow, RunFinished]:
        """A finished run and its result. Reads the database. Raises RefusedError for any other run."""
        row = self.finished_run(run)
        result = None if row is None else self._reader.finished(run)
        if row is None or result is None:
            raise RefusedError(
                Refusal.UNKNOWN_RUN,
                f"there is no finished run {run[:64]!r} here: it is still open, or another coordinator played it",
            )
        return row, result

    def result(self, run: str) -> bytes:
        """A finished run's result as a document. Reads the database. Raises RefusedError for any other run."""
        return journal.document(self.finished_with_result(run)[1].result)

    def revealed(self) -> frozenset[str]:
        """Epochs whose cases are public. Reads the database."""
        return self._reader.revealed()

    def finished_run(self, run: str) -> RunRow | None:
        """A finished run as it was created; None for any other run. Reads the database."""
        return self._reader.one(RunRow, run=run) if run and self._reader.finished(run) is not None else None

    def parent(self, start: Start) -> tuple[RunRow | None, SubmitRow | None, RunStateRow | None]:
        """The run and the submit that `start` names, and that run's state; None for an unknown one. Reads the
        database."""
        submit = self._reader.one(SubmitRow, run=start.run, submit_index=start.submit_index)
        state = self._reader.one(RunStateRow, run=start.run)
        return self._reader.one(RunRow, run=start.run), submit, state

    def replayed(self, run: str) -> RunRow | None:
        """The finished run that is to be played again; None for none and for an unknown one. Reads the database. Raises
        RefusedError for an open run."""
        finished = self.finished_run(run)
        if run and finished is None and self._reader.one(RunRow, run=run) is not None:
            text = f"run {run[:64]} is open; only a finished run is replayed: wait until it is scored, or cancel it"
            raise RefusedError(Refusal.BUSY, text)
        return finished

    def close(self) -> None:
        for pool in (self._pages, *self._lanes):
            pool.shutdown(wait=True, cancel_futures=True)

    def _lane(self, digest: str) -> ThreadPoolExecutor:
        return self._lanes[crc32(digest.encode()) % _BLOB_LANES]

    def _answer(self, work: Callable[[], Message], answer: Answer) -> None:
        try:
            answer(work())
        except (DamagedStoreError, RefusedError) as error:
            refused = damaged(error) if isinstance(error, DamagedStoreError) else error
            answer(Refused(status=refused.status, message=refused.message))
        except StorageError as error:
            # Our own fault: the client retries.
            log.error("cannot answer from the store", error=str(error))
            answer(None)
        except Exception:
            log.exception("cannot answer")
            answer(None)

    def _drop(self, run: str, digest: str, stored: FileState) -> None:
        try:
            if digest not in self._reader.bundles(run):
                self.blobs.delete(digest, stored)
        except StorageError as error:
            log.error("an upload stays until `evopolicy-coordinator gc`", run=run, error=str(error))

    @property
    def _reader(self) -> Reader:
        if not hasattr(self._local, "reader"):
            self._local.reader = Reader(self._database)
        reader: Reader = self._local.reader
        return reader

    def _finished(self, effect: ReadFinished) -> Message:
        finished = self._reader.finished(effect.run)
        if finished is None:
            raise RefusedError(Refusal.UNKNOWN_RUN, f"run {effect.run!r} has no outcome")
        done = len(finished.heldout_returns)
        return RunProgress(phase="finished", done=done, total=done, finished=finished)

    def _results(self, effect: ReadResults) -> Message:
        row = self._reader.one(SubmitRow, run=effect.run, submit_index=effect.submit_index)
        if row is None:
            raise RefusedError(Refusal.UNKNOWN_SUBMIT, f"this run has no submit {effect.submit_index}")
        # The row may have changed since the core's request. An end is reported with all episodes that belong before
        # it.
        upto = row.released if effect.upto is None or row.status is not None else effect.upto
        group = records.submit_group(effect.run, effect.submit_index, "train")
        page = self._reader.outcomes(group, effect.cursor, upto, MAX_PAGE_BYTES)
        after = _after(page, effect.cursor)
        return ResultsPage(
            cursor=after,
            episodes=tuple(feedback(each.outcome) for each in page),
            done=records.submit_done(row) if after >= upto else None,
            waits_for=reason_text(effect.waits_for),
            held_s=effect.held_s,
            more=bool(page) and after < upto,
        )

    def _evaluation(self, effect: ReadEvaluation) -> Message:
        group = records.evaluation_group(effect.evaluation)
        page = self._reader.outcomes(group, effect.cursor, effect.upto, MAX_PAGE_BYTES)
        after = _after(page, effect.cursor)
        return EvaluationPage(
            cursor=after,
            total=effect.total,
            outcomes=tuple(each.outcome for each in page),
            # A cancelled one has fewer outcomes than cases, and after a restart only the cases are counted.
            finished=effect.finished and (after >= effect.upto or not page),
            waits_for=operator_words(effect.waits_for),
            env_failure=env_failure(effect.waits_for),
        )

    def _recorded(self, message: RecordedRequest) -> Message:
        run, index, cursor = message.run, message.submit_index, finite_cursor(message.cursor)
        finished = self._reader.finished(run) is not None
        require(finished, Refusal.UNKNOWN_RUN, f"there is no finished run {run[:64]!r} here")
        group = records.random_group(run) if index < 0 else records.submit_group(run, index, message.split)
        page = self._reader.outcomes(group, cursor, MAX_COUNT, MAX_PAGE_BYTES)
        after = _after(page, cursor)
        outcomes = tuple(each.outcome for each in page)
        return EvaluationPage(cursor=after, total=after, outcomes=outcomes, finished=not page)

    def _journal(self, message: JournalRequest) -> Message:
        cursor = finite_cursor(message.cursor)
        rows = self._reader.journal(cursor, MAX_PAGE_BYTES)
        entries = tuple(row.entry for row in rows)
        return JournalPage(cursor=_after(rows, cursor), entries=entries, finished=not rows)

    def _opening(self, message: OpeningRequest) -> Message:
        row = self.finished_run(message.run)
        opening, result = (
            self._reader.one(DocumentRow, run=message.run, kind=kind) for kind in ("opening", "result")
        )
        if row is None or opening is None or result is None:
            text = f"there is no finished run {message.run[:64]!r} here that was committed to"
            raise RefusedError(Refusal.UNKNOWN_RUN, text)
        text = f"the cases of run {row.run} are not disclosed; publish it first"
        require(row.epoch in self._reader.revealed(), Refusal.BAD_REQUEST, text)
        return RunOpening(salt=row.salt, opening=opening.data, result=result.data)

    def _sign(self, message: SignRequest) -> Message:
        text = f"{message.digest[:80]!r} is no SHA-256 digest"
        require(is_digest(message.digest), Refusal.BAD_REQUEST, text)
        key, signature = identity.sign(self.state, message.digest)
        return Signed(key=key, signature=signature)

    def _put(
        self,
        sender: str,
        run: str | None,
        message: BlobPut,
        max_bytes: int,
        submitted: Collection[str | None],
    ) -> Message:
        text = f"{message.digest[:80]!r} is no SHA-256 digest"
        require(is_digest(message.digest), Refusal.BAD_BLOB, text)
        text = f"blob of {message.size:,} bytes, {max_bytes:,} are allowed"
        require(0 <= message.size <= max_bytes, Refusal.BAD_BLOB, text)
        if run is not None:
            self._uploads.begin(run, message.digest, message.size, submitted)
        on_whole = None
        if run is not None and not self._uploads.has_sent(run, message.digest):
            on_whole = partial(self._uploads.note, run, message.digest)
        try:
            have = self.blobs.append_chunk(
                sender, message.digest, message.size, message.offset, message.data, on_whole
            )
        except StorageError as error:
            if error.__cause__ is not None or isinstance(error, LeadLostError):  # our own fault
                self.storage_error = str(error)
                raise
            raise RefusedError(Refusal.BAD_BLOB, str(error)) from error
        self.storage_error = ""
        return BlobAck(have=have)

    def _get(self, run: str | None, message: BlobGet) -> Message:
        known = is_digest(message.digest) and (run is None or self._reader.names_blob(run, message.digest))
        text = f"no blob {message.digest[:80]!r} here"
        require(known and self.blobs.has(message.digest), Refusal.UNKNOWN_BLOB, text)
        if message.direct and message.offset == 0 and (address := self.blobs.address(message.digest)):
            return BlobChunk(size=self.blobs.size(message.digest), data=b"", address=address)
        data = self.blobs.read_chunk(message.digest, max(0, message.offset), codec.CHUNK_BYTES)
        return BlobChunk(size=self.blobs.size(message.digest), data=data)


_READS: dict[type, Callable[[ServiceReader, Any], Message]] = {
    ReadResults: ServiceReader._results,
    ReadEvaluation: ServiceReader._evaluation,
    ReadFinished: ServiceReader._finished,
    RecordedRequest: ServiceReader._recorded,
    JournalRequest: ServiceReader._journal,
    OpeningRequest: ServiceReader._opening,
    SignRequest: ServiceReader._sign,
}


def _after(rows: Sequence[OutcomeRow | JournalRow], cursor: int) -> int:
    return rows[-1].seq + 1 if rows else cursor


def feedback(outcome: EpisodeOutcome) -> EpisodeFeedback:
    """The part of a train episode's outcome that an agent may see."""
    return EpisodeFeedback(
        index=outcome.index,
        episode_return=outcome.episode_return,
        length=outcome.length,
        failure=outcome.failure,
        reward_components=outcome.reward_components,
        trajectory=outcome.trajectory or _NO_BYTES,
        video=outcome.video,
        stdout=outcome.stdout,
        stderr=outcome.stderr,
        success=outcome.success,
    )


def damaged(error: DamagedStoreError) -> RefusedError:
    """The refusal for a row that cannot be read: retrying does not help. Logs the row's name."""
    log.error("the store cannot be read", error=str(error))
    text = (
        "the stored data of this request cannot be read; the coordinator's log names the row and the remedy"
    )
    return RefusedError(Refusal.DAMAGED, text)


def lane_of(asker: str) -> int:
    """Lane of a client's replies: those to one client are sent in order."""
    return crc32(asker.encode())


def answer_bytes(message: Message) -> bytes:
    """Encodes a reply. One that is too large to send becomes a refusal, or its client would retry for ever."""
    try:
        return codec.encode(message)
    except ProtocolError as error:
        log.error("reply too large", error=str(error))
        return codec.encode(Refused(status=Refusal.TOO_LARGE, message=str(error)))


def answer_to(query: IncomingQuery, asker: str) -> Answer:
    """Returns a function that replies to the query, or ends it without a reply."""

    def answer(message: Message | None) -> None:
        if message is None:
            query.drop()
        else:
            query.reply(answer_bytes(message), lane_of(asker))

    return answer
