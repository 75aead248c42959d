"""The core itself: takes events and deadlines, lets the rules act, returns ordered effects.

A step runs from top to bottom: the event's rule (`EVENTS`) or the deadline's (`TIMERS`), then the news of the step,
each piece with all its consequences (`NEWS`), then the scheduler, which leases the work that became available. Besides
these tables the module owns one rule: a late call of the loop expires no lease.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.status import StatusReply
from evopolicy_common.messages.worker import Message
from evopolicy_coordinator.core import status
from evopolicy_coordinator.core.agents import permits, precedence, requests
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import Effect
from evopolicy_coordinator.core.contract.reasons import NotDoneError, Reason
from evopolicy_coordinator.core.contract.records import (
    Snapshot,
    SubmitRow,
    submit_group,
)
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.isolation import occupancies
from evopolicy_coordinator.core.leasing import fleet, pins, queue
from evopolicy_coordinator.core.runs import evaluations, finalisation, finished, journal, runs, submits
from evopolicy_coordinator.core.status import Words
from evopolicy_coordinator.core.tables import step
from evopolicy_coordinator.core.tables.model import LaneKey, Run
from evopolicy_coordinator.core.tables.state import Loading, State
from evopolicy_coordinator.core.tables.step import CoreStep, EpisodesDone
from evopolicy_coordinator.core.workers import membership, results, scheduler

TICK_S = 1.0
"""While leases are out, the core requests a call at least this often, so that it notices when the loop is blocked."""


class Core:
    """The coordinator's state machine. The package's docstring has the contract with the shell."""

    def __init__(self, settings: CoreSettings, incarnation: int, now: float) -> None:
        """An empty core; use `load`."""
        self.state = State(settings, incarnation, now)
        self._called_at = now

    # ---- the four entries ----

    @classmethod
    def load(cls, settings: CoreSettings, snapshot: Snapshot, now: float) -> tuple[Core, list[Effect]]:
        """Returns a core that continues from the snapshot, and the first effects to carry out."""
        core = cls(settings, snapshot.incarnation, now)
        first = CoreStep(now, f"load-{snapshot.incarnation}")
        load(core.state, snapshot, first)
        return core, core._end(first)

    def handle(self, event: events.AnyEvent, now: float) -> list[Effect]:
        """Process an event; the shell carries out the returned effects in order."""
        self._watch(now)
        this = CoreStep(now, event.stimulus_id)
        try:
            EVENTS[type(getattr(event, "message", event))](self.state, event, this)
        except NotDoneError as refused:
            assert isinstance(event, events.Requested)
            this.refuse(event.request, refused.reason)
        return self._end(this)

    def next_deadline(self) -> float | None:
        """Returns when `handle_deadline` is due, Unix seconds; None when no deadline is set."""
        at = self.state.timers.next()
        if self.state.n_live:
            tick = self._called_at + TICK_S
            return tick if at is None else min(at, tick)
        return at

    def handle_deadline(self, now: float) -> list[Effect]:
        self._watch(now)
        effects: list[Effect] = []
        while (key := self.state.timers.pop_due(now)) is not None:
            kind, what = key
            this = CoreStep(now, f"{kind}-{what}")
            TIMERS[kind](self.state, what, this)
            effects += self._end(this)
        return effects

    # ---- reading ----

    def over(self, run: str) -> Reason:
        """Returns why a run that is not open refuses further requests."""
        return requests.over(self.state, run)

    def status(self, now: float, words: Words) -> StatusReply:
        """Returns a reply with the core's fields; `words` puts a reason into words."""
        return status.status(self.state, now, words)

    # ---- a step ----

    def _watch(self, now: float) -> None:
        """Detect that the loop was blocked: then unread heartbeats may be queued behind this call."""
        due, state = self.next_deadline(), self.state
        if due is not None and now - due > state.settings.late_s:
            state.hold_until = now + state.settings.lease_ttl_s
            if now - due > state.settings.standstill_s:
                state.stalled_at = now
        self._called_at = now

    def _end(self, this: CoreStep) -> list[Effect]:
        """Deliver the news of the step and lease the work that became available."""
        if this.news:
            drain(self.state, this)
        for group in this.grown:
            submits.answer_polls(self.state, group, this)
        if this.last is not None:
            this.add(this.last)
        scheduler.dispatch(self.state, this)
        return this.effects()


def drain(state: State, this: CoreStep) -> None:
    """Deliver the news of a step in order. The consequences of a piece of news come before the
    pieces queued after it."""
    pending = this.news
    while pending:
        piece = pending.popleft()
        this.news = deque()
        for rule in NEWS[type(piece), getattr(piece, "kind", "")]:
            rule(state, piece, this)
        if this.news:
            pending.extendleft(reversed(this.news))
    this.news = pending


# ---- the tables ----

Rule = Callable[[State, Any, CoreStep], None]
M = TypeVar("M", bound=Message)
T = TypeVar("T")


def _request(
    message: type[M], rule: Callable[[State, events.Requested[M], CoreStep], None]
) -> tuple[type, Rule]:
    """The rule for a request, which mypy compares with the type of its message."""
    return message, rule


def _event(key: type, event: type[T], rule: Callable[[State, T, CoreStep], None]) -> tuple[type, Rule]:
    """The rule for an event with fields of its own."""
    return key, rule


EVENTS: dict[type, Rule] = dict(
    (
        _event(operator.CreateRun, events.RunRequested, runs.create),
        _request(operator.WaitRun, finished.waited),
        _request(operator.CancelRun, finalisation.cancel),
        _event(operator.Disclose, events.DisclosureRequested, journal.disclose),
        _request(operator.RepinRun, membership.repinned),
        _event(operator.Evaluate, events.EvaluationRequested, evaluations.request),
        _event(operator.Rescore, events.EvaluationRequested, evaluations.request),
        _request(operator.EvaluationPoll, evaluations.polled),
        _request(operator.SetWorker, membership.worker_state),
        _request(operator.AgentGone, requests.agent_gone),
        _request(gateway.OpenRun, runs.opened),
        _request(gateway.RequestPermit, requests.requested),
        _request(gateway.StateRequest, runs.state_requested),
        _request(gateway.Submit, submits.submit),
        _request(gateway.ResultsRequest, submits.results),
        _request(gateway.CloseRun, finalisation.close),
        _event(wire.Register, events.WorkerRegistered, membership.registered),
        _request(wire.LeaseRequest, membership.lease_requested),
        _request(wire.Heartbeat, membership.heartbeat),
        _request(wire.ReportResults, membership.results_reported),
        _event(events.LivenessLost, events.LivenessLost, membership.liveness_lost),
        _event(events.DescriptionAwaited, events.DescriptionAwaited, fleet.await_description),
    )
)
"""The rule for each event: by the message that it carries, or by its own type if it carries none."""


def _news(
    news: type[T], kinds: str, *rules: Callable[[State, T, CoreStep], None]
) -> dict[tuple[type, str], tuple[Rule, ...]]:
    """The rules for a piece of news, of each of these kinds."""
    return {(news, kind): rules for kind in kinds.split() or [""]}


NEWS: dict[tuple[type, str], tuple[Rule, ...]] = {
    **_news(step.ResultReported, "", results.take_result),
    **_news(step.EpisodesDone, "train", runs.played, submits.progressed),
    **_news(step.EpisodesDone, "validation heldout random", runs.played, finalisation.progressed),
    **_news(step.EpisodesDone, "evaluation", evaluations.progressed),
    **_news(step.EnvironmentFailed, "train validation heldout random", finalisation.environment_failed),
    **_news(step.EnvironmentFailed, "evaluation", evaluations.environment_failed),
    **_news(step.SubmitEnded, "", finalisation.submit_ended),
    **_news(step.AgentOverdue, "", finalisation.agent_overdue),
    **_news(step.FlowPinned, "run", runs.pinned),
    **_news(step.FlowPinned, "evaluation", evaluations.pinned),
    **_news(step.JobRetried, "", runs.retried),
    **_news(step.ResultsDiffered, "", runs.differed),
}
"""The rules for each piece of news: by its type and, where it has one, its `kind`."""


# ---- timers ----


def _poll_ended(state: State, request: events.RequestId, this: CoreStep) -> None:
    """Answer a long poll whose time is up with the current state."""
    poll = state.polls.take_poll(request)
    if poll is not None:
        POLLS[poll.kind](state, poll, this)


def _check_lane(state: State, key: LaneKey, this: CoreStep) -> None:
    lane = state.lanes.get(key)
    if lane is not None:
        this.dirty[lane] = None


POLLS: Mapping[str, Rule] = {
    "results": submits.answer,
    "evaluation": evaluations.answer,
    "permit": requests.answer,
    "run": finished.answer,
}

TIMERS: dict[str, Rule] = {
    "worker": membership.check_due,
    "lease": fleet.poll_ended,
    "beat": fleet.beat_ended,
    "bench": scheduler.bench_ended,
    "forget": membership.forget,
    "poll": _poll_ended,
    "job": queue.backed_off,
    "adopt": queue.give_up_adopting,
    "lane": _check_lane,
    "hidden": precedence.check_due,
    "submit": submits.limit_passed,
    "linger": occupancies.expire,
    "ask": permits.ask_ended,
    "cancelled": permits.agent_ended,
}
"""The rule for each deadline: by its kind; the rule gets the deadline's subject."""


def load(state: State, snapshot: Snapshot, step: CoreStep) -> None:
    """Fill an empty state so that no accepted submit is lost and no finished episode is played again.

    Budgets are rebuilt from submits, open groups from submits and outcomes; groups that were complete but not concluded
    when the process died are concluded first. Open jobs may be running on a worker: they wait for a short while for
    heartbeats that claim them.
    """
    loading = state.loading = Loading()
    state.journal = snapshot.journal
    state.revealed.update(snapshot.revealed)
    for head in snapshot.outcomes:
        loading.heads.setdefault(head.group, []).append(head)
    loading.begun.update({(row.group, row.first): row for row in snapshot.begun})
    for worker in snapshot.workers:
        fleet.set_state(state, worker.worker, worker.state)
    stored = {row.run: row for row in snapshot.states}
    permits.load(state, snapshot.permits, {row.run: row for row in snapshot.runs}, stored, step)
    occupancies.load(state, snapshot.kernels, step)
    submits_of: dict[str, list[SubmitRow]] = defaultdict(list)
    for submit in snapshot.submits:
        submits_of[submit.run].append(submit)
    for row in sorted(snapshot.runs, key=lambda row: (row.created_at, row.run)):
        last = stored[row.run]
        if last.phase == "finished":
            state.run_keys[row.key] = row.run
            state.capabilities[row.run] = row.capability
            state.finished[row.run] = runs.last_state(last)
        else:
            run = runs.enter(state, row, last)
            requests.resume(state, run, step)
            _run(state, run, submits_of[row.run], loading, step)
    for each in sorted(snapshot.evaluations, key=lambda row: (row.created_at, row.evaluation)):
        if each.finished:
            state.evaluation_keys[each.key] = each.evaluation
            state.ended_evaluations[each.evaluation] = len(each.cases)
            continue
        evaluation = evaluations.enter(state, each)
        if each.fingerprint_class is not None:
            pins.place(state, evaluation.flow, each.fingerprint_class, step)
        evaluations.queue_jobs(state, evaluation, step)
    while loading.reloaded:
        group = loading.reloaded.pop(0)
        if group.done and not group.closed:
            step.tell(EpisodesDone(group, None, ()))
            drain(state, step)
    state.loading = None
    if state.adopting:
        state.timers.arm(("adopt", ""), step.now + state.settings.adoption_s)
    step.log("info", "core_loaded", incarnation=state.incarnation, runs=len(state.runs), jobs=len(state.jobs))


def _run(state: State, run: Run, rows: list[SubmitRow], loading: Loading, step: CoreStep) -> None:
    if run.state.fingerprint_class is not None:
        pins.place(state, run.flow, run.state.fingerprint_class, step)
        run.flow.description = run.state.description
    for row in sorted(rows, key=lambda row: row.submit_index):
        run.submits.append(row)
        run.keys[row.key] = row.submit_index
        if not row.env_instances:
            continue
        run.ledger.reserve(row.submit_index, len(row.env_instances))
        if row.refunded:
            run.ledger.refund(row.submit_index)
        elif row.status is not None:
            run.ledger.settle(row.submit_index)
            _spent(run, row)
        else:
            run.open = row.submit_index
            submits.queue_jobs(state, run, row, step)
        if row.status == "ok" and row.val_mean is not None:
            heads = loading.heads.pop(submit_group(run.id, row.submit_index, "validation"), [])
            failed = sum(head.failure is not None for head in heads)
            run.hidden_failures[submit_group(run.id, row.submit_index, "validation")] = failed
    finalisation.advance(state, run, step)


def _spent(run: Run, row: SubmitRow) -> None:
    """Add a settled submit's queue and rollout time to the run's totals, as at its end."""
    if row.completed_at is not None:
        started_at = row.first_leased_at or row.completed_at
        run.queue_s += max(0.0, started_at - row.accepted_at)
        run.rollout_s += max(0.0, row.completed_at - started_at)
