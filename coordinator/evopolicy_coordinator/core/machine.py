"""The core itself: takes events and deadlines in, lets the rules act, gives ordered effects back.

A step reads top to bottom: the event's rule (`EVENTS`) or the deadline's (`TIMERS`), then the news that it told of, each with
all that follows from it (`NEWS`), then the scheduler, which hands out what became available. What this module owns beside
these tables: that the loop's own lateness expires nobody's lease.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.wire.refusals import Refusal

from . import events, invariants, loading, status, step
from .agents import open_runs, permits, precedence, requests
from .effects import Effect
from .isolation import occupancies
from .leasing import expiry, fleet, queue
from .model import LaneKey
from .reasons import Reason
from .records import Snapshot
from .runs import (
    audits,
    evaluations,
    finalisation,
    finished,
    journal,
    result_polls,
    runs,
    submits,
)
from .settings import CoreSettings
from .state import State
from .status import CoreStatus, Words
from .step import Step
from .structures.trace import TraceEntry
from .workers import membership, results, scheduler

TICK_S = 1.0
"""While leases are out the core wants to be called at least so often, to notice when it is not."""


class Core:
    """The coordinator's state machine. See the package's docstring for the contract with its shell."""

    def __init__(self, settings: CoreSettings, incarnation: int, now: float) -> None:
        """An empty core; use `load`."""
        self.state = State(settings, incarnation, now)
        self._called_at = now

    # ---- the four entries ----

    @classmethod
    def load(cls, settings: CoreSettings, snapshot: Snapshot, now: float) -> tuple[Core, list[Effect]]:
        """A core that goes on where the store left off, and what is to be done first."""
        core = cls(settings, snapshot.incarnation, now)
        first = Step(now, f"load-{snapshot.incarnation}")
        loading.load(core.state, snapshot, first, drain)
        return core, core._end(first)

    def handle(self, event: events.AnyEvent, now: float) -> list[Effect]:
        """Take in what happened; the effects are to be carried out in order."""
        self._watch(now)
        this = Step(now, event.stimulus_id)
        EVENTS[type(event.message if isinstance(event, events.Asked) else event)](self.state, event, this)
        return self._end(this)

    def next_deadline(self) -> float | None:
        """When `handle_deadline` is due; None when nothing waits for time to pass."""
        at = self.state.timers.next()
        if self.state.n_live:
            tick = self._called_at + TICK_S
            return tick if at is None else min(at, tick)
        return at

    def handle_deadline(self, now: float) -> list[Effect]:
        """Do what is due at `now`."""
        self._watch(now)
        effects: list[Effect] = []
        while (key := self.state.timers.pop_due(now)) is not None:
            kind, what = key
            this = Step(now, f"{kind}-{what}")
            TIMERS[kind](self.state, what, this)
            effects += self._end(this)
        return effects

    def validate(self) -> None:
        """Check every invariant; InvariantError with the trace of what breaks one. For tests: looks at everything."""
        invariants.check(self.state)

    # ---- reading ----

    def capability(self, run: str) -> str | None:
        """The token of a run's gateway, finished runs too; None for no run."""
        return self.state.capabilities.get(run)

    def over(self, run: str) -> tuple[Refusal, Reason]:
        """Why nothing more is taken of a run that is not open."""
        return open_runs.over(self.state, run)

    def worker_of(self, session: str) -> str | None:
        """The worker whose present session is `session` (its right to read and write blobs); None when it is nobody's."""
        return self.state.sessions.get(session)

    def status(self, now: float, words: Words) -> CoreStatus:
        """The core's part of a `StatusReply`; `words` puts a reason into words."""
        return status.status(self.state, now, words)

    def trace(self, key: str) -> list[TraceEntry]:
        """What happened to a job, lease, worker, group or run, oldest first, as far back as is kept."""
        return self.state.trace.of(key)

    # ---- a step ----

    def _watch(self, now: float) -> None:
        """Notice when the loop stood still: then heartbeats may be waiting behind this very call."""
        due, state = self.next_deadline(), self.state
        if due is not None and now - due > state.settings.late_s:
            state.hold_until = now + state.settings.lease_ttl_s
            if now - due > state.settings.standstill_s:
                state.stalled_at = now
        self._called_at = now

    def _end(self, this: Step) -> list[Effect]:
        """Let those above hear what happened, and hand out what became available."""
        if this.news:
            drain(self.state, this)
        if this.last is not None:
            this.add(this.last)
        scheduler.dispatch(self.state, this)
        return this.effects()


def drain(state: State, this: Step) -> None:
    """Tell the news of a step, in order; what follows from a piece of news comes before what was told after it."""
    pending = this.news
    while pending:
        piece = pending.popleft()
        this.news = deque()
        for rule in NEWS[type(piece), piece.kind]:
            rule(state, piece, this)
        if this.news:
            pending.extendleft(reversed(this.news))
    this.news = pending


# ---- the tables ----

Rule = Callable[[State, Any, Step], None]

EVENTS: dict[type, Rule] = {
    operator.CreateRun: runs.create,
    operator.WaitRun: finished.waited,
    operator.CancelRun: finalisation.cancel,
    operator.Disclose: journal.disclose,
    operator.RepinRun: membership.repinned,
    operator.Evaluate: evaluations.request,
    operator.EvaluationPoll: evaluations.polled,
    operator.SetWorker: membership.worker_state,
    operator.AgentGone: requests.agent_gone,
    gateway.OpenRun: runs.opened,
    gateway.RequestPermit: requests.requested,
    gateway.StateRequest: runs.state_requested,
    gateway.Submit: submits.submit,
    gateway.ResultsRequest: result_polls.results,
    gateway.CloseRun: finalisation.close,
    wire.Register: membership.registered,
    wire.LeaseRequest: membership.lease_requested,
    wire.Heartbeat: membership.heartbeat,
    wire.ReportResults: membership.results_reported,
    events.LivenessLost: membership.liveness_lost,
    events.AuditPrepared: audits.prepared,
    events.AuditCompared: audits.compared,
}
"""Who takes an event: by the message that it carries, or by its own type where it carries none."""


NEWS: dict[tuple[type, str], tuple[Rule, ...]] = {
    (step.ResultsPersisted, ""): (results.take,),
    (step.EpisodesDone, "train"): (audits.sample, submits.progressed),
    (step.EpisodesDone, "validation"): (audits.sample, finalisation.progressed),
    (step.EpisodesDone, "heldout"): (audits.sample, finalisation.progressed),
    (step.EpisodesDone, "random"): (audits.sample, finalisation.progressed),
    (step.EpisodesDone, "evaluation"): (evaluations.progressed,),
    (step.EpisodesDone, "audit"): (audits.replayed,),
    (step.SubmitEnded, ""): (finalisation.submit_ended,),
    (step.AuditsMoved, ""): (finalisation.audits_moved,),
    (step.FlowPinned, "run"): (runs.pinned,),
    (step.FlowPinned, "evaluation"): (evaluations.pinned,),
    (step.JobRetried, ""): (runs.retried,),
    (step.ResultsDiffered, ""): (runs.differed,),
}
"""Who hears a piece of news: by its type and the kind of group or flow that it is of (`kind`)."""


# ---- timers ----


def _poll_ended(state: State, request: events.RequestId, this: Step) -> None:
    """A long poll's time is up: it is answered with what there is."""
    poll = state.polls.take(request)
    if poll is not None:
        POLLS[poll.kind](state, poll, this)


def _look_at_lane(state: State, key: LaneKey, this: Step) -> None:
    lane = state.lanes.get(key)
    if lane is not None:
        this.dirty[lane] = None


POLLS: Mapping[str, Rule] = {
    "results": result_polls.answer,
    "evaluation": evaluations.answer,
    "permit": requests.answer,
    "run": finished.answer,
}

TIMERS: dict[str, Rule] = {
    "worker": expiry.look_at,
    "lease": fleet.poll_ended,
    "beat": fleet.beat_ended,
    "bench": scheduler.bench_ended,
    "forget": membership.forget,
    "poll": _poll_ended,
    "job": queue.backed_off,
    "adopt": queue.give_up_adopting,
    "lane": _look_at_lane,
    "hidden": precedence.look_at,
    "submit": submits.limit_passed,
    "audits": finalisation.look_at_audits,
    "linger": occupancies.expire,
    "ask": permits.ask_ended,
    "cancelled": permits.agent_ended,
}
"""Who acts on a deadline: by its kind, with what it is about."""
