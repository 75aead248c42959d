"""The worker's supervisor: registers, leases jobs, passes them to its slots, and reports the results.

Rules:
- A lease is held from its arrival until its result is acknowledged. Every heartbeat lists all held leases, so that a
  restarted coordinator can adopt them.
- A result stays in the outbox until the coordinator acknowledges it as durable (`outbox`). Sending it twice is safe.
- Jobs leased with `stop_in_silence` are stopped once no heartbeat has been answered for the lease TTL. Some time later
  the coordinator may let an agent onto this kernel.
- A job that is returned unfinished includes what its policy has returned so far. The next attempt resumes from there.
- A slot that is killed from outside loses only its current job, which is played again. Anything that a policy can do to
  its slot is an outcome of its job (`endings`).
- On SIGTERM the worker stops requesting leases and returns waiting jobs. Running jobs may finish within the grace time.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import time
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import msgspec

from evopolicy_common.catalogue import installs
from evopolicy_common.errors import (
    BrokenEnvironmentError,
    EvopolicyError,
    PartFailedError,
    RefusedError,
    TransportError,
)
from evopolicy_common.logs import log
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, Tier
from evopolicy_common.messages.worker import (
    REASON_CHARACTERS,
    Fingerprint,
    HeartbeatReply,
    HeldLease,
    JobResult,
    Lease,
    LeaseRequest,
    Leases,
    Refused,
    Register,
    Registered,
    ResultKind,
    WorkerReply,
)
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.policies import bundles
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec, keys
from evopolicy_common.wire.requests import Requester
from evopolicy_common.wire.transport import Link
from evopolicy_worker.capabilities import Capabilities
from evopolicy_worker.heartbeat import HeartbeatThread
from evopolicy_worker.outbox import Outbox
from evopolicy_worker.slot_protocol.begun import HandedBack
from evopolicy_worker.slots.slot import Slot

LEASE_POLL_S = 10.0
RESTART_PAUSE_S = 1.0
LONGEST_RESTART_PAUSE_S = 30.0
CANCEL_TIMEOUT_S = 2.0
"""How long the worker waits, when it exits, for slots to stop their cancelled jobs."""
WITHDRAW_TIMEOUT_S = 1.0
SILENCE_CHECK_S = 0.5
MAX_PREPARED = 4
"""A worker that offers at most this many environments has its slots import all their simulators before work arrives."""


class WorkerOptions(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    slots: int
    fingerprint: Fingerprint
    host: str
    boot_id: str = ""
    """Boot id of this kernel. Empty: unknown; this worker gets no hidden episodes."""
    scratch: Path
    grace_s: float = 10.0
    """How long running episodes may continue after SIGTERM."""


class Supervisor:
    """One worker: `run()` works until `drain()` is called."""

    def __init__(
        self,
        link: Link,
        options: WorkerOptions,
        capabilities: Capabilities,
        make_slot: Callable[[int, Tier], Slot],
    ) -> None:
        self._link = link
        self._options = options
        self._capabilities = capabilities
        self._make_slot = make_slot
        cluster = link.credentials.cluster
        self._ask: Requester[WorkerReply] = Requester(
            link, lambda verb: keys.worker_key(cluster, verb), codec.worker_replies
        )
        self._failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._heartbeat = HeartbeatThread(
            link, options.name, self._on_heartbeat_reply, lambda error: self._fail("the heartbeat", error)
        )
        self._bundles = BundleCache(options.scratch / "bundles", self._fetch)
        self._queue: OrderedDict[str, Lease] = OrderedDict()
        self._work_arrived = asyncio.Event()
        self._capacity_freed = asyncio.Event()
        self._outbox = Outbox(
            self._ask,
            options.name,
            lambda: self._session,
            self._register_again,
            self._settled,
            more_follow=lambda: bool(self._queue),
        )
        self._running: dict[str, tuple[Lease, Slot]] = {}
        self._cancelled: set[str] = set()
        """Ids of running leases."""
        self._session = self._token = ""
        self._lease_ttl_s = 0.0
        self._registering = asyncio.Lock()
        self.draining = asyncio.Event()
        self._warm_environments: OrderedDict[str, None] = OrderedDict()
        self.jobs_done = 0

    async def run(self) -> None:
        """Works until drained.

        Raises RefusedError when the coordinator refuses this worker, and PartFailedError when the heartbeat or the
        reporting of results fails: without either, the worker would only hold jobs that others could play.
        """
        await self._register()
        self._link.declare_alive(keys.liveliness_key(self._link.credentials.cluster, self._options.name))
        # The reporting task outlives the others, so that finished results are reported before the worker exits.
        report_results = asyncio.create_task(self._report())
        working = asyncio.create_task(self._work())
        trying = asyncio.create_task(self._capabilities.keep_trying(self._register))
        try:
            await asyncio.wait([working, self._failed], return_when=asyncio.FIRST_COMPLETED)
            await (self._failed if self._failed.done() else working)
        finally:
            self._heartbeat.stop()
            await _ended(working, report_results, trying)
            self._failed.cancel()

    async def _report(self) -> None:
        try:
            await self._outbox.run()
        except Exception as error:
            self._fail("reporting", error)

    def _fail(self, part: str, error: BaseException) -> None:
        log.error("a part of the worker failed", part=part, exc_info=error)
        if not self._failed.done():
            self._failed.set_exception(PartFailedError(f"{part} failed: {type(error).__name__}: {error}"))

    async def _work(self) -> None:
        """Leases and plays until drained, and waits until the results are reported. A refusal by the coordinator stops
        all running jobs, as their results are worthless."""
        refused: BaseException | None = None
        try:
            async with asyncio.TaskGroup() as group:
                lease = group.create_task(self._lease_loop())
                slots = [group.create_task(self._slot_loop(index)) for index in range(self._options.slots)]
                silence = group.create_task(self._stop_in_silence())
                await self.draining.wait()
                await self._give_back(lease, slots)
                silence.cancel()
        except* RefusedError as errors:
            refused = errors
        while isinstance(refused, BaseExceptionGroup):
            refused = refused.exceptions[0]
        if refused is not None:
            raise refused
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._outbox.emptied.wait(), self._options.grace_s)

    def drain(self) -> None:
        """Stops requesting leases; `run` returns when the running jobs are done or the grace time is over."""
        self.draining.set()
        self._work_arrived.set()
        self._capacity_freed.set()

    async def _register(self) -> None:
        async with self._registering:
            options, credentials, able = self._options, self._link.credentials, self._capabilities
            missing_tiers, failed_environments = able.reasons()
            message = Register(
                worker=options.name,
                token=credentials.token,
                protocol=codec.WIRE_VERSION,
                slots=options.slots,
                fingerprint=options.fingerprint,
                host=options.host,
                boot_id=options.boot_id,
                installation=installs.own(),
                tiers=able.tiers,
                missing_tiers=missing_tiers,
                environments=able.environments,
                undescribed=able.undescribed,
                failed_environments=failed_environments,
            )
            reply = await self._ask.until_answered("register", message, Registered)
            self._session, self._lease_ttl_s, self._token = reply.session, reply.lease_ttl_s, message.token
            self._heartbeat.start(reply.session, reply.heartbeat_s)
            log.info("registered", worker=options.name, cluster=credentials.cluster, slots=options.slots)
            for run, why in reply.refused.items():
                log.warning("gets no work of a run", run=run, why=why)
            for env, why in reply.refused_environments.items():
                log.warning("the coordinator rejected this environment", env=env, why=why)

    async def _register_again(self, session: str, error: RefusedError) -> bool:
        """Registers anew where the session has ended. Returns False for a refusal that this does not help against."""
        if error.status not in (Refusal.UNKNOWN_WORKER, Refusal.REVOKED):
            return False
        if session != self._session:
            return True  # registered meanwhile: the refused request was sent before
        if error.status == Refusal.REVOKED and not await self._link.renewed(self._token):
            return False
        if session == self._session:
            log.info("this session has ended; registering again", why=error.message)
            await self._register()
        return True

    def _on_heartbeat_reply(self, reply: HeartbeatReply | Refused) -> None:
        if isinstance(reply, Refused):
            # The lease loop meets the same refusal and registers again.
            return
        for lease_id in reply.cancelled:
            self._cancel(lease_id)
        if reply.drain and not self.draining.is_set():
            log.info("draining on request")
            self.drain()
        self._capabilities.describe_wanted(reply.describe)

    def _cancel(self, lease_id: str) -> None:
        """Returns the waiting job, or stops the running one, of a lease that this worker no longer holds."""
        if lease_id in self._queue:
            log.info("lease is gone", lease=lease_id, was="waiting")
            self._put_result(self._queue.pop(lease_id), "returned")
            self._capacity_freed.set()
        elif lease_id in self._running and lease_id not in self._cancelled:
            log.info("lease is gone", lease=lease_id, was="running")
            self._cancelled.add(lease_id)
            _, slot = self._running[lease_id]
            asyncio.create_task(slot.cancel()).add_done_callback(_log_failure)

    # Leasing.

    async def _lease_loop(self) -> None:
        """Keeps a poll waiting at the coordinator while at most half of the jobs leased ahead still wait. So
        slots never wait for a round trip, and short episodes still arrive in batches."""
        depth = 0
        while not self.draining.is_set():
            self._capacity_freed.clear()
            slots = self._options.slots
            if len(self._queue) > max(slots, depth // 2) or self._outbox.full:
                await self._capacity_freed.wait()
                continue
            session, serial = self._session, self._heartbeat.settled + 1
            request = LeaseRequest(
                worker=self._options.name,
                session=session,
                n=max(1, 2 * slots - len(self._queue) - len(self._running)),
                wait_s=LEASE_POLL_S,
                warm_bundles=self._bundles.warm[-8:],
                warm_environments=tuple(self._warm_environments),
                serial=serial,
            )
            try:
                reply = await self._ask.until_answered("lease", request, Leases, wait_s=LEASE_POLL_S)
            except RefusedError as error:
                self._heartbeat.settled = serial
                if not await self._register_again(session, error):
                    raise
                continue
            for lease_id in reply.cancelled:
                self._cancel(lease_id)
            for lease in reply.leases:
                self._queue[lease.lease_id] = lease
                self._hold(lease, running=False)
            self._heartbeat.settled = serial
            for lease_id in reply.cancelled:
                self._cancel(lease_id)
            if reply.leases:
                depth = len(self._queue)
            self._work_arrived.set()

    # Playing.

    async def _slot_loop(self, index: int) -> None:
        slot = await self._prepared(index)
        tier: Tier | None = self._capabilities.tiers[0]
        pause = RESTART_PAUSE_S
        try:
            while (lease := await self._next_lease()) is not None:
                if slot is not None and tier != lease.job.tier:
                    await slot.close()
                    slot = None
                if slot is None:
                    slot, tier = await self._start_slot(index, lease), lease.job.tier
                    if slot is None:
                        await asyncio.sleep(pause)
                        pause = min(pause * 2, LONGEST_RESTART_PAUSE_S)
                        continue
                    pause = RESTART_PAUSE_S
                if not await self._play(slot, lease):
                    await _close_slot(slot)
                    slot = None
        finally:
            if slot is not None:
                await _close_slot(slot)

    async def _prepared(self, index: int) -> Slot | None:
        """A slot of the safest tier with its simulators imported before work arrives, so that the first
        submit need not wait. None when that fails (the first lease reports the same failure), or when the
        worker is drained."""
        offered = [*(each.env for each in self._capabilities.environments), *self._capabilities.undescribed]
        slot = self._make_slot(index, self._capabilities.tiers[0])
        preparing = asyncio.create_task(slot.prepare(offered if len(offered) <= MAX_PREPARED else ()))
        drained = asyncio.create_task(self.draining.wait())
        try:
            await asyncio.wait({preparing, drained}, return_when=asyncio.FIRST_COMPLETED)
            if preparing.done():
                preparing.result()
                return slot
        except (EvopolicyError, OSError) as error:
            log.info("slot is not prepared", slot=index, error=str(error))
        finally:
            await _ended(preparing, drained)
        await _close_slot(slot)
        return None

    async def _next_lease(self) -> Lease | None:
        while not self.draining.is_set():
            if self._queue:
                _, lease = self._queue.popitem(last=False)
                self._outbox.hurry()
                return lease
            self._work_arrived.clear()
            await self._work_arrived.wait()
        return None

    async def _start_slot(self, index: int, lease: Lease) -> Slot | None:
        """A slot for the lease's tier. None when it does not start; the lease is then reported as failed."""
        slot = self._make_slot(index, lease.job.tier)
        try:
            await slot.start()
            return slot
        except (EvopolicyError, OSError) as error:
            log.error("slot failed to start", slot=index, tier=lease.job.tier, error=str(error))
            await _close_slot(slot)
            self._put_result(lease, "failed", error=f"slot does not start: {error}")
            return None

    async def _play(self, slot: Slot, lease: Lease) -> bool:
        """Plays one leased job and puts its result into the outbox. Returns False when the slot must be replaced."""
        job = lease.job
        self._running[lease.lease_id] = lease, slot
        self._hold(lease)
        last_reported = 0.0

        def on_progress(episodes_done: int, steps: int) -> None:
            nonlocal last_reported
            now = time.monotonic()
            if now - last_reported > 0.2:
                last_reported = now
                self._hold(lease, episodes_done=episodes_done, steps=steps)

        healthy, playing = True, False
        try:
            bundle = self._bundles.use(job.bundle) if job.bundle else contextlib.nullcontext()
            async with bundle as folder:
                self._capacity_freed.set()
                job = await self._with_recordings(job)
                # Cancelled while its files were fetched, before the slot had anything to stop.
                if lease.lease_id in self._cancelled:
                    self._put_result(lease, "returned")
                    return healthy
                playing = True
                outcomes = await slot.play_job(job, folder, on_progress)
            self._warm_environments[job.env] = None
            if not outcomes:
                self._put_result(lease, "returned", begun=slot.begun)
            else:
                self._put_result(lease, "done", outcomes)
                self.jobs_done += 1
        except (EvopolicyError, OSError) as error:
            healthy = False
            kind: ResultKind = "returned" if lease.lease_id in self._cancelled else "failed"
            if kind == "failed":
                log.error("job failed here", job=job.job_id, attempt=lease.attempt, error=str(error))
            begun = slot.begun if playing else None
            broken = isinstance(error, BrokenEnvironmentError) and kind == "failed"
            self._put_result(lease, kind, error=str(error), begun=begun, environment_fault=broken)
        except asyncio.CancelledError:
            self._put_result(lease, "returned", begun=slot.begun if playing else None)
            raise
        finally:
            self._running.pop(lease.lease_id, None)
            self._cancelled.discard(lease.lease_id)
            self._capacity_freed.set()
        return healthy

    async def _with_recordings(self, job: Job) -> Job:
        """The job with the recordings that it replays or resumes from downloaded inline."""
        episodes = [
            msgspec.structs.replace(spec, replay=await self._inline(spec.replay)) if spec.replay else spec
            for spec in job.episodes
        ]
        begun = await self._inline(job.begun)
        return msgspec.structs.replace(job, begun=begun, episodes=tuple(episodes))

    async def _inline(self, ref: BlobRef | None) -> BlobRef | None:
        """The blob with its bytes, downloaded where it lacks them."""
        if ref is None or ref.inline is not None:
            return ref
        return msgspec.structs.replace(ref, inline=await self._fetch(ref.digest))

    async def _fetch(self, digest: str) -> bytes:
        return await self._ask.download(self._options.name, self._session, digest)

    # Reporting results.

    def _put_result(
        self,
        lease: Lease,
        kind: ResultKind,
        episodes: tuple[EpisodeOutcome, ...] = (),
        error: str = "",
        begun: HandedBack | None = None,
        environment_fault: bool = False,
    ) -> None:
        data = b"" if begun is None else begun.data
        self._outbox.put(
            JobResult(
                lease_id=lease.lease_id,
                job_id=lease.job.job_id,
                attempt=lease.attempt,
                kind=kind,
                episodes=episodes,
                error=error[: REASON_CHARACTERS["result"]],
                begun=BlobRef(digest=digest_of(data), size=len(data), inline=data) if data else None,
                limit_verdict=begun is not None and begun.limit_verdict,
                environment_fault=environment_fault,
            )
        )

    def _settled(self, result: JobResult) -> None:
        self._heartbeat.held.pop(result.lease_id, None)
        self._capacity_freed.set()

    def _hold(self, lease: Lease, *, running: bool = True, episodes_done: int = 0, steps: int = 0) -> None:
        """Lists the lease in the heartbeats from the next one on, or updates its progress there."""
        self._heartbeat.held[lease.lease_id] = HeldLease(
            lease_id=lease.lease_id,
            job_id=lease.job.job_id,
            attempt=lease.attempt,
            running=running,
            episodes_done=episodes_done,
            steps=steps,
        )

    async def _stop_in_silence(self) -> None:
        while True:
            await asyncio.sleep(SILENCE_CHECK_S)
            if self._heartbeat.silent_s <= self._lease_ttl_s:
                continue
            for lease in (*self._queue.values(), *(lease for lease, _ in self._running.values())):
                if lease.stop_in_silence:
                    self._cancel(lease.lease_id)

    async def _give_back(self, lease: asyncio.Task[None], slots: list[asyncio.Task[None]]) -> None:
        """Returns the waiting jobs, and the running ones after the grace time."""
        # The waiting poll is withdrawn, since its answer could bring leases that this worker would lose.
        request = LeaseRequest(worker=self._options.name, session=self._session, n=0, wait_s=0.0)
        with contextlib.suppress(EvopolicyError):
            await self._ask.once("lease", request, Leases)
        await asyncio.wait({lease}, timeout=WITHDRAW_TIMEOUT_S)
        lease.cancel()
        while self._queue:
            _, waiting = self._queue.popitem(last=False)
            self._put_result(waiting, "returned")
        _, late = await asyncio.wait(slots, timeout=self._options.grace_s)
        if late:
            log.warning("giving running episodes back", slots=len(late))
            for lease_id in list(self._running):
                self._cancel(lease_id)
            _, stuck = await asyncio.wait(late, timeout=CANCEL_TIMEOUT_S)
            for task in stuck:
                task.cancel()


async def _ended(*tasks: asyncio.Task[object]) -> None:
    """Cancels these tasks, and returns once they have ended."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _log_failure(task: asyncio.Task[None]) -> None:
    error = None if task.cancelled() else task.exception()
    if error is not None and not isinstance(error, TransportError):
        log.error("cancelling a job failed", error=str(error))


async def _close_slot(slot: Slot) -> None:
    with contextlib.suppress(EvopolicyError, OSError):
        await slot.close()


class BundleCache:
    """A folder of unpacked bundles. Evicts the least recently used; a bundle in use is never removed."""

    def __init__(self, root: Path, fetch: Callable[[str], Awaitable[bytes]], limit: int = 64) -> None:
        """`fetch` returns a bundle's packed bytes by digest; `limit` is the number of bundles kept."""
        self._root = root
        self._fetch = fetch
        self._limit = limit
        self._ready: OrderedDict[str, asyncio.Task[Path]] = OrderedDict()
        self._users: Counter[str] = Counter()

    @property
    def warm(self) -> tuple[str, ...]:
        """Digests of the cached bundles, most recently used last."""
        return tuple(digest for digest, task in self._ready.items() if task.done())

    @contextlib.asynccontextmanager
    async def use(self, digest: str) -> AsyncIterator[Path]:
        """The bundle's folder, kept for the duration of the `async with`. Raises the errors of fetching and
        unpacking."""
        task = self._ready.get(digest)
        if task is None:
            task = self._ready[digest] = asyncio.create_task(self._bring(digest))
        self._ready.move_to_end(digest)
        self._users[digest] += 1
        try:
            try:
                # Shielded: another job with the same bundle may wait for the same fetch.
                folder = await asyncio.shield(task)
            except Exception:
                self._ready.pop(digest, None)
                raise
            yield folder
        finally:
            self._users[digest] -= 1
            await self._evict()

    async def _bring(self, digest: str) -> Path:
        bundle = bundles.load(await self._fetch(digest), digest)
        folder = self._root / digest
        await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
        await asyncio.to_thread(bundles.unpack, bundle, folder)
        return folder

    async def _evict(self) -> None:
        for digest in list(self._ready):
            if len(self._ready) <= self._limit:
                return
            task = self._ready[digest]
            if not self._users[digest] and task.done():
                del self._ready[digest], self._users[digest]
                await asyncio.to_thread(shutil.rmtree, self._root / digest, ignore_errors=True)
