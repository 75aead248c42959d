"""Results on their way to the coordinator.

Rules:
- A result leaves the outbox when the coordinator answered that it is durable, or has refused it for good. Sending it
  twice is safe.
- What is large goes first, as blobs, and its bytes are kept until the result is answered: a coordinator that was
  restored from a backup has lost what it had, says so, and gets them again.
- A result that is refused for good is reported as failed, with the reason; when that is refused too, it is dropped, and
  the coordinator gives the job to another worker. Neither holds up the results behind it.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

import msgspec
import structlog

from evopolicy_common.errors import ProtocolError, RefusedError
from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.worker import JobResult, ReportResults, ResultsReported, WorkerReply
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.wire import codec
from evopolicy_common.wire.refusals import NOT_NOW, Refusal
from evopolicy_common.wire.requests import Requester

log: structlog.stdlib.BoundLogger = structlog.get_logger()

MAX_RESULTS = 256
"""Results that wait before the slots stop taking jobs: a coordinator that is away must not fill memory."""
MAX_BYTES = 512 << 20
"""The same for what they hold, in bytes."""
MAX_HAND_IN = 64
MAX_HAND_IN_BYTES = 4 << 20
"""A message with more than one result is no larger."""
MAX_RESULT_BYTES = 1 << 20
"""Episodes that take more, without their large blobs, go as a blob themselves."""
MANY_EPISODES = 300
"""Of a job with more, recordings of more than 1 KiB go as blobs too, so that its outcomes fit into one."""
MAX_LOST = 5
"""So often the coordinator may lose what was uploaded for one result before that counts as a refusal."""
UNPACK_S = 30.0
"""What the coordinator may take to read outcomes from a blob before it is asked again."""
PAUSE_S = 1.0


class Outbox:
    """Takes results at any time and hands them in, oldest first. Used by one asyncio loop."""

    def __init__(
        self,
        ask: Requester[WorkerReply],
        worker: str,
        session: Callable[[], str],
        register_again: Callable[[str], Awaitable[None]],
        on_settled: Callable[[JobResult], None],
    ) -> None:
        """`register_again` is told the session that the coordinator did not know; `on_settled` each result that left."""
        self._ask = ask
        self._worker = worker
        self._session = session
        self._register_again = register_again
        self._on_settled = on_settled
        self._results: deque[JobResult] = deque()
        self._n_bytes = 0
        self._filled = asyncio.Event()
        self._emptied = asyncio.Event()
        self._emptied.set()
        self._uploaded: set[str] = set()
        """Blobs of waiting results that the coordinator has."""
        self._n_lost = 0
        self._one_by_one = 0
        """So many results are reported alone, since one of them was refused."""

    @property
    def full(self) -> bool:
        """Whether no more work should be taken on."""
        return len(self._results) >= MAX_RESULTS or self._n_bytes >= MAX_BYTES

    def put(self, result: JobResult) -> None:
        """Hand it in as soon as those before it are answered."""
        self._results.append(result)
        self._n_bytes += _n_bytes(result)
        self._filled.set()
        self._emptied.clear()

    async def wait_empty(self) -> None:
        """Returns when everything was reported."""
        await self._emptied.wait()

    async def run(self) -> None:
        """Hands in for as long as it is not cancelled."""
        while True:
            while not self._results:
                self._emptied.set()
                self._filled.clear()
                await self._filled.wait()
            session = self._session()
            n = 1
            try:
                batch = await self._batch()
                n = len(batch)
                message = ReportResults(worker=self._worker, session=session, results=tuple(batch))
                wait_s = UNPACK_S if any(result.packed for result in batch) else 0.0
                await self._ask.until_answered("done", message, ResultsReported, wait_s=wait_s)
            except RefusedError as error:
                await self._refused(error, session, n)
            except ProtocolError as error:
                self._refused_for_good(str(error), n)
            else:
                for _ in range(n):
                    self._settle()

    async def _batch(self) -> list[JobResult]:
        """The oldest results as they can be sent, their large parts uploaded; of several, no more than fit together."""
        batch: list[JobResult] = []
        size = 0
        for result in list(self._results)[: 1 if self._one_by_one else MAX_HAND_IN]:
            try:
                ready, weight = await self._portable(result)
            except (RefusedError, ProtocolError):
                if not batch:
                    raise
                # Told when it is the first.
                break
            if batch and size + weight > MAX_HAND_IN_BYTES:
                break
            batch.append(ready)
            size += weight
        return batch

    async def _portable(self, result: JobResult) -> tuple[JobResult, int]:
        """The result with its large parts by digest, and its size in bytes."""
        most = codec.INLINE_BYTES if len(result.episodes) <= MANY_EPISODES else 1024
        outcomes = [
            msgspec.structs.replace(
                outcome,
                trajectory=await self._by_digest(outcome.trajectory, most),
                video=await self._by_digest(outcome.video, most),
            )
            for outcome in result.episodes
        ]
        begun = await self._by_digest(result.begun, codec.INLINE_BEGUN_BYTES)
        ready = msgspec.structs.replace(result, episodes=tuple(outcomes), begun=begun)
        weight = len(msgspec.msgpack.encode(ready))
        if weight <= MAX_RESULT_BYTES:
            return ready, weight
        data = codec.pack_outcomes(ready.episodes)
        packed = await self._by_digest(BlobRef(digest=digest_of(data), size=len(data), inline=data), 0)
        return msgspec.structs.replace(ready, episodes=(), packed=packed), 1000

    async def _by_digest(self, blob: BlobRef | None, most: int) -> BlobRef | None:
        """The blob as it is named in a message, its bytes uploaded if there are more than `most`."""
        if blob is None or blob.inline is None or blob.size <= most:
            return blob
        if blob.digest not in self._uploaded:
            await self._ask.upload(self._worker, self._session(), blob.digest, blob.inline)
            self._uploaded.add(blob.digest)
        return msgspec.structs.replace(blob, inline=None)

    async def _refused(self, error: RefusedError, session: str, n: int) -> None:
        if error.status == Refusal.UNKNOWN_WORKER:
            await self._register_again(session)
            return
        if error.status == Refusal.MISSING_BLOB and self._n_lost < MAX_LOST:
            log.warning("the coordinator has lost what was uploaded; sending it again", why=error.message)
            self._n_lost += 1
            self._uploaded.clear()
        elif error.status in NOT_NOW:
            log.error("results not taken; trying again", status=error.status, why=error.message)
        else:
            self._refused_for_good(error.message, n)
            return
        await asyncio.sleep(PAUSE_S)

    def _refused_for_good(self, why: str, n: int) -> None:
        """Finds out which of `n` results it is; that one is reported as failed, or dropped when it is already."""
        if n > 1:
            self._one_by_one = n
            return
        result = self._results[0]
        log.error("result refused for good", lease=result.lease_id, kind=result.kind, why=why)
        self._settle(told=False)
        told = JobResult(
            lease_id=result.lease_id,
            job_id=result.job_id,
            attempt=result.attempt,
            kind="failed",
            error=f"its result was refused: {why}"[:2000],
        )
        if result.kind == "failed" and not result.episodes:
            self._on_settled(result)
        else:
            self._results.appendleft(told)
            self._n_bytes += _n_bytes(told)
            self._one_by_one += 1

    def _settle(self, *, told: bool = True) -> None:
        """The oldest result has left."""
        result = self._results.popleft()
        self._n_bytes -= _n_bytes(result)
        self._n_lost = 0
        self._one_by_one = max(0, self._one_by_one - 1)
        if not self._results:
            self._uploaded.clear()
        if told:
            self._on_settled(result)


def _n_bytes(result: JobResult) -> int:
    """Bytes of what is bulky in it."""
    begun = 0 if result.begun is None else result.begun.size
    return (
        1000
        + begun
        + sum(
            len(outcome.stdout)
            + len(outcome.stderr)
            + sum(len(ref.inline or b"") for ref in (outcome.trajectory, outcome.video) if ref is not None)
            for outcome in result.episodes
        )
    )
