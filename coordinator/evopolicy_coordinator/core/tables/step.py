"""One step of the core: the consequences of one event or one deadline. Its effects, news and marks are values here.

Rules that this module owns:
- All rows that a step makes durable are in a single `Persist` ahead of all its other effects, so no reply reports a
  change that a crash would undo.
- A rule calls rules that it builds on, never rules that build on it: leases do not know runs. It reports upwards by
  news, for which `machine` has a table. The consequences of a piece of news come before the pieces queued after it.
- Work that became available is marked (`dirty`, `State.freed`); the scheduler processes the marks at the end of the
  step.
"""

from __future__ import annotations

from collections import deque
from typing import Literal, NamedTuple

import msgspec

from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.worker import JobResult, Message
from evopolicy_coordinator.core.contract.effects import Effect, Log, Persist, Refuse, Reply
from evopolicy_coordinator.core.contract.events import RequestId
from evopolicy_coordinator.core.contract.reasons import Reason
from evopolicy_coordinator.core.contract.records import Row, SubmitRow
from evopolicy_coordinator.core.tables import model
from evopolicy_coordinator.core.tables.model import Flow, JobGroup, JobState, Lane, Profile, Run, Worker

# ---- news ----
#
# The table in `machine` distinguishes news by type, and by `kind` where a type has several.


class ResultReported(NamedTuple):
    """A worker reported the result of one lease."""

    worker: Worker
    result: JobResult


class EpisodesDone(NamedTuple):
    """Episodes of a group have their outcomes."""

    group: JobGroup
    worker: Worker | None
    """The player; None when the outcomes were stored before the core was loaded."""
    outcomes: tuple[EpisodeOutcome, ...]

    @property
    def kind(self) -> str:
        """Of the group."""
        return self.group.kind


class JobRetried(NamedTuple):
    """A job is played again after an infrastructure failure."""

    job: JobState
    worker: str
    failure: str
    """As `leasing.jobs.JobFailure`."""


class EnvironmentFailed(NamedTuple):
    """The environment has ended so many attempts at a job that it is given up."""

    group: JobGroup
    error: str

    @property
    def kind(self) -> str:
        """Of the group."""
        return self.group.kind


class ResultsDiffered(NamedTuple):
    """Two results of one episode differed."""

    group: JobGroup


class FlowPinned(NamedTuple):
    """A run or an evaluation was pinned to a class of workers."""

    flow: Flow
    profile: Profile

    @property
    def kind(self) -> str:
        """Of the flow."""
        return self.flow.of


class SubmitEnded(NamedTuple):
    """A submit got its verdict."""

    run: Run
    row: SubmitRow


class AgentOverdue(NamedTuple):
    """A run's agent has kept hidden jobs of closed runs from their kernels for too long."""

    run: Run


News = (
    ResultReported
    | EpisodesDone
    | JobRetried
    | EnvironmentFailed
    | ResultsDiffered
    | FlowPinned
    | SubmitEnded
    | AgentOverdue
)


# ---- steps ----


class CoreStep:
    """Collects the effects of one step, its news, and the marks for the scheduler."""

    __slots__ = ("_out", "_rows", "dirty", "grown", "last", "news", "now", "stimulus_id", "stops")

    def __init__(self, now: float, stimulus_id: str) -> None:
        self.now = now
        self.stimulus_id = stimulus_id
        self._rows: list[Row] = []
        self._out: list[Effect] = []
        self.news: deque[News] = deque()
        self.last: Reply | None = None
        """The reply that is sent after the news was delivered."""
        self.grown: dict[JobGroup, None] = {}
        """Open groups with new results, whose polls are answered once for all results of the step."""
        self.dirty: dict[Lane, None] = {}
        """Lanes with newly waiting jobs."""
        self.stops: dict[str, list[str]] = {}
        """Worker to the leases that it is to stop."""

    def tell(self, news: News) -> None:
        """Queue a piece of news for delivery after the present rule."""
        self.news.append(news)

    # ---- effects ----

    def persist(self, row: Row) -> None:
        """Make a row durable before all other effects of this step."""
        self._rows.append(row)

    def add(self, effect: Effect) -> None:
        """Carry out an effect once the rows are durable."""
        self._out.append(effect)

    def reply(self, request: RequestId, message: Message, waits_for: Reason | None = None) -> None:
        """Answer a request; the shell puts `waits_for` into the message's words."""
        self._out.append(Reply(request=request, message=message, waits_for=waits_for))

    def reply_last(self, request: RequestId, message: Message) -> None:
        """Answer a request after the effects of its news; at most one per step."""
        self.last = Reply(request=request, message=message)

    def refuse(self, request: RequestId, reason: Reason) -> None:
        """Answer a request with the reason why it is not carried out."""
        self._out.append(Refuse(request=request, reason=reason))

    def log(self, level: Literal["debug", "info", "warning", "error"], event: str, **fields: object) -> None:
        self._out.append(Log(level=level, event=event, fields=fields, stimulus_id=self.stimulus_id))

    def effects(self) -> list[Effect]:
        """All effects in order: the rows first."""
        if not self._rows:
            return self._out
        first: Effect = Persist(rows=tuple(self._rows))
        return [first, *self._out]

    # ---- durable changes ----

    def change_run(self, run: Run, **fields: object) -> None:
        """Change a run's stored state; raises InvariantError when the new phase may not follow the old one."""
        before, run.state = run.state, msgspec.structs.replace(run.state, **fields)
        if run.state.phase != before.phase:
            model.check(model.RUN, run.id, before.phase, run.state.phase)
        self.persist(run.state)

    def change_submit(self, run: Run, index: int, **fields: object) -> SubmitRow:
        """Change a stored submit; raises InvariantError when the new status may not follow the old one."""
        before = run.submits[index]
        row = run.submits[index] = msgspec.structs.replace(before, **fields)
        if row.status != before.status:
            key = f"{run.id}/s{index}"
            model.check(model.SUBMIT, key, before.status or "open", row.status or "open")
        self.persist(row)
        return row
