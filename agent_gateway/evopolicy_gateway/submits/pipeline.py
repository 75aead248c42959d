"""The submit pipeline: takes requests and performs the effects of the ticket machine (`tickets`).

- A request is checked before anything is read from `system/`; one with an invalid form or outside the bounds
  costs nothing.
- A valid request is in the journal before it is sent, and is repeated by its key after a restart.
- A coordinator that was started on an earlier backup gets the submits that it has lost once more, and plays them again.
- A submit continues when no client waits for it any more; its answer is kept.
- An unexpected error ends the gateway process; the next one resumes from the journal.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from evopolicy_common.errors import RefusedError, RequestError, StorageError
from evopolicy_common.logs import log
from evopolicy_common.messages.gateway import RunOpened, Submit, SubmitAccepted, SubmitDone
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.open_run import AnyLine, Died, Settled, SubmitRequested
from evopolicy_common.records.policies.trees import TreeRecorder
from evopolicy_common.refusals import RUN_LOST, Refusal
from evopolicy_gateway.run_folder.journal import Journal
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.submits import snapshots
from evopolicy_gateway.submits.coordinator_client import CoordinatorClient
from evopolicy_gateway.submits.feedback import Collector, SubmitTree
from evopolicy_gateway.submits.tickets import (
    Collect,
    Effect,
    Note,
    Send,
    Stop,
    TakeSnapshot,
    Ticket,
    TicketMachine,
)

T = TypeVar("T")

DISK_PAUSE_S = 2.0
"""Seconds between retries while the disk refuses feedback."""


class SubmitPipeline:
    """Takes submits for one run, on one event loop."""

    def __init__(
        self,
        client: CoordinatorClient,
        run: RunOpened,
        folder: RunFolder,
        journal: Journal,
        on_change: Callable[[], None],
    ) -> None:
        """`on_change` is called after every change that a watcher shows."""
        self.machine = TicketMachine(run, journal.entries)
        journal.entries = {}  # to free memory
        self.fatal: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Fails with the error that ends this process."""
        self._client = client
        self.folder = folder
        self._journal = journal
        self._blobs = BlobStore(folder.blobs)
        self._on_change = on_change
        self._trees = TreeRecorder(folder.workspace, folder.trees, started=folder.start.exists())
        self._news = asyncio.Event()
        """Set, and replaced, at the next change of the machine."""
        self._uploaded: str | None = None
        """The bundle that the coordinator accepted a submit of last, in this process."""
        self._task: asyncio.Task[None] | None = None
        self._journal_lock = asyncio.Lock()
        for key, episodes in journal.at_work.died_over.items():
            log.warning("the last gateway crashed on the files of an episode", submit=key, episodes=episodes)
            died = Died(key=key, episodes=tuple(episodes))
            self.machine.noted(died, journal.append(died))
        journal.at_work.clear()
        self._start_work()

    async def submit(self, body: bytes, client_key: str | None) -> Ticket:
        """Takes a request, or returns the ticket of the one that it repeats.

        Raises RequestError (refused, nothing charged), as ConflictError when another submit runs or the key
        belongs to another body.
        """
        if (earlier := self.machine.repeated(body, client_key)) is not None:
            return earlier
        try:
            ticket = self.machine.open_ticket(body, client_key, uuid.uuid4().hex)
        except RequestError as error:
            await self.note_rejected(error)
            raise
        self._start_work()
        return ticket

    async def note_rejected(self, error: RequestError) -> None:
        """Records a refused request for `run.json`."""
        if (entry := self.machine.reject(error, time.time())) is not None:
            await self._note(entry)

    async def until(self, reached: Callable[[], bool]) -> None:
        while not reached():
            await self._news.wait()

    def summary(self, ticket: Ticket) -> bytes | None:
        """The bytes of `summary.json`, from the journal: an agent may change the file. None: not settled."""
        if ticket.place is None:
            return None
        entry = self._journal.read_line(ticket.place)
        assert isinstance(entry, Settled)
        return entry.summary.encode()

    async def refresh(self) -> None:
        """Updates the state of the run, unless the coordinator does not answer at once."""
        try:
            state = await self._client.state()
        except RefusedError as error:
            if self.machine.close(cancelled=error.status == Refusal.RUN_CANCELLED):
                log.warning("the run accepts no more submits", status=error.status, why=error.message)
                self._changed()
        else:
            if state is not None and self.machine.hear(state):
                self._changed()

    async def idle(self) -> None:
        while self._task is not None and not self._task.done():
            await asyncio.wait([self._task])

    async def close(self, reason: str, agent: dict[str, object]) -> None:
        """Closes the run at the coordinator, with all its submits."""
        while True:
            try:
                return await self._client.close(reason, agent, len(self.machine.accepted))
            except RefusedError as error:
                if error.status != Refusal.UNKNOWN_SUBMIT:
                    raise
            await self._submit_again()

    async def stop(self) -> None:
        """Leaves the submit in flight to the next gateway."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _start_work(self) -> None:
        if self.machine.in_flight is not None:
            self._task = asyncio.create_task(self._carry_out())
            self._changed()

    async def _carry_out(self) -> None:
        started, effect = time.monotonic(), self.machine.next()
        while effect is not None and not isinstance(effect, Stop):
            effect = await self._perform(effect)
            self._changed()
        self.machine.in_flight_s += time.monotonic() - started
        if effect is not None:
            self.fatal.set_exception(effect.error)

    def _changed(self) -> None:
        self._news.set()
        self._news = asyncio.Event()
        self._on_change()

    async def _perform(self, effect: TakeSnapshot | Send | Collect | Note) -> Effect | None:
        """Performs an effect; returns the one that follows from its outcome."""
        machine, ticket = self.machine, self.machine.in_flight
        assert ticket is not None
        try:
            match effect:
                case TakeSnapshot():
                    return machine.snapshotted(await self._on_disk(partial(self._snapshot, ticket.submit_id)))
                case Send():
                    return machine.sent(await self._send(ticket.request.submit, ticket.index))
                case Collect():
                    return machine.collected(*await self._collect(ticket))
                case Note(entry):
                    following = machine.noted(entry, await self._note(entry))
                    if isinstance(entry, SubmitAccepted):
                        log.info("submit accepted", submit=ticket.submit_id, n_episodes=ticket.n_episodes)
                    elif isinstance(entry, Settled):
                        log.info("submit committed", submit=ticket.submit_id, status=entry.status)
                    return following
        except RefusedError as error:
            if error.status == Refusal.UNKNOWN_SUBMIT:
                await self._submit_again()
                return effect
            if error.status in RUN_LOST:
                await asyncio.sleep(DISK_PAUSE_S)
                return effect
            log.warning("submit refused", submit=ticket.submit_id, status=error.status, why=error.message)
            return machine.refused(error)
        except Exception as error:
            log.error("submit failed", submit=ticket.submit_id, exc_info=error)
            return machine.failed(error)

    def _snapshot(self, submit: str) -> snapshots.SystemSnapshot:
        published = self.machine.run.profile != "own"
        snapshot = snapshots.take_snapshot(self.folder.system, self._blobs, published=published)
        return snapshots.record_tree(snapshot, submit, self._trees, self.folder.root)

    async def _note(self, entry: AnyLine) -> int:
        """Appends to the journal, in order; returns the offset."""
        async with self._journal_lock:
            return await self._on_disk(partial(self._journal.append, entry))

    async def _on_disk(self, call: Callable[[], T]) -> T:
        """Calls it off the event loop; again while the disk refuses."""
        while True:
            try:
                return await asyncio.to_thread(call)
            except StorageError as error:
                log.error("the disk refuses; trying again", error=str(error))
            await asyncio.sleep(DISK_PAUSE_S)

    async def _submit_again(self) -> None:
        """Submits once more what a coordinator on an earlier backup has lost, and waits until it is played."""
        accepted, state = self.machine.accepted, await self._client.state()
        known = 0 if state is None else state.n_submits
        log.warning(
            "the coordinator has lost submits; sending them again", known=known, accepted=len(accepted)
        )
        for ticket in accepted[max(0, known - 1) :]:
            assert ticket.requested_at is not None
            request = self._journal.read_line(ticket.requested_at)
            assert isinstance(request, SubmitRequested)
            await self._send(request.submit, ticket.index)
            await self._client.ended(ticket.index)

    async def _send(self, request: Submit, index: int) -> SubmitAccepted:
        while True:
            known = request.bundle is None or request.bundle == self._uploaded
            if request.bundle is not None and not known:
                data = await asyncio.to_thread(self._blobs.read_blob, request.bundle)
                await self._client.upload(request.bundle, data)
            try:
                reply = await self._client.submit(request, index)
            except RefusedError as error:
                if error.status != Refusal.MISSING_BUNDLE:
                    raise
                log.warning("the coordinator has lost the bundle; sending it again", bundle=request.bundle)
                self._uploaded = None
                if not known:
                    await asyncio.sleep(DISK_PAUSE_S)
            else:
                self._uploaded = request.bundle
                return reply

    async def _collect(self, ticket: Ticket) -> tuple[SubmitDone, bytes]:
        """Writes the feedback; starts over when the disk refuses."""
        assert ticket.accepted is not None
        tree = SubmitTree(self.folder.feedback, ticket.submit_id)
        while True:
            collector = Collector(
                machine=self.machine,
                ticket=ticket,
                accepted=ticket.accepted,
                client=self._client,
                tree=tree,
                at_work=self._journal.at_work,
                on_page=self._changed,
            )
            try:
                return await collector.collect()
            except (OSError, StorageError) as error:
                # Without the error's paths: an agent reads this text.
                why = error.strerror if isinstance(error, OSError) else None
                ticket.waits_for = f"the gateway to write feedback: {why or 'its disk refuses'}"
                log.error("cannot write feedback; trying again", submit=ticket.submit_id, error=str(error))
                self._changed()
                await asyncio.sleep(DISK_PAUSE_S)
