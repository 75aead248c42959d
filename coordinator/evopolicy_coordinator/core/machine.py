"""The core itself: takes events and deadlines in, lets the modules beside it act, gives ordered effects back.

What it owns: which jobs, groups, runs and evaluations are open; how a snapshot becomes a core; that the loop's own
lateness expires nobody's lease. Every rule about budget, leases, placement and finalisation is in the module of that name.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, cast

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import EpisodeOutcome, Tier
from evopolicy_common.messages.gateway import RunState
from evopolicy_common.wire.refusals import Refusal

from . import (
    audit,
    evaluations,
    events,
    finalisation,
    invariants,
    membership,
    permits,
    precedence,
    runs,
    status,
)
from .effects import Effect
from .evaluations import Ended, Evaluation
from .isolation import Family, Isolation
from .jobs import JobGroup, JobState, open_jobs
from .leases import ATTEMPTS_PER_INCARNATION, LeaseBook
from .loading import load
from .polls import Polls
from .queue import Flow, LaneKey, Queue
from .records import OutcomeHead, Snapshot, SubmitRow, evaluation_group
from .runs import Run
from .scheduler import Scheduler
from .settings import CoreSettings
from .status import CoreStatus, Rate
from .story import Story, StoryLine
from .timers import TimerKey, Timers
from .turn import Turn
from .workers import Fleet

TICK_S = 1.0
"""While leases are out the core wants to be called at least so often, to notice when it is not."""

DISPUTES_MAX = 50
"""So many disputes are kept for the status."""


class Core:
    """The coordinator's state machine. See the package's docstring for the contract with its shell."""

    def __init__(self, settings: CoreSettings, incarnation: int, now: float) -> None:
        """An empty core; use `load`."""
        self.settings = settings
        self.incarnation = incarnation
        self.first_attempt = (incarnation - 1) * ATTEMPTS_PER_INCARNATION
        """Attempts up to this number were granted by earlier incarnations."""
        self.timers = Timers()
        self.chronicle = Story()
        self.isolation = Isolation(self)
        self.queue = Queue(settings.warm_bonus_s, self.isolation)
        self.fleet = Fleet(settings, self.queue, self.timers)
        self.book = LeaseBook(self)
        self.scheduler = Scheduler(self)
        self.polls = Polls(self.timers, settings.max_wait_s)
        self.rate = Rate()
        self.runs: dict[str, Run] = {}
        self.evaluations: dict[str, Evaluation] = {}
        self.groups: dict[str, JobGroup] = {}
        self.jobs: dict[str, JobState] = {}
        self.held: dict[JobGroup, None] = {}
        """Submits that hidden jobs keep from all workers."""
        self.unpinned: dict[str, Flow] = {}
        self.adopting: dict[JobState, None] = {}
        """Jobs that may be running somewhere since before the core was loaded."""
        self.run_keys: dict[str, str] = {}
        self.capabilities: dict[str, str] = {}
        """Of all runs, finished ones too."""
        self.finished: dict[str, RunState] = {}
        """What a gateway is still told of a finished run."""
        self.evaluation_keys: dict[str, str] = {}
        self.ended_evaluations: dict[str, Ended] = {}
        self.disputes: deque[str] = deque(maxlen=DISPUTES_MAX)
        """What workers disagree on, in words, the latest last; since the core was loaded."""
        self.heads: dict[str, list[OutcomeHead]] = {}
        """While loading: what is stored of each group."""
        self.loading = False
        self.reloaded: list[JobGroup] = []
        """While loading: groups that may be complete already."""
        self.hold_until = now + settings.lease_ttl_s
        """Nothing expires before."""
        self.stalled_at = now
        """When the loop last came to after standing still for long, or started."""
        self._flows = 0
        self._called_at = now

    # ---- the four entries ----

    @classmethod
    def load(cls, settings: CoreSettings, snapshot: Snapshot, now: float) -> tuple[Core, list[Effect]]:
        """A core that goes on where the store left off, and what is to be done first."""
        core = cls(settings, snapshot.incarnation, now)
        turn = Turn(now, f"load-{snapshot.incarnation}")
        load(core, snapshot, turn)
        core.scheduler.dispatch(turn)
        return core, turn.effects()

    def handle(self, event: events.AnyEvent, now: float) -> list[Effect]:
        """Take in what happened; the effects are to be carried out in order."""
        self._watch(now)
        turn = Turn(now, event.stimulus_id)
        _HANDLERS[type(event.message if isinstance(event, events.Asked) else event)](self, event, turn)
        self.scheduler.dispatch(turn)
        return turn.effects()

    def next_deadline(self) -> float | None:
        """When `handle_deadline` is due; None when nothing waits for time to pass."""
        at = self.timers.next()
        if self.book.n_live:
            tick = self._called_at + TICK_S
            return tick if at is None else min(at, tick)
        return at

    def handle_deadline(self, now: float) -> list[Effect]:
        """Do what is due at `now`."""
        self._watch(now)
        effects: list[Effect] = []
        while (key := self.timers.pop_due(now)) is not None:
            turn = Turn(now, f"{key[0]}-{key[1]}")
            self._fire(key, turn)
            self.scheduler.dispatch(turn)
            effects += turn.effects()
        return effects

    def validate(self) -> None:
        """Check every invariant; InvariantError with the story of what breaks one. For tests: looks at everything."""
        invariants.check(self)

    # ---- reading ----

    def capability(self, run: str) -> str | None:
        """The token of a run's gateway, finished runs too; None for no run."""
        return self.capabilities.get(run)

    def over(self, run: str) -> tuple[Refusal, str]:
        """Why nothing more is taken of a run that is not open, in a word and a sentence."""
        return runs.over(self, run)

    def worker_of(self, session: str) -> str | None:
        """The worker whose present session is `session` (its right to read and write blobs); None when it is nobody's."""
        return self.fleet.sessions.get(session)

    def status(self, now: float) -> CoreStatus:
        """The core's part of a `StatusReply`."""
        return status.status(self, now)

    def story(self, key: str) -> list[StoryLine]:
        """What happened to a job, lease, worker, group or run, oldest first, as far back as is kept."""
        return self.chronicle.of(key)

    # ---- time ----

    def _watch(self, now: float) -> None:
        """Notice when the loop stood still: then heartbeats may be waiting behind this very call."""
        due = self.next_deadline()
        if due is not None and now - due > self.settings.late_s:
            self.hold_until = now + self.settings.lease_ttl_s
            if now - due > self.settings.standstill_s:
                self.stalled_at = now
        self._called_at = now

    def _fire(self, key: TimerKey, turn: Turn) -> None:
        kind, what = key
        if kind == "worker":
            worker = self.fleet.workers.get(str(what))
            if worker is not None:
                self.book.look(worker, turn)
        elif kind == "lease":
            worker = self.fleet.workers.get(str(what))
            if worker is not None:
                self.scheduler.drop_poll(worker, turn)
        elif kind == "beat":
            worker = self.fleet.workers.get(str(what))
            if worker is not None and worker.beat is not None:
                self.fleet.answer_beat(worker, (), turn)
        elif kind == "poll":
            self._poll_ended(what, turn)
        elif kind == "job":
            job = self.jobs.get(str(what))
            if job is not None and not job.queued and job.lease is None:
                self.scheduler.queue(job, turn, front=True)
        elif kind == "adopt":
            for job in list(self.adopting):
                del self.adopting[job]
                self.scheduler.queue(job, turn)
        elif kind == "lane":
            lane = self.queue.lanes.get(cast(LaneKey, what))
            if lane is not None:
                turn.dirty[lane] = None
        elif kind == "hidden":
            lane = self.queue.lanes.get(cast(LaneKey, what))
            if lane is not None:
                precedence.look(self, lane, turn)
        elif kind == "bench":
            worker = self.fleet.workers.get(str(what))
            if worker is not None:
                self.scheduler.reconsider(worker, turn)
        elif kind == "submit":
            self._submit_limit(key, turn)
        elif kind == "audits":
            run = self.runs.get(str(what))
            if run is not None:
                finalisation.advance(self, run, turn)
        elif kind == "forget":
            worker = self.fleet.workers.get(str(what))
            if worker is not None and worker.state == "lost":
                self.fleet.forget(worker)
                self.isolation.forgotten(worker)
        elif kind == "linger":
            self.isolation.expire(str(what), turn)
        elif kind == "ask":
            self.isolation.forget_ask(*cast(tuple[str, str], what), turn)
        elif kind == "cancelled":
            self.isolation.end(str(what), turn, "its run was cancelled")

    def _submit_limit(self, key: TimerKey, turn: Turn) -> None:
        group = self.groups.get(str(key[1]))
        if group is None:
            return
        held_s = group.held(turn.now) - group.held_counted_s
        if held_s > 0.0:
            group.held_counted_s += held_s
            self.timers.arm(key, turn.now + held_s)
        elif turn.now < self.hold_until:
            self.timers.arm(key, self.hold_until)
        else:
            runs.timed_out(self, group, turn)

    def _poll_ended(self, request: Any, turn: Turn) -> None:
        poll = self.polls.take(request)
        if poll is None:
            return
        if poll.kind == "results":
            runs.answer(self, self.runs[poll.target.split("/")[0]], poll, turn)
        elif poll.kind == "evaluation":
            evaluations.answer(self, poll, turn)
        elif poll.kind == "permit":
            permits.answer(self, poll, turn)
        else:
            turn.reply(poll.request, finalisation.progress(self, self.runs[poll.target]))

    # ---- flows and groups ----

    def secret_of(self, group: JobGroup) -> bytes:
        """The secret of the run or evaluation that the group is part of."""
        run = self.runs.get(group.run)
        return self.evaluations[group.run].row.secret if run is None else run.row.secret

    def add_flow(self, name: str, env: str, tier: Tier, family: Family | None, *, closed: bool) -> Flow:
        """A new flow for a run or an evaluation, not pinned to workers yet; `closed`: no agent is at work for it."""
        self._flows += 1
        flow = Flow(name, env, tier, self._flows, family, closed=closed)
        self.unpinned[name] = flow
        return flow

    def drop_flow(self, flow: Flow) -> None:
        """A run or evaluation is over: nothing of it waits any more."""
        self.unpinned.pop(flow.id, None)
        self.queue.drop(flow)
        self.isolation.families.leave(flow.family)

    def pin(self, flow: Flow, turn: Turn) -> None:
        """Pin a flow to the fingerprint class that serves it best now, if there is one."""
        profile = self.fleet.offer(flow) if flow.pin is None else None
        if profile is None:
            return
        description = profile.descriptions[flow.env]
        self.place(flow, profile.fingerprint_class, turn)
        flow.description = description
        run = self.runs.get(flow.id)
        if run is not None:
            run.change(
                turn,
                fingerprint_class=profile.fingerprint_class,
                description=description,
                fingerprint=profile.fingerprint,
            )
            turn.log("info", "run_pinned", run=run.id, fingerprint_class=profile.fingerprint_class)
        else:
            evaluations.pinned(self.evaluations[flow.id], profile.fingerprint_class, turn)

    def place(self, flow: Flow, fingerprint_class: str, turn: Turn) -> None:
        """Pin a flow to a class of workers: what of it waits, waits for them."""
        self.unpinned.pop(flow.id, None)
        turn.dirty[self.queue.place(flow, fingerprint_class)] = None

    def open_group(self, group: JobGroup, turn: Turn) -> None:
        """Queue what is not done of a group. While loading, jobs wait to be adopted first."""
        self.groups[group.id] = group
        heads = self.heads.pop(group.id, [])
        for job in open_jobs(group, heads, self.first_attempt, turn.now):
            self.jobs[job.job_id] = job
            if self.loading:
                self.adopting[job] = None
            else:
                self.scheduler.queue(job, turn)
        self.chronicle.tell(turn.now, turn.stimulus_id, group.id, f"opened, {group.done} of {group.n} done")
        if self.loading:
            self.reloaded.append(group)

    def close_group(self, group: JobGroup, turn: Turn, why: str) -> None:
        """Nothing more is played of a group; what is leased is stopped."""
        for job in list(group.jobs.values()):
            self.close_job(job, turn, why)
        group.closed = True
        precedence.let_go(self, group, turn.now)
        self.groups.pop(group.id, None)
        self.timers.disarm(("submit", group.id))
        self.chronicle.tell(turn.now, turn.stimulus_id, group.id, f"closed: {why}")

    def close_job(self, job: JobState, turn: Turn, why: str) -> None:
        """A job is open no more."""
        if job.lease is not None:
            self.book.stop(job.lease, turn, why)
        self.queue.withdraw(job)
        self.scheduler.unreserve(job)
        self.adopting.pop(job, None)
        self.timers.disarm(("job", job.job_id))
        del job.group.jobs[job.first]
        del self.jobs[job.job_id]

    def promote(self, group: JobGroup, priority: int, turn: Turn) -> None:
        """Move a group's open jobs to another priority."""
        if group.priority == priority:
            return
        group.priority = priority
        for job in group.jobs.values():
            queued = job.queued
            self.queue.withdraw(job)
            if job.lease is not None:
                held = self.fleet.workers[job.lease.worker].held
                held[job.priority] -= 1
                held[priority] += 1
            job.priority = priority
            if queued:
                self.scheduler.queue(job, turn)
            elif job.lease is not None:
                self.book.list_hidden(job.lease, self.fleet.workers[job.lease.worker], turn)

    # ---- what the modules tell each other ----

    def group_started(self, group: JobGroup, turn: Turn) -> None:
        """The first lease of a group was granted."""
        limit_s = group.template.limits.submit_wall_s
        if group.kind == "train" and limit_s is not None:
            self.timers.arm(("submit", group.id), turn.now + limit_s)

    def concluded(self, group: JobGroup, outcomes: tuple[EpisodeOutcome, ...], turn: Turn) -> None:
        """Episodes of a group are done (none in `outcomes`: before the core was loaded)."""
        if group.kind == "train":
            runs.progressed(self, group, outcomes, turn)
        elif group.kind == "evaluation":
            evaluations.progressed(self, group, turn)
        else:
            finalisation.progressed(self, group, turn)

    def submit_ended(self, run: Run, row: SubmitRow, turn: Turn) -> None:
        """A submit has its verdict: its hidden validation may begin, and a closed run may go on."""
        if row.status == "ok":
            finalisation.validate_early(self, run, row, turn)
        finalisation.advance(self, run, turn)

    def audits_moved(self, run: Run, turn: Turn) -> None:
        """An audit of a run is over: the run may have waited for it."""
        finalisation.advance(self, run, turn)

    def counted_retry(self, job: JobState, turn: Turn) -> None:
        """A job is played again for our own failure; `run.json` tells how often."""
        run = self.runs.get(job.group.run)
        if run is not None:
            run.change(turn, infrastructure_retries=run.state.infrastructure_retries + 1)

    def nondeterministic(self, group: JobGroup, turn: Turn) -> None:
        """Two results of one episode differed; `run.json` tells how often."""
        run = self.runs.get(group.run)
        if run is not None:
            run.change(turn, nondeterministic_results=run.state.nondeterministic_results + 1)

    def count_done(self, n: int, now: float) -> None:
        """Episodes were finished, for the rate that operators see."""
        self.rate.count(n, now)

    def waits_for(self, group: JobGroup) -> str:
        """What a group waits for, in words; empty while it runs."""
        return status.waits_for(self, group)

    def waits_for_workers(self, flow: Flow) -> str:
        """Which workers a flow waits for, in words; empty while some may serve it."""
        return status.waits_for_workers(self, flow)

    def forget_run(self, run: Run) -> None:
        """A run is finished: of it only the last state that its gateway may ask for stays."""
        del self.runs[run.id]
        self.finished[run.id] = runs.last_state(run.state)
        self.drop_flow(run.flow)

    def cancel_evaluation(self, name: str, turn: Turn) -> bool:
        """End an evaluation that runs; False when there is none."""
        if name not in self.evaluations:
            return name in self.ended_evaluations
        evaluations.end(self, self.groups[evaluation_group(name)], "cancelled by the operator", turn)
        return True


_HANDLERS: dict[type, Callable[[Core, Any, Turn], None]] = {
    operator.CreateRun: runs.create,
    operator.WaitRun: finalisation.waited,
    operator.CancelRun: finalisation.cancel,
    operator.RepinRun: membership.repinned,
    operator.Evaluate: evaluations.request,
    operator.EvaluationPoll: evaluations.polled,
    operator.SetWorker: membership.worker_state,
    operator.AgentGone: permits.agent_gone,
    gateway.OpenRun: runs.opened,
    gateway.RequestPermit: permits.requested,
    gateway.StateRequest: runs.state_requested,
    gateway.Submit: runs.submit,
    gateway.ResultsRequest: runs.results,
    gateway.CloseRun: finalisation.close,
    wire.Register: membership.registered,
    wire.LeaseRequest: membership.lease_requested,
    wire.Heartbeat: membership.heartbeat,
    wire.HandIn: membership.handed_in,
    events.LivenessLost: membership.liveness_lost,
    events.AuditPrepared: audit.prepared,
    events.AuditCompared: audit.compared,
}
"""Who takes an event: by the message that it carries, or by its own type where it carries none."""
