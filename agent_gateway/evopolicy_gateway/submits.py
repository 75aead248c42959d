"""The submit desk: one submit at a time, from a request's bytes to committed feedback, whatever dies on the way.

Rules:
- a request is checked before anything is read from `system/`; what breaks the format or the bounds costs nothing;
- what passed is in the journal before it is sent, and is asked for again by its key after a restart;
- a submit goes on when nobody waits for it any more; its answer is kept;
- what cannot be explained ends the gateway process: the next one goes on from the journal.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import structlog

from evopolicy_common.blobs import BlobStore, digest_of
from evopolicy_common.errors import RefusedError, RequestError, StorageError
from evopolicy_common.messages.gateway import (
    CANCELLED,
    EpisodeFeedback,
    ResultsPage,
    RunOpened,
    RunState,
    SubmitAccepted,
    SubmitDone,
)
from evopolicy_common.refusals import RUN_OVER, Refusal
from evopolicy_gateway import formatting, snapshots
from evopolicy_gateway.episode_files import episode_files
from evopolicy_gateway.feedback import SubmitTree
from evopolicy_gateway.formatting import EpisodeScore
from evopolicy_gateway.journal import (
    Accepted,
    AnyEntry,
    Closed,
    Journal,
    Refused,
    Rejected,
    Requested,
    Settled,
)
from evopolicy_gateway.session import Session
from evopolicy_gateway.submit_request import Bounds, parse
from evopolicy_gateway.tickets import ConflictError, Ticket

log: structlog.stdlib.BoundLogger = structlog.get_logger()

LINGER_S = 0.02
LINGER_EPISODES = 8
"""With at least so many to come, the next results are asked for a little later: of short episodes several come at once."""
DISK_PAUSE_S = 2.0
"""Between tries to write feedback while the disk refuses."""
MAX_REJECTED_KEPT = 1000
FETCHES_AT_ONCE = 4
_REQUEST_STATUSES = (Refusal.BUDGET_INVALID, Refusal.INVALID_ENV_INSTANCE)


class Desk:
    """Takes submits for one run. Lives on one event loop."""

    def __init__(
        self,
        session: Session,
        run: RunOpened,
        workspace: Path,
        journal: Journal,
        blobs: BlobStore,
        on_change: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """`on_change` is called whenever something that a watcher shows has changed; `clock` is Unix time."""
        self.run = run
        self.state: RunState = run.state
        """As far as this gateway knows; `refresh` asks."""
        self.closed = run.state.is_finalized
        self.cancelled = run.state.cancelled
        """The operator has ended the run."""
        self.fatal: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Fails with what this process cannot go on from."""
        self.in_flight: Ticket | None = None
        self.tickets: list[Ticket] = []
        """Accepted submits by index, then perhaps one that is not yet."""
        self.n_rejected = 0
        self.in_flight_s = 0.0
        """Seconds in which a submit was in flight, of this process."""
        self.feedback_s = 0.0
        """Of these, from the last result's arrival to the committed feedback."""
        self._session = session
        self._workspace = workspace
        self._journal = journal
        self._blobs = blobs
        self._on_change = on_change
        self._clock = clock
        self._task: asyncio.Task[None] | None = None
        self._journal_lock = asyncio.Lock()
        self._recover()

    @property
    def spent(self) -> bool:
        """Whether no further submit can be taken, and none runs."""
        too_little = self.state.remaining_budget < max(1, self.run.min_episodes_per_submit)
        return self.in_flight is None and (too_little or self.closed)

    def bounds(self) -> Bounds:
        """What a submit may ask for now."""
        return Bounds(
            n_env_instances=self.run.n_env_instances,
            min_episodes=self.run.min_episodes_per_submit,
            max_episodes=self.run.max_episodes_per_submit,
            remaining_budget=self.state.remaining_budget,
        )

    async def submit(self, body: bytes, client_key: str | None) -> Ticket:
        """Takes a request, or finds the one that it repeats.

        Raises RequestError (refused, nothing charged) and ConflictError (another submit runs, or the key was used for
        another body).
        """
        body_digest = digest_of(body)
        if client_key is not None:
            for ticket in self.tickets:
                if ticket.request.client_key == client_key:
                    if ticket.request.body_digest != body_digest:
                        raise ConflictError(
                            ticket.submit_id,
                            f"this Idempotency-Key was used for {ticket.submit_id} with another body; use a new key",
                        )
                    return ticket
        try:
            if self.in_flight is not None:
                raise ConflictError(
                    self.in_flight.submit_id,
                    f"{self.in_flight.submit_id} is running; wait for it, or ask GET /submit/{self.in_flight.submit_id}",
                )
            if self.closed:
                raise self._refusal()
            env_instances = parse(body, self.bounds())
        except RequestError as error:
            await self.note_rejected(error)
            raise
        ticket = Ticket(
            Requested(
                key=uuid.uuid4().hex,
                client_key=client_key,
                body_digest=body_digest,
                env_instances=env_instances,
                bundle=None,
                bundle_error=None,
            ),
            len(self.tickets),
            self.run.episode_budget,
        )
        # No await between the check above and this: two requests cannot both pass.
        self._start(ticket, fresh=True)
        return ticket

    def find(self, submit_id: str) -> Ticket | None:
        """The submit of that name."""
        return next((ticket for ticket in self.tickets if ticket.submit_id == submit_id), None)

    async def note_rejected(self, error: RequestError) -> None:
        """Keeps a refused request for `run.json`."""
        self.n_rejected += 1
        if self.n_rejected <= MAX_REJECTED_KEPT:
            await self._note(
                Rejected(
                    status=error.status,
                    message=error.message,
                    at=self._clock(),
                    after_submits=self.state.n_submits,
                )
            )

    async def refresh(self) -> RunState:
        """The state as the coordinator sees it, or as last known when it does not answer at once."""
        try:
            state = await self._session.state()
        except RefusedError as error:
            self._refused(error)
            state = None
        # While a submit is on its way, an answer may be older than what its acceptance told.
        if state is not None and state.n_submits >= self.state.n_submits:
            self.state = state
            self._close(state.is_finalized, state.cancelled)
        return self.state

    async def idle(self) -> None:
        """Returns when no submit runs."""
        while self._task is not None and not self._task.done():
            await asyncio.wait([self._task])

    async def stop(self) -> None:
        """Leaves the submit in flight to the next gateway."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _recover(self) -> None:
        """Rebuilds the tickets from the journal and goes on with the one that has no end."""
        by_key: dict[str, Ticket] = {}
        for entry in self._journal.entries:
            if isinstance(entry, Requested):
                by_key[entry.key] = ticket = Ticket(entry, len(self.tickets), self.run.episode_budget)
                self.tickets.append(ticket)
            elif isinstance(entry, Accepted):
                by_key[entry.key].accept(entry)
            elif isinstance(entry, Settled):
                by_key[entry.key].settle(entry.status, entry.summary.encode())
            elif isinstance(entry, Refused):
                self.tickets.remove(by_key.pop(entry.key))
            elif isinstance(entry, Rejected):
                self.n_rejected += 1
            elif isinstance(entry, Closed):
                self.closed = True
        for ticket in list(self.tickets):
            if not ticket.done.is_set():
                self.tickets.remove(ticket)
                self._start(ticket, fresh=False)

    def _start(self, ticket: Ticket, *, fresh: bool) -> None:
        self.in_flight = ticket
        self.tickets.append(ticket)
        self._task = asyncio.create_task(self._carry_out(ticket, fresh=fresh), name=ticket.submit_id)
        self._on_change()

    async def _carry_out(self, ticket: Ticket, *, fresh: bool) -> None:
        started = time.monotonic()
        try:
            if fresh:
                await self._snapshot(ticket)
            await self._send(ticket)
            await self._collect(ticket)
        except RequestError as error:
            self.tickets.remove(ticket)
            ticket.fail(error)
        except RefusedError as error:
            if error.status not in RUN_OVER:
                self._give_up(ticket, error)
                return
            self._refused(error)
            ticket.fail(self._refusal("budget_invalid" if ticket.accepted is None else "closed"))
        except Exception as error:
            self._give_up(ticket, error)
            return
        self.in_flight_s += time.monotonic() - started
        self.in_flight = None
        self._on_change()

    def _give_up(self, ticket: Ticket, error: Exception) -> None:
        log.error("submit failed", submit=ticket.submit_id, exc_info=error)
        if not self.fatal.done():
            self.fatal.set_exception(error)

    async def _snapshot(self, ticket: Ticket) -> None:
        """Takes the bundle as it is now, and writes the request down."""
        while True:
            try:
                taken = await asyncio.to_thread(snapshots.take, self._workspace / "system", self._blobs)
                break
            except StorageError as error:
                log.error("cannot store the snapshot; trying again", error=str(error))
                await asyncio.sleep(DISK_PAUSE_S)
        ticket.attach(taken)
        await self._note(ticket.request)

    async def _send(self, ticket: Ticket) -> None:
        """Uploads the bundle and has the submit accepted."""
        request = ticket.request
        if ticket.accepted is not None:
            self._charged(ticket.accepted)
            return
        try:
            reply = await self._upload_and_submit(request)
        except RefusedError as error:
            if error.status in RUN_OVER or error.status in _REQUEST_STATUSES:
                await self._note(Refused(key=request.key, status=error.status, message=error.message))
            if error.status in RUN_OVER:
                self.tickets.remove(ticket)
            if error.status in _REQUEST_STATUSES:
                raise RequestError(error.status, error.message) from error
            raise
        accepted = Accepted(
            key=request.key,
            submit_index=reply.submit_index,
            first_global_episode=reply.first_global_episode,
            remaining_budget=reply.remaining_budget,
        )
        await self._note(accepted)
        self._charged(accepted)
        ticket.accept(accepted)
        log.info("submit accepted", submit=ticket.submit_id, n_episodes=len(request.env_instances))
        self._on_change()

    async def _upload_and_submit(self, request: Requested) -> SubmitAccepted:
        while True:
            if request.bundle is not None:
                data = await asyncio.to_thread(self._blobs.read, request.bundle)
                await self._session.upload(request.bundle, data)
            try:
                return await self._session.submit(request)
            except RefusedError as error:
                if error.status != Refusal.MISSING_BUNDLE:
                    raise
                log.warning("the coordinator has lost the bundle; sending it again", bundle=request.bundle)
            await asyncio.sleep(DISK_PAUSE_S)

    def _charged(self, accepted: Accepted) -> None:
        self.state = RunState(
            remaining_budget=accepted.remaining_budget,
            n_submits=accepted.submit_index + 1,
            is_finalized=self.state.is_finalized,
        )

    async def _collect(self, ticket: Ticket) -> None:
        """Writes the feedback tree from the results, again from the start when the disk refused."""
        while True:
            try:
                status, summary = await self._write_feedback(ticket)
                break
            except (OSError, StorageError) as error:
                # Not the error itself, which names paths: an agent reads this.
                why = error.strerror if isinstance(error, OSError) else None
                ticket.waits_for = f"the gateway cannot write feedback: {why or 'its disk refuses'}"
                log.error("cannot write feedback; trying again", submit=ticket.submit_id, error=str(error))
                self._on_change()
                await asyncio.sleep(DISK_PAUSE_S)
        await self._note(Settled(key=ticket.request.key, status=status, summary=summary.decode()))
        ticket.settle(status, summary)
        log.info("submit committed", submit=ticket.submit_id, status=status)

    async def _write_feedback(self, ticket: Ticket) -> tuple[str, bytes]:
        """Status and summary of the committed folder."""
        assert ticket.accepted is not None
        index, first = ticket.accepted.submit_index, ticket.accepted.first_global_episode
        tree = SubmitTree(self._workspace / "feedback", ticket.submit_id)
        await asyncio.to_thread(tree.begin)
        scores: dict[int, EpisodeScore] = {}
        cursor = 0
        done: SubmitDone | None = None
        while done is None:
            page = await self._session.results(index, cursor)
            cursor, done = page.cursor, page.done
            await self._write_page(tree, page, first, scores)
            ticket.n_done, ticket.waits_for = len(scores), page.waits_for
            self._on_change()
            if done is None and len(ticket.request.env_instances) - len(scores) >= LINGER_EPISODES:
                await asyncio.sleep(LINGER_S)
        last_result = time.monotonic()
        committed = await asyncio.to_thread(self._commit, tree, index, done, scores)
        if done.status == CANCELLED:
            self.state = msgspec.structs.replace(self.state, remaining_budget=done.remaining_budget)
            self._close(True, True)
        self.feedback_s += time.monotonic() - last_result
        return committed

    async def _write_page(
        self, tree: SubmitTree, page: ResultsPage, first: int, scores: dict[int, EpisodeScore]
    ) -> None:
        gate = asyncio.Semaphore(FETCHES_AT_ONCE)

        async def write(episode: EpisodeFeedback) -> None:
            async with gate:
                trajectory = await self._session.fetch(episode.trajectory)
                video = None if episode.video is None else await self._session.fetch(episode.video)
                make = partial(
                    episode_files, episode, trajectory, video, self.run.env.obs_storage, at=self._clock()
                )
                name = formatting.episode_name(first + episode.index, self.run.episode_budget)
                await asyncio.to_thread(lambda: tree.put_episode(name, make()))
                scores[episode.index] = EpisodeScore(
                    index=episode.index,
                    episode_return=episode.episode_return,
                    length=episode.length,
                    category=episode.failure.category if episode.failure else None,
                    reward_components=episode.reward_components,
                )

        # All have ended before an error is raised: nothing may write on into a tree that is begun again.
        writes = [write(episode) for episode in page.episodes if episode.index not in scores]
        for outcome in await asyncio.gather(*writes, return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome

    def _commit(
        self, tree: SubmitTree, index: int, done: SubmitDone, scores: dict[int, EpisodeScore]
    ) -> tuple[str, bytes]:
        errors = None
        if done.status != "ok":
            errors = formatting.verdict_line(done.status, done.failure, done.completed_at)
            for late in [i for i in scores if i >= done.n_kept]:
                tree.drop_episode(
                    formatting.episode_name(done.first_global_episode + late, self.run.episode_budget)
                )
        summary = formatting.summary_bytes(self.run.env.env, index, done, list(scores.values()))
        tree.commit(summary, errors)
        return done.status, summary

    def _refused(self, error: RefusedError) -> None:
        if not self.closed:
            log.warning("the coordinator takes no more of this run", status=error.status, why=error.message)
        self._close(True, error.status == Refusal.RUN_CANCELLED)

    def _close(self, closed: bool, cancelled: bool) -> None:
        """Takes no more submits from now on, if `closed`; `cancelled`: because the operator has ended the run."""
        if closed and not (self.closed and (self.cancelled or not cancelled)):
            self.closed, self.cancelled = True, self.cancelled or cancelled
            self._on_change()

    def _refusal(self, status: str = "budget_invalid") -> RequestError:
        """What a submit is answered once the run is closed."""
        if self.cancelled:
            return RequestError(CANCELLED, "the operator cancelled the run: no more submits are taken")
        return RequestError(status, "the run is closed: no more submits are taken")

    async def _note(self, entry: AnyEntry) -> None:
        """Appends to the journal off the event loop, in order; waits while the disk refuses."""
        async with self._journal_lock:
            while True:
                try:
                    return await asyncio.to_thread(self._journal.append, entry)
                except StorageError as error:
                    log.error("cannot write the journal; trying again", error=str(error))
                await asyncio.sleep(DISK_PAUSE_S)
