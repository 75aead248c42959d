"""A submit's feedback: the pages of its results become `submit_NNN.partial/`, and one rename `submit_NNN/`.

- Everything in a folder is durable before the rename; `summary.json` is written last.
- A folder without `.partial` is complete and never changes.
- Anything that an agent has put in the way is removed, never followed.
- A `.partial` folder need not be durable, because it is rewritten after a crash: one flush of the file system
  at the end covers all its files.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import stat
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from evopolicy_common.errors import ProtocolError, RefusedError
from evopolicy_common.logs import log
from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.gateway import EpisodeFeedback, ResultsPage, SubmitAccepted, SubmitDone
from evopolicy_common.processes.left_files import left_files
from evopolicy_common.processes.scratch import give_back_rights, remove_tree
from evopolicy_common.records.blobs import fsync_directory, sync_filesystem
from evopolicy_common.refusals import Refusal
from evopolicy_common.regular_files import open_regular
from evopolicy_gateway.run_folder.journal import AtWork, write_all
from evopolicy_gateway.run_folder.layout import episode_name
from evopolicy_gateway.submits import formatting
from evopolicy_gateway.submits.coordinator_client import HELD_WAIT_S, RESULTS_WAIT_S, CoordinatorClient
from evopolicy_gateway.submits.episode_files import (
    episode_files,
    episode_share,
    set_aside_files,
    shows_texts,
    takes_much,
)
from evopolicy_gateway.submits.tickets import MAX_DEATHS, Ticket, TicketMachine

SUMMARY = "summary.json"
FIRST_LINGER_S = 0.02
LONGEST_LINGER_S = 0.1
SHORTEST_LINGER_S = 0.002
"""Bounds of the pause before the next request, which collects several results of short episodes, seconds."""
FETCHES_AT_ONCE = 4
_NOT_WRITTEN = "this episode's trajectory cannot be written"
_NOTHING = BlobRef(digest="", size=0)
"""The trajectory of an episode whose files are written."""
_Fetched = tuple[bytes, bytes | None] | str
"""The bytes of an episode's trajectory and video, or why they are missing."""
_much = threading.Lock()
"""Held while the files of a large episode are made: a hostile worker's may take a gigabyte each."""


class SubmitTree:
    """One submit's folder while it is written. Not thread-safe; every call may block on the disk and raise OSError.

    After an OSError, call `begin` and write everything again.
    """

    def __init__(self, feedback: Path, submit_id: str) -> None:
        self._feedback = feedback
        self._partial = feedback / f"{submit_id}.partial"
        self._episodes = str(self._partial / "episodes")
        self.final = feedback / submit_id

    def begin(self) -> None:
        """Creates an empty `.partial` folder, replacing an earlier one."""
        give_back_rights(self._feedback.parent)
        if self._feedback.is_symlink() or not self._feedback.is_dir():
            _remove(self._feedback)
            self._feedback.mkdir(parents=True)
        _remove(self._partial)
        (self._partial / "episodes").mkdir(parents=True)

    def put_episode(self, name: str, files: Mapping[str, bytes]) -> None:
        """Writes an episode's folder with its files; the folder appears complete."""
        # Texts, not `Path`: a run has thousands of episodes.
        hidden, shown = f"{self._episodes}/.{name}", f"{self._episodes}/{name}"
        try:
            os.mkdir(hidden)
        except FileExistsError:
            _remove(Path(hidden))
            os.mkdir(hidden)
        for file_name, data in files.items():
            _write(f"{hidden}/{file_name}", data)
        try:
            os.rename(hidden, shown)
        except OSError:
            # The name is taken: its entry is removed, never followed.
            _remove(Path(shown))
            os.rename(hidden, shown)

    def drop_episode(self, name: str) -> None:
        _remove(self._partial / "episodes" / name)

    def commit(self, summary: bytes, errors: bytes | None) -> None:
        """Writes `errors.txt` (unless None), then `summary.json`, and renames the folder."""
        if errors is not None:
            _write(self._partial / "errors.txt", errors)
        _write(self._partial / SUMMARY, summary)
        sync_filesystem(self._partial)
        # Left by a gateway that died between the rename and its journal entry, or put there by the agent.
        _remove(self.final)
        self._partial.rename(self.final)
        fsync_directory(self._feedback)


class Linger:
    """The pauses of one submit: each is half of the time that the remaining episodes take at the pace so far.

    So a submit needs few pages, and its last episodes do not wait.
    """

    def __init__(self, n_episodes: int, now: float) -> None:
        """`now`, here and below: monotonic time, seconds."""
        self._n, self._began = n_episodes, now
        self._first = 0, now
        """Episodes of the first page, and the time of its arrival."""

    def pause_s(self, n_done: int, now: float) -> float:
        """Seconds to wait once `n_done` episodes are written."""
        if not self._first[0]:
            self._first = n_done, now
        n_first, at = self._first
        if n_done == n_first:
            # The pace is not known yet.
            pause_s = min(FIRST_LINGER_S, (now - self._began) / 2) if n_done else 0.0
        else:
            pause_s = (self._n - n_done) * (now - at) / (n_done - n_first) / 2
        return min(pause_s, LONGEST_LINGER_S) if pause_s >= SHORTEST_LINGER_S else 0.0


@dataclass
class Collector:
    """Writes one submit's folder, from the first page of its results to the committed summary."""

    machine: TicketMachine
    ticket: Ticket
    accepted: SubmitAccepted
    client: CoordinatorClient
    tree: SubmitTree
    at_work: AtWork
    on_page: Callable[[], None]
    """Called when a page is written, and counted in `machine`."""
    scores: dict[int, EpisodeFeedback] = field(default_factory=dict)
    """Episodes written so far, without their bytes, by request index."""

    async def collect(self) -> tuple[SubmitDone, bytes]:
        """Returns the end and the summary of the committed folder. Raises OSError when the disk refuses."""
        machine, ticket, scores = self.machine, self.ticket, self.scores
        await asyncio.to_thread(self.tree.begin)
        cursor, held_before = 0, machine.held_s
        linger = Linger(len(ticket.request.submit.env_instances), time.monotonic())
        while True:
            wait_s = HELD_WAIT_S if ticket.waits_for else RESULTS_WAIT_S
            page = await self.client.results(self.accepted.submit_index, cursor, wait_s)
            cursor = page.cursor
            await self._write_page(page)
            machine.paged(page, len(scores), held_before)
            self.on_page()
            if page.done is not None and (cursor == 0 or len(scores) >= page.done.n_kept):
                break
            if page.done is not None:
                # Its episodes were played again, in another order, by a coordinator that was started on a backup.
                cursor = 0
                continue
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
        suspects: list[EpisodeFeedback] = []
        whole: list[EpisodeFeedback] = []
        others: list[EpisodeFeedback] = []
        for each in wanted:
            inline = all(ref is None or ref.inline is not None for ref in (each.trajectory, each.video))
            died = self.machine.deaths[self.ticket.request.submit.key, each.index]
            (suspects if died else whole if inline else others).append(each)

        async def write(episodes: list[EpisodeFeedback]) -> None:
            async with gate:
                fetched = [(episode, await self._fetch(episode)) for episode in episodes]
                await asyncio.to_thread(self._put, fetched)
                for episode in episodes:
                    self.scores[episode.index] = msgspec.structs.replace(
                        episode, trajectory=_NOTHING, video=None, stdout=b"", stderr=b""
                    )

        # All writes end before an error is raised: none may write into a tree that is started over.
        writes = [write(whole), *(write([episode]) for episode in others)]
        for outcome in await asyncio.gather(*writes, return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome
        for episode in suspects:
            await write([episode])

    async def _fetch(self, episode: EpisodeFeedback) -> _Fetched:
        if self.machine.deaths[self.ticket.request.submit.key, episode.index] >= MAX_DEATHS:
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
        for episode, content in fetched:
            much = not isinstance(content, str) and takes_much(content[0])
            with _much if much else contextlib.nullcontext():
                if files := self._files_of(episode, content):
                    self.tree.put_episode(self._name(episode.index), files)

    def _name(self, index: int) -> str:
        return episode_name(self.accepted.first_global_episode + index, self.machine.run.episode_budget)

    def _files_of(self, episode: EpisodeFeedback, content: _Fetched) -> dict[str, bytes]:
        """An episode's files; without its trajectory if that is missing or has another length or return."""
        run, at = self.machine.run, time.time()
        if not isinstance(content, str):
            try:
                with self.at_work.on(self.ticket.request.submit.key, episode.index):
                    return episode_files(
                        episode,
                        *content,
                        run.env.obs_storage,
                        at=at,
                        share=episode_share(run.limits, run.episode_budget),
                        detail=run.feedback,
                        published=run.profile != "own",
                    )
            except (ProtocolError, MemoryError, ValueError, TypeError, RecursionError) as error:
                self._log_error("an episode's files cannot be made", episode, exc_info=error)
                content = _NOT_WRITTEN
        self._log_error("episode put aside", episode, why=content)
        return set_aside_files(episode, content, at=at, texts=shows_texts(run.feedback, run.env.obs_storage))

    def _log_error(self, event: str, episode: EpisodeFeedback, **facts: object) -> None:
        log.error(event, submit=self.ticket.request.submit.key, index=episode.index, **facts)

    def _commit(self, done: SubmitDone) -> bytes:
        errors, run = None, self.machine.run
        own = run.profile == "own"
        if done.status != "ok":
            errors = formatting.verdict_line(done.status, done.failure, done.completed_at, traceback=own)
            for late in [index for index in self.scores if index >= done.n_kept]:
                self.tree.drop_episode(self._name(late))
        summary = formatting.summary_bytes(
            run.env.env,
            self.ticket.index,
            done,
            list(self.scores.values()),
            run.observations,
            messages=shows_texts(run.feedback, run.env.obs_storage),
            every_key=not own,
        )
        self.tree.commit(summary, errors)
        return summary


def _write(path: Path | str, data: bytes) -> None:
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o444)
    try:
        write_all(fd, data)
    finally:
        os.close(fd)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        remove_tree(path)
        if path.exists():
            raise OSError(errno.ENOTEMPTY, "an entry in feedback/ cannot be removed", str(path))
    else:
        path.unlink(missing_ok=True)


MAX_READ_BYTES = 8 << 30
"""Larger feedback is not counted: an agent without a jail may leave sparse files of any size."""
_INVALID = b'"action_invalid":true'
"""As written by `json_text.rows_text`. Quotes within a text are escaped there, so no text contains these bytes."""


def count_transitions(feedback: Path) -> dict[str, int] | None:
    """Over all recorded train episodes: `steps`, and as `action_invalid` those whose action was outside the action
    space and was repaired. None when the feedback is too large or cannot be read."""
    counts = {"steps": 0, "action_invalid": 0}
    try:
        if not stat.S_ISDIR(os.lstat(feedback).st_mode):
            return None
        files = {
            path: size
            for path, size in left_files(feedback)
            if path.name == "trajectory.jsonl" and path.parent.parent.name == "episodes"
        }
        if sum(files.values()) > MAX_READ_BYTES:
            return None
        for path in files:
            # The file may have become a link or a pipe since it was listed.
            with open_regular(path) as file:
                for line in file:
                    counts["steps"] += line.endswith(b"\n")
                    counts["action_invalid"] += _INVALID in line
    except OSError:
        return None
    return counts
