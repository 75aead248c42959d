"""Writes a submit's feedback from the results, page by page."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec

from evopolicy_common.errors import ProtocolError, RefusedError
from evopolicy_common.logs import structlog
from evopolicy_common.messages.gateway import EpisodeFeedback, ResultsPage, SubmitDone
from evopolicy_common.records.open_run import Accepted
from evopolicy_common.refusals import Refusal
from evopolicy_gateway.run_folder.journal import AtWork
from evopolicy_gateway.run_folder.names import episode_name
from evopolicy_gateway.submits import formatting
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
from evopolicy_gateway.submits.tickets import MAX_DEATHS, Ticket, TicketMachine

log: structlog.stdlib.BoundLogger = structlog.get_logger()

FIRST_LINGER_S = 0.02
LONGEST_LINGER_S = 0.1
SHORTEST_LINGER_S = 0.002
"""Bounds of the pause before the next request, which collects several results of short episodes, seconds."""
FETCHES_AT_ONCE = 4
_NOT_WRITTEN = "this episode's trajectory cannot be written"
_Fetched = tuple[bytes, bytes | None] | str
"""The bytes of an episode's trajectory and video, or why they are missing."""
_much = threading.Lock()
"""Held while the files of a large episode are made: a hostile worker's may take a gigabyte each."""


class Linger:
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


@dataclass
class Collector:
    """Writes one submit's folder, from the first page of its results to the committed summary."""

    machine: TicketMachine
    ticket: Ticket
    accepted: Accepted
    client: CoordinatorClient
    tree: SubmitTree
    at_work: AtWork
    on_page: Callable[[], None]
    """Called when a page is written, and counted in `machine`."""
    scores: dict[int, EpisodeScore] = field(default_factory=dict)
    """Of the episodes written so far, by request index."""

    @property
    def _texts(self) -> bool:
        """Whether the feedback has the policy's own texts."""
        return shows_texts(self.machine.run.feedback, self.machine.run.env.obs_storage)

    async def collect(self) -> tuple[SubmitDone, bytes]:
        """Returns the end and the summary of the committed folder. Raises OSError when the disk refuses."""
        machine, ticket, scores = self.machine, self.ticket, self.scores
        await asyncio.to_thread(self.tree.begin)
        cursor, held_before = 0, machine.held_s
        linger = Linger(len(ticket.request.env_instances), time.monotonic())
        while True:
            wait_s = HELD_WAIT_S if ticket.waits_for else RESULTS_WAIT_S
            page = await self.client.results(self.accepted.submit_index, cursor, wait_s)
            cursor = page.cursor
            await self._write_page(page)
            machine.paged(page, len(scores), held_before)
            self.on_page()
            if page.done is not None:
                break
            if not page.more:
                await asyncio.sleep(linger.pause_s(len(scores), time.monotonic()))
        last_result = time.monotonic()
        summary = await asyncio.to_thread(self._commit, page.done)
        machine.feedback_s += time.monotonic() - last_result
        return page.done, summary

    async def _write_page(self, page: ResultsPage) -> None:
        gate = asyncio.Semaphore(FETCHES_AT_ONCE)
        wanted = [episode for episode in page.episodes if episode.index not in self.scores]
        # Episodes over which a gateway died are written alone, so that no other episode is blamed. One thread
        # call writes all others that came with the page; the rest are written as their bytes arrive.
        suspects = [episode for episode in wanted if self._deaths_over(episode)]
        whole = [episode for episode in wanted if _is_whole(episode) and episode not in suspects]
        others = [episode for episode in wanted if not _is_whole(episode) and episode not in suspects]

        async def write(episodes: list[EpisodeFeedback]) -> None:
            async with gate:
                fetched = [(episode, await self._fetch(episode)) for episode in episodes]
                await asyncio.to_thread(self._put, fetched)
                for episode in episodes:
                    score = msgspec.convert(episode, EpisodeScore, from_attributes=True)
                    self.scores[episode.index] = score

        # All writes end before an error is raised: none may write into a tree that is started over.
        writes = [write(whole), *(write([episode]) for episode in others)]
        for outcome in await asyncio.gather(*writes, return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome
        for episode in suspects:
            await write([episode])

    def _deaths_over(self, episode: EpisodeFeedback) -> int:
        return self.machine.deaths[self.accepted.key, episode.index]

    async def _fetch(self, episode: EpisodeFeedback) -> _Fetched:
        if self._deaths_over(episode) >= MAX_DEATHS:
            return f"the gateway ended {MAX_DEATHS} times while it wrote this episode's trajectory"
        if self.machine.run.feedback == "scores":
            return b"", None
        try:
            trajectory = await self.client.fetch(episode.trajectory)
            return trajectory, None if episode.video is None else await self.client.fetch(episode.video)
        except RefusedError as error:
            if error.status != Refusal.UNKNOWN_BLOB:
                raise
            return "this episode's trajectory or video is not stored any more"
        except ProtocolError as error:
            self._log_error("an episode's bytes are not what they should be", episode, exc_info=error)
            return _NOT_WRITTEN

    def _put(self, fetched: list[tuple[EpisodeFeedback, _Fetched]]) -> None:
        """Writes episodes' folders one after another."""
        for episode, found in fetched:
            much = not isinstance(found, str) and takes_much(found[0])
            with _much if much else contextlib.nullcontext():
                if files := self._files_of(episode, found):
                    self.tree.put_episode(self._name(episode.index), files)

    def _name(self, index: int) -> str:
        """The folder's name of the episode with that request index."""
        return episode_name(self.accepted.first_global_episode + index, self.machine.run.episode_budget)

    def _files_of(self, episode: EpisodeFeedback, found: _Fetched) -> dict[str, bytes]:
        """An episode's files; without its trajectory if that is missing or has another length or return."""
        run, at = self.machine.run, time.time()
        if not isinstance(found, str):
            try:
                with self.at_work.on(self.accepted.key, episode.index):
                    return episode_files(
                        episode,
                        *found,
                        run.env.obs_storage,
                        at=at,
                        share=episode_share(run.limits, run.episode_budget),
                        detail=run.feedback,
                        published=run.profile != "own",
                    )
            except (ProtocolError, MemoryError, ValueError, TypeError, RecursionError) as error:
                self._log_error("an episode's files cannot be made", episode, exc_info=error)
                found = _NOT_WRITTEN
        self._log_error("episode put aside", episode, why=found)
        return set_aside_files(episode, found, at=at, texts=self._texts)

    def _log_error(self, event: str, episode: EpisodeFeedback, **facts: object) -> None:
        log.error(event, submit=self.accepted.key, index=episode.index, **facts)

    def _commit(self, done: SubmitDone) -> bytes:
        """Commits the folder; returns its summary."""
        errors, request, run = None, self.ticket.request, self.machine.run
        own = run.profile == "own"
        if done.status != "ok":
            text = "" if request.rejected is None else request.rejected.message
            errors = formatting.verdict_line(
                done.status, done.failure, done.completed_at, message=text, traceback=own
            )
            for late in [index for index in self.scores if index >= done.n_kept]:
                self.tree.drop_episode(self._name(late))
        summary = formatting.summary_bytes(
            run.env.env,
            self.ticket.index,
            done,
            list(self.scores.values()),
            run.observations,
            messages=self._texts,
            echoed=request.echoed,
            every_key=not own,
        )
        self.tree.commit(summary, errors)
        return summary
