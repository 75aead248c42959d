"""The coordinator's shell around the pure core: it turns queries into events and carries out effects.

Rules that this module owns:
- The event loop never waits for a disk, a socket or a lock. The database has the writer's thread, pages and blobs
  have the reader's threads, and the transport's threads send replies.
- Every batch of queries is one tick: all its events are handled, then their effects go to the outbox, so that one
  fsync serves them all.
- While the store cannot be written, no core is loaded (see `core_host`). The service then refuses requests that would
  change something, and answers operators who ask for the status or follow a run from the last core, with the reason. It
  ends all others without a reply, so that the clients retry.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import os
import socket
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from importlib import metadata
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from evopolicy_common.errors import (
    DamagedStoreError,
    ProtocolError,
    RefusedError,
    StorageError,
)
from evopolicy_common.logs import log
from evopolicy_common.messages import operator
from evopolicy_common.messages.status import DiskUse, StatusReply, StatusRequest, folded
from evopolicy_common.messages.worker import BlobGet, BlobPut, LeaseRequest, Message, Refused
from evopolicy_common.records.policies import bundles
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec
from evopolicy_common.wire.transport import IncomingQuery
from evopolicy_coordinator.core.contract.effects import Effect, Log, ReadEffect, Refuse, Reply
from evopolicy_coordinator.core.contract.events import DescriptionAwaited, LivenessLost
from evopolicy_coordinator.core.contract.reasons import REFUSALS
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.core.runs import finished
from evopolicy_coordinator.core.tables.model import Worker
from evopolicy_coordinator.server.claims import ClaimTable
from evopolicy_coordinator.server.core_host import CoreHost
from evopolicy_coordinator.server.definitions import failed, undescribed
from evopolicy_coordinator.server.reader import ServiceReader, answer_bytes, answer_to, damaged, lane_of
from evopolicy_coordinator.server.reason_texts import message, operator_words, reason_text
from evopolicy_coordinator.server.request_checks import finite_wait
from evopolicy_coordinator.server.request_parser import Parsed, RequestParser
from evopolicy_coordinator.storage.disk_use import sizes
from evopolicy_coordinator.storage.store import Store
from evopolicy_coordinator.storage.writer import Writer

MAX_BUNDLE_BYTES = bundles.MAX_BYTES + bundles.MAX_FILES * (bundles.MAX_PATH_BYTES + 32)
_FORGET_S = 120.0
"""Longer than any long poll: the core answers those within `CoreSettings.max_wait_s`."""
_SWEEP_S = _FORGET_S / 4
_STALLS_LOGGED = 5
_READ_AGAIN_S = 3.0
_CANNOT_WRITE = "the coordinator cannot write its store and accepts no changes until it can"
_FULL = ("is full", os.strerror(errno.ENOSPC), os.strerror(errno.EDQUOT))
"""Parts of the errors of a full disk, of SQLite and of the system."""
_ROOM_MB = 64
"""Megabytes that a coordinator writes in a run without large episodes, its log ahead of the database included."""


class Pending(NamedTuple):
    """A query that waits for its reply."""

    query: IncomingQuery
    asker: str
    since: float
    """Monotonic time of its arrival here, seconds."""


class Service:
    """One coordinator on an event loop: call `start`, then `on_queries` for each batch, finally `stop`."""

    def __init__(
        self,
        cluster: str,
        store: Store,
        reader: ServiceReader,
        parser: RequestParser,
        settings: CoreSettings,
    ) -> None:
        """Must be constructed on the event loop. The service uses the store from now on, but `stop` does not close
        it."""
        self._cluster = cluster
        self._reader = reader
        self._parser = parser
        self._settings = settings
        self._loop = asyncio.get_running_loop()
        self._writer = Writer(store)
        self._claims = ClaimTable(self._writer)
        self._pending: dict[int | str, Pending] = {}
        """By the number under which the core knows the query, oldest first; numbers are never reused."""
        self._n_requests = 0
        self.host = CoreHost(settings, self._writer, self._carry_out, self._let_go)
        self._tasks: set[asyncio.Task[None]] = set()
        self._started_at = self.host.now()
        self._sweeper: asyncio.TimerHandle | None = None
        self._n_events = 0
        self._last_status: tuple[float, bytes] | None = None
        """When the last status reply was made, and the reply."""
        self._heard: dict[str, float] = {}
        """Run to the time of its gateway's last request."""
        self._status_cost_s = 0.0
        self._disk: DiskUse | None = None

    async def start(self) -> None:
        """Loads the core from the store. Raises StorageError and PartFailedError, as `CoreHost.start`."""
        await self.host.start()
        self._sweep()

    async def stop(self) -> None:
        """Accepts no more queries, makes the handled ones durable, replies to them, and drops all others.

        A second call does nothing.
        """
        if self.host.stopping:
            return
        self.host.stop()
        if self._sweeper is not None:
            self._sweeper.cancel()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.host.settle()
        self._let_go()
        await self._writer.close()
        await asyncio.to_thread(self._reader.close)

    # Queries in.

    def on_queries(self, batch: list[IncomingQuery]) -> None:
        for query in batch:
            try:
                self._receive(query)
            except Exception:
                log.exception("request failed", key=query.key)
                query.drop()
        self.host.flush()

    def on_liveliness(self, key: str, alive: bool) -> None:
        """Handles the appearance or loss of a worker's liveliness token."""
        worker = key.rsplit("/", 2)[-2]
        log.debug("liveliness", worker=worker, alive=alive)
        if not alive and self.host.core is not None and not self.host.stopping:
            self.host.handle(LivenessLost(stimulus_id=self._stimulus("liveness"), worker=worker))
            self.host.flush()

    def _receive(self, query: IncomingQuery) -> None:
        core = self.host.core
        if not self.host.leads:
            query.drop()
            return
        if core is None or self.host.stopping:
            self._turn_away(query)
            return
        with self._answering(query):
            try:
                parsed = self._parser.parse(query.key, query.payload, core.state.capabilities.get)
                if parsed.subtree == "gw":
                    self._heard[parsed.asker] = self.host.now()
                serve = _ANSWERS.get(type(parsed.message), Service._serve_event)
                answer = serve(self, core, query, parsed)
            except ProtocolError as error:
                raise RefusedError(Refusal.BAD_MESSAGE, str(error)) from error
            if isinstance(answer, Awaitable):
                self._spawn(self._reply_with(query, answer))
            elif answer is not None:
                query.reply(answer_bytes(answer), lane_of(parsed.asker))

    def _serve_event(self, core: Core, query: IncomingQuery, parsed: Parsed) -> None:
        """Passes the request to the core, which answers it with an effect."""
        message = parsed.message
        if self._parser.reads_files(message):
            self._spawn(self._serve_from_thread(query, self._pinned(core, parsed)))
            return
        request = self._admit(query, parsed.asker)
        try:
            event = self._parser.event(parsed, request, self._stimulus_of(message))
        except BaseException:
            self._pending.pop(request, None)
            raise
        if isinstance(message, LeaseRequest):
            event = msgspec.structs.replace(event, waited_s=self._loop.time() - query.arrived)
        self.host.handle(event)

    def _serve_status(self, core: Core, query: IncomingQuery, parsed: Parsed) -> None:
        # The status as a message; the last one again if it is young enough, as each visits all state.
        if self._last_status is None or self.host.now() - self._last_status[0] >= parsed.message.max_age_s:
            began = time.thread_time()
            self._last_status = self.host.now(), answer_bytes(folded(self._status(core)))
            self._status_cost_s = time.thread_time() - began
        query.reply(self._last_status[1], lane_of(parsed.asker))

    def _serve_stored(self, core: Core, query: IncomingQuery, parsed: Parsed) -> None:
        self._reader.answer_read(parsed.message, answer_to(query, parsed.asker))

    async def _serve_further_cases(self, core: Core, query: IncomingQuery, parsed: Parsed) -> Message:
        return await asyncio.to_thread(self._parser.runs.further_cases, parsed.message)

    async def _serve_claim(self, core: Core, query: IncomingQuery, parsed: Parsed) -> Message:
        """Serves a claim without the core: claims change no run."""
        try:
            return await self._claims.answer_claim(parsed.message, self.host.now())
        except DamagedStoreError:
            raise
        except StorageError as error:
            return Refused(status=Refusal.UNAVAILABLE, message=str(error))

    def _serve_environments(self, core: Core, query: IncomingQuery, parsed: Parsed) -> Message:
        workers = core.state.workers.values()
        page = _page(self._parser.definitions.offered(workers), parsed.message.cursor)
        if page.finished:
            page = replace(page, undescribed=undescribed(workers), failed=failed(workers))
        return page

    async def _serve_approval(self, core: Core, query: IncomingQuery, parsed: Parsed) -> Message:
        wanted, workers = parsed.message, core.state.workers.values()
        self._parser.definitions.approve(wanted.env, wanted.digest, workers)
        await self.host.share()
        return operator.Done()

    def _pinned(self, core: Core, parsed: Parsed) -> Parsed:
        """Returns the request with the environment definition that its episodes are played in."""
        message, workers = parsed.message, core.state.workers.values()
        if isinstance(message, operator.CreateRun):
            if message.key in core.state.run_keys:  # created before; keeps its definition
                return parsed
            wanted = message.settings
            pin = self._parser.definitions.pin(wanted.env, wanted.definition, workers)
            message = replace(message, settings=replace(wanted, definition=pin))
        elif isinstance(message, operator.Evaluate):
            pin = self._parser.definitions.pin(message.env, message.definition, workers)
            message = replace(message, definition=pin)
        return replace(parsed, message=message)

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None:
            log.error("request failed", exc_info=error)

    async def _serve_from_thread(self, query: IncomingQuery, parsed: Parsed) -> None:
        """Serves requests whose event is built from files."""
        request = self._admit(query, parsed.asker)
        stimulus = self._stimulus_of(parsed.message)
        with self._answering(query):
            try:
                event = await asyncio.to_thread(self._parser.event, parsed, request, stimulus)
            except BaseException:
                self._pending.pop(request, None)
                raise
            if request in self._pending:  # otherwise the core was dropped meanwhile, and the query with it
                self.host.handle(event)
                self.host.flush()

    async def _reply_with(self, query: IncomingQuery, answer: Awaitable[Message]) -> None:
        with self._answering(query):
            query.reply(answer_bytes(await answer))

    @contextlib.contextmanager
    def _answering(self, query: IncomingQuery) -> Iterator[None]:
        """Refuses the query where the body is refused, and drops it where the body fails."""
        try:
            yield
        except RefusedError as error:
            self._refuse(query, error)
        except DamagedStoreError as error:
            self._refuse(query, damaged(error))
        except StorageError as error:
            log.error("request failed; its sender asks again", key=query.key, error=str(error))
            query.drop()
        except Exception:
            # A bug here must not stop the service. The client is notified immediately and may retry.
            log.exception("request failed", key=query.key)
            query.drop()

    def _serve_description(self, core: Core, query: IncomingQuery, parsed: Parsed) -> Awaitable[Message]:
        """Reads the split hashes and the fingerprints that matter for replaying a run's episodes."""
        message, workers = parsed.message, core.state.workers.values()
        profiles = {
            repr(each.profile.fingerprints[message.env]): each.profile
            for each in workers
            if message.env in each.profile.descriptions
        }.values()
        awaited = not profiles and any(
            message.env in each.undescribed and each.state != "lost" for each in workers
        )
        fingerprints = tuple(each.fingerprints[message.env] for each in profiles)
        classes = tuple(each.classes[message.env] for each in profiles)
        if awaited:
            self.host.handle(DescriptionAwaited(stimulus_id=self._stimulus_of(message), env=message.env))

        def read_environment() -> Message:
            row = self._reader.finished_run(message.run)
            return operator.EnvironmentState(
                split_hashes=self._parser.runs.split_hashes(message, row),
                knows_run=row is not None,
                fingerprints=fingerprints,
                classes=classes,
                awaited=awaited,
                result=b"" if row is None else self._reader.result(message.run),
            )

        return asyncio.to_thread(read_environment)

    def _serve_put(self, core: Core, query: IncomingQuery, parsed: Parsed) -> None:
        message = parsed.message
        most, run_id, submitted = MAX_BUNDLE_BYTES, None, frozenset[str | None]()
        if parsed.subtree == "work":
            _check_session(core, parsed.asker, message.token)
            most = codec.MAX_BLOB_BYTES
        elif parsed.subtree == "gw":
            run = core.state.runs.get(parsed.asker)
            if run is None or run.state.phase != "open":
                reason = core.over(parsed.asker)
                raise RefusedError(REFUSALS[reason.code][0], reason_text(reason))
            run_id, submitted = run.id, frozenset(row.bundle for row in run.submits)
        answer = answer_to(query, parsed.asker)
        self._reader.put(f"{parsed.subtree}/{parsed.asker}", run_id, message, most, answer, submitted)

    def _serve_get(self, core: Core, query: IncomingQuery, parsed: Parsed) -> None:
        message = parsed.message
        if parsed.subtree == "work":
            worker = _check_session(core, parsed.asker, message.token)
            if not any(lease.job.names_blob(message.digest) for lease in worker.leases.values()):
                raise RefusedError(
                    Refusal.UNKNOWN_BLOB,
                    f"worker {parsed.asker!r} holds no job that names blob {message.digest[:64]!r}",
                )
        run = parsed.asker if parsed.subtree == "gw" else None
        self._reader.get(run, message, answer_to(query, parsed.asker))

    def _status(self, core: Core) -> StatusReply:
        now = self.host.now()
        reply = core.status(now, operator_words)
        heard = {
            run.run: max(run.created_at, self._heard.get(run.run, self._started_at)) for run in reply.runs
        }
        return replace(
            reply,
            cluster=self._cluster,
            version=metadata.version("evopolicy"),
            uptime_s=now - self._started_at,
            runs=tuple(
                replace(run, silent_s=now - heard[run.run]) if run.phase == "open" else run
                for run in reply.runs
            ),
            stalls=self._stalls(reply.stalls),
            disk=self._disk,
            cost_s=self._status_cost_s,
            trouble=self._trouble,
            host=socket.gethostname(),
            store_latency_s=self.host.store_latency_s,
            standbys=self.host.standbys,
        )

    def _refuse(self, query: IncomingQuery, error: RefusedError) -> None:
        log.info("refused", key=query.key, status=error.status, why=error.message)
        answer = Refused(status=error.status, message=error.message)
        self.host.confirmed(lambda: query.reply(answer_bytes(answer)), query.drop)

    def _turn_away(self, query: IncomingQuery) -> None:
        """Without a core, serves what needs none while the store cannot be written, and drops all others."""
        core = self.host.last_core
        if self.host.storage_error and self._parser.asks_for_change(query.key, query.payload):
            # The reason contains paths, which agents must not see.
            why = _CANNOT_WRITE if self._parser.subtree(query.key) == "gw" else self._trouble
            query.reply(answer_bytes(Refused(status=Refusal.UNAVAILABLE, message=why)))
        elif core is None or self._parser.subtree(query.key) != "ops":
            query.drop()
        else:
            self._serve_reader(core, query)

    def _serve_reader(self, core: Core, query: IncomingQuery) -> None:
        """Answers an operator from the core that the store refused."""
        try:
            message = self._parser.parse(query.key, query.payload, core.state.capabilities.get).message
        except RefusedError as error:
            self._refuse(query, error)
            return
        run = core.state.runs.get(message.run) if isinstance(message, operator.WaitRun) else None
        if isinstance(message, StatusRequest):
            query.reply(answer_bytes(folded(self._status(core))))
        elif isinstance(message, operator.WaitRun) and run is not None:
            progress, _ = finished.progress(core.state, run)
            answer = answer_bytes(replace(progress, trouble=self._trouble))
            # As late as the operator allows: it asks again at once.
            self._loop.call_later(min(finite_wait(message.wait_s), _READ_AGAIN_S), query.reply, answer)
        else:
            query.drop()

    @property
    def _trouble(self) -> str:
        why = self.host.storage_error or self._reader.storage_error or self._reader.blobs.trouble
        if not why:
            return ""
        remedy = f"see that {'it answers and has room' if '://' in why else f'{self._reader.state} can be written'}"
        if any(text in why for text in _FULL):
            remedy = f"make room in {self._reader.state}, {_ROOM_MB} MB or more (df -h, evopolicy gc)"
        return f"{_CANNOT_WRITE}: {why}; {remedy}. Runs continue by themselves then"

    def _stimulus_of(self, message: Message) -> str:
        return self._stimulus(type(message).__name__.lower())

    def _stimulus(self, kind: str) -> str:
        self._n_events += 1
        return f"{kind}-{self.host.incarnation}.{self._n_events}"

    def _admit(self, query: IncomingQuery, asker: str) -> int:
        """Lets a query wait for the core, and returns its number."""
        self._n_requests += 1
        self._pending[self._n_requests] = Pending(query, asker, time.monotonic())
        return self._n_requests

    def _let_go(self, older_than_s: float = 0.0) -> None:
        """Drops, without a reply, queries that have waited at least `older_than_s` seconds."""
        for request, pending in list(self._pending.items()):
            if time.monotonic() - pending.since < older_than_s:
                return
            pending.query.drop()
            del self._pending[request]

    # Effects out.

    def _carry_out(self, effect: Effect) -> None:
        try:
            self._perform(effect)
        except Exception:
            # Only one client is affected and it retries; the replies queued behind this one must still go out.
            log.exception("cannot carry out", effect=type(effect).__name__)

    def _perform(self, effect: Effect) -> None:
        if isinstance(effect, Reply | Refuse | ReadEffect):
            pending = self._pending.pop(effect.request, None)
            if pending is None:
                return
            if not self.host.leads:
                pending.query.drop()
                return
            query, answer = pending.query, answer_to(pending.query, pending.asker)
            if isinstance(effect, ReadEffect):
                self._reader.answer_read(effect, answer)
                return
            reply = message(effect, self._reader.state)
            if isinstance(reply, operator.RunProgress):
                reply = replace(reply, trouble=self._trouble)
            if isinstance(effect, Refuse):
                self.host.confirmed(lambda: answer(reply), query.drop)
            else:
                answer(reply)
        elif isinstance(effect, Log):
            getattr(log, effect.level)(effect.event, stimulus=effect.stimulus_id, **effect.fields)

    def _sweep(self) -> None:
        """Periodically drops queries without a waiter (queries of lost workers are never answered), and uploads of runs
        that are over."""
        self._sweeper = self._loop.call_later(_SWEEP_S, self._sweep)
        self._let_go(_FORGET_S)
        self._tell_stalls()
        self._spawn(self._measure_disk())
        core = self.host.core
        if core is not None:
            self._heard = {run: at for run, at in self._heard.items() if run in core.state.runs}
        # Once all is durable, the store names every bundle that a submit of a closed run ever will.
        if core is not None and self.host.idle:
            runs = core.state.runs
            self._reader.drop_uploads(lambda run: run not in runs or runs[run].state.phase != "open")

    async def _measure_disk(self) -> None:
        """Updates the figures of the disk, on a thread: a network disk may hang."""
        try:
            self._disk = await asyncio.to_thread(sizes, self._reader.state)
        except OSError as error:
            log.warning("cannot read the size of the disk", error=str(error))

    def _tell_stalls(self) -> None:
        """Logs jobs and groups that wait too long, as `evopolicy status` shows them."""
        core, now = self.host.core, self.host.now()
        stalls = () if core is None else self._stalls(core.status(now, operator_words).stalls)
        if stalls:
            log.warning("stalls", n=len(stalls), first=stalls[:_STALLS_LOGGED])

    def _stalls(self, of_core: tuple[str, ...]) -> tuple[str, ...]:
        """Descriptions of waits longer than `stall_s`, for the disk and in the core."""
        writing_s = self.host.writing_s
        if writing_s <= self._settings.stall_s:
            return of_core
        return (
            f"{len(self._pending)} requests wait for the disk: it has been writing for {writing_s:.0f} s",
            *of_core,
        )


Answered = Message | Awaitable[Message] | None
"""A reply; None: it is sent later."""

_ANSWERS: dict[type[Message], Callable[[Service, Core, IncomingQuery, Parsed], Answered]] = {
    BlobPut: Service._serve_put,
    BlobGet: Service._serve_get,
    operator.Claim: Service._serve_claim,
    StatusRequest: Service._serve_status,
    operator.RecordedRequest: Service._serve_stored,
    operator.JournalRequest: Service._serve_stored,
    operator.OpeningRequest: Service._serve_stored,
    operator.SignRequest: Service._serve_stored,
    operator.DescribeEnvironment: Service._serve_description,
    operator.FurtherCasesRequest: Service._serve_further_cases,
    operator.EnvironmentsRequest: Service._serve_environments,
    operator.ApproveEnvironment: Service._serve_approval,
}
"""Requests that are answered without an event for the core."""


def _check_session(core: Core, name: str, session: str) -> Worker:
    worker = core.state.workers.get(name)
    if worker is None or not hmac.compare_digest(worker.session.encode(), session.encode()):
        raise RefusedError(
            Refusal.UNKNOWN_WORKER, f"worker {name[:64]!r} has no such session; register again"
        )
    return worker


_PAGE_BYTES = 4 << 20


def _page(offered: list[operator.OfferedEnvironment], cursor: int) -> operator.EnvironmentsReply:
    """Returns the offered environments from `cursor` on, in a page of at most `_PAGE_BYTES` unless one alone is
    larger."""
    page: list[operator.OfferedEnvironment] = []
    size = 0
    for each in offered[max(0, cursor) :]:
        size += len(msgspec.msgpack.encode(each))
        if page and size > _PAGE_BYTES:
            break
        page.append(each)
    end = max(0, cursor) + len(page)
    return operator.EnvironmentsReply(environments=tuple(page), cursor=end, finished=end >= len(offered))
