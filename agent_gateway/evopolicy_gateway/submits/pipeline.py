"""The submit pipeline: one submit at a time, from a request's bytes to committed feedback, despite crashes.

- A request is checked before anything is read from `system/`; one with an invalid form or outside the bounds costs
  nothing.
- A valid request is in the journal before it is sent, and is repeated by its key after a restart.
- A submit continues when no client waits for it any more; its answer is kept.
- An unexpected error ends the gateway process; the next one resumes from the journal.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_common.errors import ProtocolError, RefusedError, RequestError, StorageError
from evopolicy_common.logs import structlog
from evopolicy_common.messages.gateway import (
    CANCELLED,
    EpisodeFeedback,
    ResultsPage,
    RunOpened,
    RunState,
    SubmitAccepted,
    SubmitDone,
)
from evopolicy_common.records.blobs import BlobStore, digest_of
from evopolicy_common.records.open_run import (
    Accepted,
    AnyEntry,
    Closed,
    Died,
    Refused,
    Rejected,
    Rejection,
    Requested,
    SetAside,
    Settled,
)
from evopolicy_common.refusals import RUN_OVER, Refusal
from evopolicy_gateway.run_folder.journal import Journal
from evopolicy_gateway.run_folder.names import episode_name
from evopolicy_gateway.submits import formatting, published_requests, snapshots
from evopolicy_gateway.submits.coordinator_client import HELD_WAIT_S, RESULTS_WAIT_S, CoordinatorClient
from evopolicy_gateway.submits.episode_files import (
    episode_files,
    episode_share,
    set_aside_files,
    shows_texts,
    takes_much,
)
from evopolicy_gateway.submits.feedback import SubmitTree
from evopolicy_gateway.submits.formatting import EpisodeScore
from evopolicy_gateway.submits.published_requests import OddRequestError
from evopolicy_gateway.submits.submit_request import Bounds, parse
from evopolicy_gateway.submits.tickets import ConflictError, Ticket

log: structlog.stdlib.BoundLogger = structlog.get_logger()

FIRST_LINGER_S = 0.02
LONGEST_LINGER_S = 0.1
SHORTEST_LINGER_S = 0.002
"""Bounds of the pause before the next request, which collects several results of short episodes, seconds."""
DISK_PAUSE_S = 2.0
"""Seconds between retries while the disk refuses feedback."""
MAX_REJECTED_KEPT = 1000
FETCHES_AT_ONCE = 4
RUN_CLOSED = "run_closed"
"""The published protocol's status for a submit after the last possible one."""
MAX_DEATHS = 2
"""Number of gateway crashes over one submit, or over one episode's files, after which it is abandoned."""
_REQUEST_STATUSES = (Refusal.BUDGET_INVALID, Refusal.INVALID_ENV_INSTANCE)


class _Fetched(NamedTuple):
    """An episode and the bytes of its files."""

    episode: EpisodeFeedback
    trajectory: bytes = b""
    video: bytes | None = None
    why: str = ""
    """Why the bytes are missing."""


class _Linger:
    """The pauses of one submit: each is half of the time that the episodes left will take at the pace so far.

    So a submit needs few pages, and its last episodes are not kept waiting.
    """

    def __init__(self, n_episodes: int, now: float) -> None:
        """`now`, here and below: monotonic time, seconds."""
        self._n = n_episodes
        self._began = now
        self._first: tuple[int, float] | None = None
        """Episodes of the first page, and the time of its arrival."""

    def pause_s(self, n_done: int, now: float) -> float:
        """Seconds to wait once `n_done` episodes are written."""
        if not n_done:
            return 0.0
        if self._first is None:
            self._first = n_done, now
        n_first, at = self._first
        if n_done == n_first:
            # The pace is not known yet.
            pause_s = min(FIRST_LINGER_S, (now - self._began) / 2)
        else:
            pause_s = (self._n - n_done) * (now - at) / (n_done - n_first) / 2
        return min(pause_s, LONGEST_LINGER_S) if pause_s >= SHORTEST_LINGER_S else 0.0


def _is_whole(episode: EpisodeFeedback) -> bool:
    """Whether the result page contains the episode's bytes."""
    refs = (episode.trajectory, episode.video)
    return all(ref is None or ref.inline is not None for ref in refs)


def _rejection(odd: OddRequestError) -> Rejection:
    status = odd.answer.status
    assert status != "bad_request"
    return Rejection(status=status, message=odd.message, folder=odd.answer.folder)


class SubmitPipeline:
    """Takes submits for one run, on one event loop."""

    def __init__(
        self,
        client: CoordinatorClient,
        run: RunOpened,
        workspace: Path,
        journal: Journal,
        blobs: BlobStore,
        on_change: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """`on_change` is called after every change that a watcher shows; `clock` returns Unix time, seconds."""
        self.run = run
        self.state: RunState = run.state
        """The state known to this gateway; `refresh` updates it."""
        self.closed = run.state.is_finalized
        self.cancelled = run.state.cancelled
        """The operator has cancelled the run."""
        self.fatal: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Fails with the error that ends this process."""
        self.in_flight: Ticket | None = None
        self.tickets: list[Ticket] = []
        """Accepted submits by index, followed by at most one that is not accepted yet."""
        self.n_rejected = 0
        self.in_flight_s = 0.0
        """Seconds in which a submit was in flight, in this process."""
        self.held_s = run.state.held_s
        """Seconds for which submits of the run waited because hidden episodes used the machines."""
        self.feedback_s = 0.0
        """Of `in_flight_s`, seconds from the last result's arrival to the committed feedback."""
        self._client = client
        self._workspace = workspace
        self._journal = journal
        self._blobs = blobs
        self._on_change = on_change
        self._clock = clock
        self._uploaded: str | None = None
        """The bundle that the coordinator accepted a submit of last, in this process."""
        self._task: asyncio.Task[None] | None = None
        self._journal_lock = asyncio.Lock()
        self._much = threading.Lock()
        """Held while the files of a large episode are made: a hostile worker's may take a gigabyte each."""
        self._deaths: Counter[tuple[str, int | None]] = Counter()
        """Number of gateways that died over an episode of a submit, or (None) over the submit as a whole."""
        self._write_down_deaths()
        self._recover()

    @property
    def spent(self) -> bool:
        """Whether no further submit is possible, and none runs."""
        too_little = self.state.remaining_budget < max(1, self.run.min_episodes_per_submit)
        return self.in_flight is None and (too_little or self.closed)

    @property
    def last_warning(self) -> str | None:
        """The warning of the last answered submit about its policy; None when the policy did not fail."""
        answered = (ticket for ticket in reversed(self.tickets) if ticket.status is not None)
        last = next(answered, None)
        return None if last is None else last.warning

    @property
    def _texts(self) -> bool:
        """Whether the feedback has the policy's own texts."""
        return shows_texts(self.run.feedback, self.run.env.obs_storage)

    def bounds(self) -> Bounds:
        """The current limits of a submit."""
        return Bounds(
            n_env_instances=self.run.n_env_instances,
            min_episodes=self.run.min_episodes_per_submit,
            max_episodes=self.run.max_episodes_per_submit,
            remaining_budget=self.state.remaining_budget,
        )

    async def submit(self, body: bytes, client_key: str | None) -> Ticket:
        """Takes a request, or returns the ticket of the one that it repeats.

        Raises RequestError (refused, nothing charged) and ConflictError (another submit runs, or the key belongs to
        another body).
        """
        body_digest = digest_of(body)
        if client_key is not None:
            for ticket in self.tickets:
                if ticket.request.client_key == client_key:
                    if ticket.request.body_digest != body_digest:
                        raise ConflictError(
                            ticket.index,
                            f"this Idempotency-Key was used for {ticket.submit_id} with another body; use a new key",
                        )
                    return ticket
        try:
            if self.in_flight is not None:
                raise ConflictError(
                    self.in_flight.index,
                    f"{self.in_flight.submit_id} is running; wait for it, or ask GET /submit/{self.in_flight.index}",
                )
            ids = self._ids(body)
            odd = None
        except RequestError as error:
            if not (isinstance(error, OddRequestError) and error.answer.counts):
                await self.note_rejected(error)
                raise
            ids, odd = error.ids, error
        ticket = Ticket(
            Requested(
                key=uuid.uuid4().hex,
                client_key=client_key,
                body_digest=body_digest,
                env_instances=() if odd is not None else tuple(map(int, ids)),
                bundle=None,
                bundle_error=None,
                echoed=ids if odd is not None or any(type(each) is bool for each in ids) else None,
                rejected=None if odd is None else _rejection(odd),
            ),
            len(self.tickets),
            self.run.episode_budget,
        )
        # No await between the checks above and this call: two requests cannot both pass.
        self._start(ticket, fresh=True)
        if odd is not None:
            await self.note_rejected(odd)
        return ticket

    def _ids(self, body: bytes) -> tuple[int, ...]:
        """The train ids of a request to be played. Raises RequestError for any other."""
        asked = None if self.run.profile == "own" else published_requests.read(body)
        if self.spent:
            raise self._refusal()
        return parse(body, self.bounds()) if asked is None else published_requests.check(asked, self.bounds())

    def find(self, name: str) -> Ticket | None:
        """Returns the submit with that index or folder name; None when there is none."""
        return next(
            (ticket for ticket in self.tickets if name in (str(ticket.index), ticket.submit_id)), None
        )

    async def note_rejected(self, error: RequestError) -> None:
        """Records a refused request for `run.json`."""
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
        """Returns the coordinator's state of the run, or the last known one when it does not answer at once."""
        try:
            state = await self._client.state()
        except RefusedError as error:
            self._refused(error)
            state = None
        # While a submit is being sent, this answer may be older than its acceptance.
        if state is not None and state.n_submits >= self.state.n_submits:
            self.state = state
            self.held_s = max(self.held_s, state.held_s)
            self._close(state.is_finalized, state.cancelled)
        return self.state

    async def idle(self) -> None:
        """Waits until no submit runs."""
        while self._task is not None and not self._task.done():
            await asyncio.wait([self._task])

    async def stop(self) -> None:
        """Leaves the submit in flight to the next gateway."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _write_down_deaths(self) -> None:
        """Journals the episodes over which the last process died."""
        left = self._journal.at_work
        for key in dict.fromkeys(key for key, _ in left.died_over):
            episodes = tuple(index for of, index in left.died_over if of == key)
            log.warning("the last gateway crashed on the files of an episode", submit=key, episodes=episodes)
            died = Died(key=key, episodes=episodes)
            self._journal.append(died)
            self._count_deaths(died)
        left.clear()

    def _count_deaths(self, died: Died) -> None:
        self._deaths.update((died.key, index) for index in died.episodes or (None,))

    def _recover(self) -> None:
        """Rebuilds the tickets from the journal and resumes the unfinished one."""
        by_key: dict[str, Ticket] = {}
        for place, entry in zip(self._journal.places, self._journal.entries, strict=True):
            if isinstance(entry, Requested):
                by_key[entry.key] = ticket = Ticket(entry, len(self.tickets), self.run.episode_budget)
                self.tickets.append(ticket)
            elif isinstance(entry, Accepted):
                by_key[entry.key].accept(entry)
            elif isinstance(entry, Settled):
                self._settle(by_key[entry.key], entry, place)
            elif isinstance(entry, Refused):
                self.tickets.remove(by_key.pop(entry.key))
            elif isinstance(entry, Rejected):
                self.n_rejected += 1
            elif isinstance(entry, Died):
                self._count_deaths(entry)
            elif isinstance(entry, SetAside):
                ticket = by_key[entry.key]
                ticket.fail(RequestError("gateway_failed", entry.message))
                if ticket.accepted is None:
                    self.tickets.remove(ticket)
            elif isinstance(entry, Closed):
                self.closed = True
        self._journal.forget()
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
            if ticket.request.rejected is None or ticket.request.rejected.folder:
                await self._collect(ticket)
            else:
                await self._settled(ticket, ticket.request.rejected.status, b"")
        except RequestError as error:
            self.tickets.remove(ticket)
            ticket.fail(error)
        except RefusedError as error:
            if error.status in RUN_OVER:
                self._refused(error)
                ticket.fail(self._refusal(RUN_CLOSED if ticket.accepted is None else "closed"))
            elif not await self._abandon(ticket, error):
                return
        except Exception as error:
            if not await self._abandon(ticket, error):
                return
        self.in_flight_s += time.monotonic() - started
        self.in_flight = None
        self._on_change()

    async def _abandon(self, ticket: Ticket, error: Exception) -> bool:
        """True when the submit is abandoned. The first failure ends this gateway; the next gateway retries."""
        key = ticket.request.key
        log.error("submit failed", submit=ticket.submit_id, exc_info=error)
        self._deaths[key, None] += 1
        await self._note(Died(key=key))
        if self._deaths[key, None] < MAX_DEATHS:
            if not self.fatal.done():
                self.fatal.set_exception(error)
            return False
        charged = "it was not accepted" if ticket.accepted is None else "its episodes are charged and count"
        message = f"the gateway failed {MAX_DEATHS} times on this submit and gives it no feedback; {charged}"
        await self._note(SetAside(key=key, message=message))
        if ticket.accepted is None:
            self.tickets.remove(ticket)
        ticket.fail(RequestError("gateway_failed", message))
        return True

    async def _snapshot(self, ticket: Ticket) -> None:
        """Takes the bundle of the current `system/`, unless nothing is to be played, and journals the request."""
        while ticket.request.rejected is None:
            try:
                taken = await asyncio.to_thread(
                    snapshots.take,
                    self._workspace / "system",
                    self._blobs,
                    published=self.run.profile != "own",
                )
                ticket.attach(taken)
                break
            except StorageError as error:
                log.error("cannot store the snapshot; trying again", error=str(error))
                await asyncio.sleep(DISK_PAUSE_S)
        await self._note(ticket.request)

    async def _send(self, ticket: Ticket) -> None:
        """Uploads the bundle and waits until the submit is accepted. Raises RequestError when it is refused."""
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
            known = request.bundle is None or request.bundle == self._uploaded
            if request.bundle is not None and not known:
                data = await asyncio.to_thread(self._blobs.read, request.bundle)
                await self._client.upload(request.bundle, data)
            try:
                reply = await self._client.submit(request)
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

    def _charged(self, accepted: Accepted) -> None:
        self.state = RunState(
            remaining_budget=accepted.remaining_budget,
            n_submits=accepted.submit_index + 1,
            is_finalized=self.state.is_finalized,
        )

    async def _collect(self, ticket: Ticket) -> None:
        """Writes the feedback tree from the results; starts over when the disk refuses."""
        while True:
            try:
                status, summary = await self._write_feedback(ticket)
                break
            except (OSError, StorageError) as error:
                # Without the error's paths: an agent reads this text.
                why = error.strerror if isinstance(error, OSError) else None
                ticket.waits_for = f"the gateway cannot write feedback: {why or 'its disk refuses'}"
                log.error("cannot write feedback; trying again", submit=ticket.submit_id, error=str(error))
                self._on_change()
                await asyncio.sleep(DISK_PAUSE_S)
        await self._settled(ticket, status, summary)

    async def _settled(self, ticket: Ticket, status: str, summary: bytes) -> None:
        """Journals a submit's end, and tells those who wait for it."""
        entry = Settled(key=ticket.request.key, status=status, summary=summary.decode())
        self._settle(ticket, entry, await self._note(entry))
        log.info("submit committed", submit=ticket.submit_id, status=status)

    def _settle(self, ticket: Ticket, entry: Settled, place: int) -> None:
        if entry.summary:
            ticket.settle(entry.status, entry.summary.encode(), self._summary_at(place))
        else:
            assert ticket.request.rejected is not None
            ticket.fail(RequestError(entry.status, ticket.request.rejected.message))

    async def _write_feedback(self, ticket: Ticket) -> tuple[str, bytes]:
        """Returns status and summary of the committed folder."""
        assert ticket.accepted is not None
        index, first = ticket.accepted.submit_index, ticket.accepted.first_global_episode
        tree = SubmitTree(self._workspace / "feedback", ticket.submit_id)
        await asyncio.to_thread(tree.begin)
        scores: dict[int, EpisodeScore] = {}
        cursor, held_before = 0, self.held_s
        done: SubmitDone | None = None
        linger = _Linger(len(ticket.request.env_instances), time.monotonic())
        while done is None:
            page = await self._client.results(
                index, cursor, HELD_WAIT_S if ticket.waits_for else RESULTS_WAIT_S
            )
            cursor, done = page.cursor, page.done
            await self._write_page(tree, ticket.request.key, page, first, scores)
            self.held_s = max(self.held_s, page.held_s)
            ticket.n_done, ticket.waits_for = len(scores), page.waits_for
            ticket.held_s = self.held_s - held_before
            self._on_change()
            if done is None and not page.more:
                await asyncio.sleep(linger.pause_s(len(scores), time.monotonic()))
        last_result = time.monotonic()
        committed = await asyncio.to_thread(self._commit, tree, ticket, done, scores)
        if done.status == CANCELLED:
            self.state = msgspec.structs.replace(self.state, remaining_budget=done.remaining_budget)
            self._close(True, True)
        self.feedback_s += time.monotonic() - last_result
        return committed

    async def _write_page(
        self, tree: SubmitTree, key: str, page: ResultsPage, first: int, scores: dict[int, EpisodeScore]
    ) -> None:
        gate = asyncio.Semaphore(FETCHES_AT_ONCE)
        wanted = [episode for episode in page.episodes if episode.index not in scores]
        # Episodes over which a gateway died are written alone, so that no other episode is blamed.
        suspects = [episode for episode in wanted if self._deaths[key, episode.index]]
        # One thread call writes all episodes that came with the page; the others are written as their bytes arrive.
        whole = [episode for episode in wanted if _is_whole(episode) and episode not in suspects]
        others = [episode for episode in wanted if not _is_whole(episode) and episode not in suspects]

        async def write(episodes: list[EpisodeFeedback]) -> None:
            async with gate:
                fetched = [await self._fetched(key, episode) for episode in episodes]
                await asyncio.to_thread(self._put, tree, key, first, fetched)
                for episode in episodes:
                    scores[episode.index] = EpisodeScore(
                        index=episode.index,
                        episode_return=episode.episode_return,
                        length=episode.length,
                        failure=episode.failure,
                        reward_components=episode.reward_components,
                        success=episode.success,
                    )

        # All writes end before an error is raised: none may write into a tree that is started over.
        writes = [write(whole), *(write([episode]) for episode in others)]
        for outcome in await asyncio.gather(*writes, return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome
        for episode in suspects:
            await write([episode])

    async def _fetched(self, key: str, episode: EpisodeFeedback) -> _Fetched:
        """Fetches an episode's bytes. Leaves them out when they are missing or damaged, or gateways died over them."""
        if self._deaths[key, episode.index] >= MAX_DEATHS:
            why = f"the gateway ended {MAX_DEATHS} times while it wrote this episode's trajectory"
            return _Fetched(episode, why=why)
        if self.run.feedback == "scores":
            return _Fetched(episode)
        try:
            trajectory = await self._client.fetch(episode.trajectory)
            video = None if episode.video is None else await self._client.fetch(episode.video)
        except RefusedError as error:
            if error.status != Refusal.UNKNOWN_BLOB:
                raise
            return _Fetched(episode, why="this episode's trajectory or video is not stored any more")
        except ProtocolError as error:
            log.error(
                "an episode's bytes are not what they should be",
                submit=key,
                index=episode.index,
                exc_info=error,
            )
            return _Fetched(episode, why="this episode's trajectory cannot be written")
        return _Fetched(episode, trajectory, video)

    def _put(self, tree: SubmitTree, key: str, first: int, fetched: list[_Fetched]) -> None:
        """Writes episodes' folders one after another."""
        for each in fetched:
            name = episode_name(first + each.episode.index, self.run.episode_budget)
            with self._much if takes_much(each.trajectory) else contextlib.nullcontext():
                if files := self._files_of(key, each):
                    tree.put_episode(name, files)

    def _files_of(self, key: str, fetched: _Fetched) -> dict[str, bytes]:
        """Returns an episode's files; without its trajectory if that is missing or has another length or return."""
        episode, at = fetched.episode, self._clock()
        why = fetched.why
        if not why:
            try:
                with self._journal.at_work.on(key, episode.index):
                    return episode_files(
                        episode,
                        fetched.trajectory,
                        fetched.video,
                        self.run.env.obs_storage,
                        at=at,
                        share=episode_share(self.run.limits, self.run.episode_budget),
                        detail=self.run.feedback,
                        published=self.run.profile != "own",
                    )
            except (ProtocolError, MemoryError, ValueError, TypeError, RecursionError) as error:
                log.error(
                    "an episode's files cannot be made", submit=key, index=episode.index, exc_info=error
                )
                why = "this episode's trajectory cannot be written"
        log.error("episode put aside", submit=key, index=episode.index, why=why)
        return set_aside_files(episode, why, at=at, texts=self._texts)

    def _commit(
        self, tree: SubmitTree, ticket: Ticket, done: SubmitDone, scores: dict[int, EpisodeScore]
    ) -> tuple[str, bytes]:
        errors, rejected, own = None, ticket.request.rejected, self.run.profile == "own"
        if done.status != "ok":
            errors = formatting.verdict_line(
                done.status,
                done.failure,
                done.completed_at,
                message="" if rejected is None else rejected.message,
                traceback=own,
            )
            for late in [i for i in scores if i >= done.n_kept]:
                tree.drop_episode(episode_name(done.first_global_episode + late, self.run.episode_budget))
        summary = formatting.summary_bytes(
            self.run.env.env,
            ticket.index,
            done,
            list(scores.values()),
            self.run.observations,
            messages=self._texts,
            echoed=ticket.request.echoed,
            every_key=not own,
        )
        tree.commit(summary, errors)
        return done.status, summary

    def _refused(self, error: RefusedError) -> None:
        if not self.closed:
            log.warning("the run accepts no more submits", status=error.status, why=error.message)
        self._close(True, error.status == Refusal.RUN_CANCELLED)

    def _close(self, closed: bool, cancelled: bool) -> None:
        """If `closed`, takes no more submits; `cancelled`: because the operator cancelled the run."""
        if closed and not (self.closed and (self.cancelled or not cancelled)):
            self.closed, self.cancelled = True, self.cancelled or cancelled
            self._on_change()

    def _refusal(self, status: str = RUN_CLOSED) -> RequestError:
        """The refusal of a submit to a closed or spent run."""
        if self.cancelled:
            return RequestError(CANCELLED, "the operator cancelled the run: no more submits are taken")
        why = "the run is closed" if self.closed else "the episode budget is spent"
        return RequestError(status, f"{why}: no more submits are taken")

    def _summary_at(self, place: int) -> Callable[[], bytes]:
        """Returns a reader of the journalled summary; the copy in the feedback may have been lost by the agent."""

        def load() -> bytes:
            entry = self._journal.read(place)
            assert isinstance(entry, Settled)
            return entry.summary.encode()

        return load

    async def _note(self, entry: AnyEntry) -> int:
        """Appends to the journal off the event loop, in order; returns the offset. Retries while the disk refuses."""
        async with self._journal_lock:
            while True:
                try:
                    return await asyncio.to_thread(self._journal.append, entry)
                except StorageError as error:
                    log.error("cannot write the journal; trying again", error=str(error))
                await asyncio.sleep(DISK_PAUSE_S)
