"""The queue of results that are to be reported to the coordinator.

Rules:
- A result leaves the outbox when the coordinator acknowledges it as durable or refuses it for good. Sending it twice is
  safe.
- A result waits a moment for others as long as leased jobs wait for a slot of this worker: their results follow, and a
  report costs worker and coordinator more than the results in it. The last ones never wait.
- Large parts are uploaded first, as blobs, and their bytes are kept until the result is acknowledged: a coordinator
  restored from a backup may have lost them. It then refuses the result as missing a blob, and they are uploaded again.
- A result that is refused for good is reported as failed, with the reason. If that report is refused too, it is
  dropped, and the coordinator gives the job to another worker. Neither blocks the results behind it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable

import msgspec

from evopolicy_common.errors import ProtocolError, RefusedError
from evopolicy_common.logs import log
from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.worker import (
    REASON_CHARACTERS,
    JobResult,
    ReportResults,
    ResultsReported,
    WorkerReply,
)
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.refusals import NOT_NOW, Refusal
from evopolicy_common.wire import codec
from evopolicy_common.wire.requests import Requester

MAX_RESULTS = 256
"""Waiting results at which the worker stops leasing jobs, so that memory stays bounded while the coordinator is
unreachable."""
MAX_BYTES = 512 << 20
"""The same limit for their total size, in bytes."""
MAX_HAND_IN = 64
MAX_HAND_IN_BYTES = 4 << 20
"""Maximum size of a message with more than one result, in bytes."""
MAX_RESULT_BYTES = 1 << 20
"""A result that is larger than this without its large blobs sends its episodes as one blob."""
FEW_EPISODES, MANY_EPISODES = 8, 300
"""Jobs with at most so many and with more episodes: see `inline_bytes`."""
MAX_LOST = 5
"""How often the coordinator may lose the blobs of one result before that counts as a refusal."""
UNPACK_S = 30.0
"""How long the coordinator may take to read outcomes from a blob before the report is sent again."""
PAUSE_S = 1.0
LINGER_S = 0.05
"""Longest wait of a result for others, seconds. A report and the leases that follow it cost all processes together as
much as a short episode's simulation."""


def inline_bytes(n_episodes: int) -> int:
    """Larger recordings of a job with so many episodes are uploaded as blobs of their own, bytes: all outcomes of a job
    have to fit into one blob, and those of few episodes into a message."""
    if n_episodes <= FEW_EPISODES:
        return codec.INLINE_BYTES
    return 24 << 10 if n_episodes <= MANY_EPISODES else 1 << 10


class Outbox:
    """Accepts results at any time and reports them, oldest first. Used by one asyncio loop."""

    def __init__(
        self,
        ask: Requester[WorkerReply],
        worker: str,
        session: Callable[[], str],
        register_again: Callable[[str, RefusedError], Awaitable[bool]],
        on_settled: Callable[[JobResult], None],
        more_follow: Callable[[], bool],
    ) -> None:
        """`register_again` receives a session and its refusal, and returns whether it registered anew;
        `on_settled` each settled result. `more_follow`: whether leased jobs wait for a slot; call `hurry`
        after each change."""
        self._ask = ask
        self._worker = worker
        self._session = session
        self._register_again = register_again
        self._on_settled = on_settled
        self._results: deque[JobResult] = deque()
        self._n_bytes = 0
        self._more_follow = more_follow
        self._hurried = asyncio.Event()
        self._filled = asyncio.Event()
        self.emptied = asyncio.Event()
        """Set while all results are settled."""
        self.emptied.set()
        self._uploaded: set[str] = set()
        """Digests of waiting results' blobs that are uploaded."""
        self._n_lost = 0
        self._one_by_one = 0
        """How many results are still to be reported one by one, because a batch with them was refused."""

    @property
    def full(self) -> bool:
        """Whether the worker should stop leasing jobs."""
        return len(self._results) >= MAX_RESULTS or self._n_bytes >= MAX_BYTES

    def put(self, result: JobResult) -> None:
        """Queues a result; it is reported after those before it."""
        self._results.append(result)
        self._n_bytes += _n_bytes(result)
        self._filled.set()
        self.emptied.clear()
        self.hurry()

    def hurry(self) -> None:
        """Reports the available results at once where no more follow soon, or where they fill a report."""
        if not self._more_follow() or len(self._results) >= MAX_HAND_IN:
            self._hurried.set()

    async def run(self) -> None:
        """Reports results until cancelled."""
        while True:
            while not self._results:
                self.emptied.set()
                self._filled.clear()
                await self._filled.wait()
            if self._more_follow() and len(self._results) < MAX_HAND_IN:
                self._hurried.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._hurried.wait(), LINGER_S)
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
        """The oldest results that fit into one message, ready to send; their large parts are uploaded."""
        batch: list[JobResult] = []
        size = 0
        for result in [*self._results][: 1 if self._one_by_one else MAX_HAND_IN]:
            try:
                ready, weight = await self._portable(result)
            except (RefusedError, ProtocolError):
                if not batch:
                    raise
                # The error is handled once this result is the oldest.
                break
            if batch and size + weight > MAX_HAND_IN_BYTES:
                break
            batch.append(ready)
            size += weight
        return batch

    async def _portable(self, result: JobResult) -> tuple[JobResult, int]:
        """The result with its large parts replaced by digests, and its encoded size in bytes."""
        most = inline_bytes(len(result.episodes))
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
        """The blob as a message refers to it; uploads it and drops its bytes when it is larger than `most` bytes."""
        if blob is None or blob.inline is None or blob.size <= most:
            return blob
        if blob.digest not in self._uploaded:
            await self._ask.upload(self._worker, self._session(), blob.digest, blob.inline)
            self._uploaded.add(blob.digest)
        return msgspec.structs.replace(blob, inline=None)

    async def _refused(self, error: RefusedError, session: str, n: int) -> None:
        if await self._register_again(session, error):
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
        """Handles a refusal of the oldest `n` results. Several are sent again one by one; a single one is reported as
        failed, or dropped when it was such a report."""
        if n > 1:
            self._one_by_one = n
            return
        result = self._results[0]
        log.error("result refused for good", lease=result.lease_id, kind=result.kind, why=why)
        if result.kind == "failed" and not result.episodes:
            self._settle()
            return
        report = JobResult(
            lease_id=result.lease_id,
            job_id=result.job_id,
            attempt=result.attempt,
            kind="failed",
            error=f"its result was refused: {why}"[: REASON_CHARACTERS["result"]],
        )
        self._n_bytes += _n_bytes(report) - _n_bytes(result)
        self._results[0] = report
        self._n_lost = 0
        self._one_by_one = max(1, self._one_by_one)

    def _settle(self) -> None:
        """Removes the oldest result."""
        result = self._results.popleft()
        self._n_bytes -= _n_bytes(result)
        self._n_lost = 0
        self._one_by_one = max(0, self._one_by_one - 1)
        if not self._results:
            self._uploaded.clear()
        self._on_settled(result)


def _n_bytes(result: JobResult) -> int:
    """Approximate size of a result in bytes: its bulky parts, and 1000 for the rest."""
    size = 1000 + (0 if result.begun is None else result.begun.size)
    for outcome in result.episodes:
        size += len(outcome.stdout) + len(outcome.stderr)
        size += sum(len(ref.inline or b"") for ref in (outcome.trajectory, outcome.video) if ref is not None)
    return size
