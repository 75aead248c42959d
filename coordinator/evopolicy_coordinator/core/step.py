"""One step of the core: what one event, or one deadline, leads to. Its effects, its news and its marks are values here.

Rules that this module owns:
- Whatever rows a step makes durable stand in a single `Persist` ahead of all its other effects, so no reply can tell of
  something that a crash would take back.
- A rule calls what it builds on, never what builds on it: leases do not know runs. What happened goes upwards as news,
  for which `machine` has a table. What follows from a piece of news comes before what was told after it.
- Work that became available is marked (`dirty`, `State.freed`); the scheduler looks at the marks when the step ends.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import msgspec

from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.worker import JobResult, Message
from evopolicy_common.wire.refusals import Refusal

from . import transitions
from .effects import Effect, Log, Persist, Refuse, Reply
from .events import RequestId
from .model import Flow, JobGroup, JobState, Lane, Profile, Run, Worker
from .reasons import Reason
from .records import AuditRow, Row, SubmitRow

# ---- news ----
#
# `kind` is what the table in `machine` tells apart beside the type; empty where there is but one.


@dataclass(slots=True, eq=False)
class ResultsPersisted:
    """A worker reported what came of one lease."""

    worker: Worker
    result: JobResult

    kind: ClassVar[str] = ""


@dataclass(slots=True, eq=False)
class EpisodesDone:
    """Episodes of a group have their outcomes."""

    group: JobGroup
    worker: Worker | None
    """Who played them; None: before the core was loaded."""
    outcomes: tuple[EpisodeOutcome, ...]

    @property
    def kind(self) -> str:
        """Of the group."""
        return self.group.kind


@dataclass(slots=True, eq=False)
class JobRetried:
    """A job is played again for a failure of ours."""

    job: JobState

    kind: ClassVar[str] = ""


@dataclass(slots=True, eq=False)
class ResultsDiffered:
    """Two results of one episode differed."""

    group: JobGroup

    kind: ClassVar[str] = ""


@dataclass(slots=True, eq=False)
class FlowPinned:
    """A run or an evaluation has a class of workers now."""

    flow: Flow
    profile: Profile

    @property
    def kind(self) -> str:
        """Of the flow."""
        return self.flow.of


@dataclass(slots=True, eq=False)
class SubmitEnded:
    """A submit has its verdict."""

    run: Run
    row: SubmitRow

    kind: ClassVar[str] = ""


@dataclass(slots=True, eq=False)
class AuditsMoved:
    """An audit of a run is over, or goes on: the run may have waited for it."""

    run: Run

    kind: ClassVar[str] = ""


News = ResultsPersisted | EpisodesDone | JobRetried | ResultsDiffered | FlowPinned | SubmitEnded | AuditsMoved


# ---- steps ----


class Step:
    """Collects the effects of one step, its news, and what is to be looked at when it ends."""

    __slots__ = ("_out", "_rows", "dirty", "last", "news", "now", "stimulus_id", "stops")

    def __init__(self, now: float, stimulus_id: str) -> None:
        self.now = now
        self.stimulus_id = stimulus_id
        self._rows: list[Row] = []
        self._out: list[Effect] = []
        self.news: deque[News] = deque()
        """What those above are to hear, in order."""
        self.last: Reply | None = None
        """What is answered once the news was told."""
        self.dirty: dict[Lane, None] = {}
        """Lanes in which something waits that did not before."""
        self.stops: dict[str, list[str]] = {}
        """Workers to the leases that they are to stop."""

    def tell(self, news: News) -> None:
        """Let those above hear of something once the present rule has done its part."""
        self.news.append(news)

    # ---- effects ----

    def persist(self, row: Row) -> None:
        """Make a row durable before anything else that this step does."""
        self._rows.append(row)

    def add(self, effect: Effect) -> None:
        """Let the shell do something once the rows are durable."""
        self._out.append(effect)

    def reply(self, request: RequestId, message: Message, waits_for: Reason | None = None) -> None:
        """Answer a request; the shell puts what is waited for into the message's words."""
        effect = Reply(request=request, message=message, waits_for=waits_for, stimulus_id=self.stimulus_id)
        self._out.append(effect)

    def reply_last(self, request: RequestId, message: Message) -> None:
        """Answer a request after what it led to; one in a step."""
        self.last = Reply(request=request, message=message, stimulus_id=self.stimulus_id)

    def refuse(self, request: RequestId, status: Refusal, reason: Reason) -> None:
        """Answer a request with the reason why it is not carried out."""
        effect = Refuse(request=request, status=status, reason=reason, stimulus_id=self.stimulus_id)
        self._out.append(effect)

    def log(self, level: Literal["debug", "info", "warning", "error"], event: str, **fields: Any) -> None:
        """Tell operators."""
        self._out.append(Log(level=level, event=event, fields=fields, stimulus_id=self.stimulus_id))

    def effects(self) -> list[Effect]:
        """All effects in order: the rows first."""
        if not self._rows:
            return self._out
        first: Effect = Persist(rows=tuple(self._rows), stimulus_id=self.stimulus_id)
        return [first, *self._out]

    # ---- durable changes ----

    def change_run(self, run: Run, **fields: object) -> None:
        """Change what is stored of a run."""
        before, run.state = run.state, msgspec.structs.replace(run.state, **fields)
        if run.state.phase != before.phase:
            transitions.check(transitions.RUN, run.id, before.phase, run.state.phase)
        self.persist(run.state)

    def change_submit(self, run: Run, index: int, **fields: object) -> SubmitRow:
        """Change what is stored of a submit."""
        before = run.submits[index]
        row = run.submits[index] = msgspec.structs.replace(before, **fields)
        if row.status != before.status:
            key = f"{run.id}/s{index}"
            transitions.check(transitions.SUBMIT, key, before.status or "open", row.status or "open")
        self.persist(row)
        return row

    def put_audit(self, run: Run, row: AuditRow) -> AuditRow:
        """Store an audit, anew or as it is now."""
        before = run.audits.get(row.audit)
        if before is not None and row.state != before.state:
            transitions.check(transitions.AUDIT, row.audit, before.state, row.state)
        run.audits[row.audit] = row
        self.persist(row)
        return row
