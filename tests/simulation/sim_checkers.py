"""Checks of safety and of final results, separate from the generation of scenarios.

The checks observe from outside: rows as they are committed, requests and their replies, the jobs that workers play;
and, every few steps, the core's own invariants.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from rigs.core_invariants import check_invariants
from sim_faults import Faults
from sim_oracle import ExpectedRun, PlannedRun, expect
from sim_worker import begun_of

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.worker import Message
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import Log
from evopolicy_coordinator.core.contract.records import (
    OutcomeRow,
    Row,
    RunStateRow,
    SubmitRow,
    submit_group,
)
from evopolicy_coordinator.core.leasing import fleet
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.server.reason_texts import reason_text

if TYPE_CHECKING:
    from sim_scenario import Simulation

EVALUATED_S = 60.0
"""Longest time that an evaluation of open cases takes without faults."""
QUIET_S = 600.0
"""Longest time without a commit, after the last fault, that slow workers and long episodes can explain."""
VALIDATE_EVERY = 7
"""Steps between checks of the core's invariants, which are expensive."""
HEARD_S = 4.0
"""A worker whose contacts are at most this far apart is never considered lost."""


class ViolationError(AssertionError):
    """A checked property does not hold."""


def want(holds: object, what: str, *about: Any) -> None:
    if not holds:
        raise ViolationError(f"{what}: {'; '.join(str(each)[:600] for each in about)}")


class Checkers:
    """Observes one simulation."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._disk = simulation.disk
        self._plans: dict[str, PlannedRun] = {plan.name: plan for plan in simulation.plans}
        self._expected: dict[str, ExpectedRun] = {plan.name: expect(plan) for plan in simulation.plans}
        self._granted: dict[str, tuple[str, int]] = {}
        self._granted_to: dict[tuple[str, int], tuple[str, int]] = {}
        """Job and attempt to the worker and incarnation of the grant."""
        self._attempts: dict[str, int] = {}
        """Job to its highest attempt."""
        self._handed_in: set[str] = set()
        self._granted_at: dict[str, float] = {}
        """Lease to the time when its grant was sent."""
        self._heard: dict[str, tuple[float, float]] = {}
        """Worker to the time of its last contact, and the start of its present time without a long silence."""
        self._steps = 0
        self._moved_at = 0.0
        self._core: Core | None = None
        self.drained_at: dict[str, float] = {}
        self.retries = 0
        self.unreasoned = 0
        """Retries without a fault that explains them, in scenarios whose faults must cause none."""
        self.finished_runs: set[str] = set()

    # ---- rows ----

    def committing(self, rows: tuple[Row, ...]) -> None:
        """Check a transaction that is about to be written."""
        self._moved_at = self._simulation.world.now
        arrived: Counter[str] = Counter()
        for row in rows:
            if isinstance(row, OutcomeRow):
                self._outcome(row, arrived[row.group])
                arrived[row.group] += 1
            elif isinstance(row, SubmitRow):
                self._submit(row, rows)
            elif isinstance(row, RunStateRow):
                old = self._disk.states.get(row.run)
                order = ("open", "closed", "finished")
                forward = old is None or order.index(row.phase) >= order.index(old.phase)
                want(forward, "a run's phase goes forward only", old, row)
                pinned = old is None or old.fingerprint_class in (None, row.fingerprint_class)
                want(pinned, "a run keeps its fingerprint class", old, row)

    def _outcome(self, row: OutcomeRow, arrived: int) -> None:
        """`arrived` counts the rows of its group ahead of it in the transaction."""
        group = self._disk.outcomes.get(row.group, {})
        want(row.index not in group, "an episode is committed once", row)
        want(row.seq == len(group) + arrived, "arrivals are numbered one by one", row, len(group), arrived)
        granted = self._granted_to.get((row.job_id, row.attempt))
        want(granted and granted[0] == row.worker, "outcomes come from the leased player", row, granted)
        parts = row.group.split("/")
        if parts[0] != "evaluation" and len(parts) == 3:
            submit = self._disk.submits.get((parts[0], int(parts[1][1:])))
            want(submit is not None, "an outcome belongs to a durable submit", row)
            if parts[2] == "train" and submit is not None:
                want(submit.status is None, "nothing is committed to a submit that has ended", row, submit)
        late = row.outcome.failure is not None and row.outcome.failure.category == "act_timeout"
        want(not late, "a limit verdict of a worker that stood still is not counted", row)

    def _submit(self, row: SubmitRow, rows: tuple[Row, ...]) -> None:
        plan = self._plans[row.run]
        old = self._disk.submits.get((row.run, row.submit_index))
        before = [
            each
            for (run, index), each in self._disk.submits.items()
            if run == row.run and index < row.submit_index
        ]
        want(len(before) == row.submit_index, "submits are numbered without gaps", row)
        spent = sum(len(each.env_instances) for each in before)
        want(row.first_global_episode == spent, "episodes are numbered through the run", row, spent)
        left = plan.budget - spent - len(row.env_instances)
        want(left == row.remaining_budget >= 0, "the budget is conserved", row, left)
        same_key = [each for each in before if each.key == row.key]
        want(not same_key, "one submit a key", row, same_key)
        if old is None:
            want(all(each.status is not None for each in before), "one submit at a time", row)
            state = self._disk.states.get(row.run)
            want(state is not None and state.phase == "open", "a closed run takes no submit", row)
        else:
            want(old.status in (None, row.status), "a verdict is final", old, row)
            want(
                (old.key, old.env_instances) == (row.key, row.env_instances), "a submit is constant", old, row
            )
        if row.status == "ok":
            group = submit_group(row.run, row.submit_index, "train")
            new = {each.index for each in rows if isinstance(each, OutcomeRow) and each.group == group}
            have = new | set(self._disk.outcomes.get(group, {}))
            want(have == set(range(len(row.env_instances))), "an ok submit is complete", row, sorted(have))

    # ---- requests and answers ----

    def asking(self, event: events.Event) -> None:
        """Note a request that reached the core."""
        message = event.message if isinstance(event, events.Requested) else None
        if isinstance(message, wire.Heartbeat | wire.Register):
            now = self._simulation.world.now
            last, since = self._heard.get(message.worker, (-1e9, now))
            self._heard[message.worker] = now, since if now - last <= HEARD_S else now
        if isinstance(message, wire.ReportResults):
            self._handed_in.update(result.lease_id for result in message.results)

    def answering(self, request: Message, message: Any, term: int) -> None:
        """Check a reply that the coordinator of that incarnation is about to send: its content is durable and may be
        reported. What a deposed leader accepts is durable too; its leases and refusals are as old as its memory."""
        disk = self._disk
        if term != disk.incarnation:
            if isinstance(message, wire.Leases) and isinstance(request, wire.LeaseRequest):
                for lease in message.leases:
                    self._grant(request.worker, lease, term)
                return
            if isinstance(message, wire.HeartbeatReply | wire.Refused):
                return
        if isinstance(message, gateway.SubmitAccepted) and isinstance(request, gateway.Submit):
            row = disk.submits.get((request.run, message.submit_index))
            want(row is not None and row.key == request.key, "an accepted submit is durable", request, row)
        elif isinstance(message, wire.Refused) and isinstance(request, gateway.Submit):
            running = [
                row for (run, _), row in disk.submits.items() if run == request.run and row.status is None
            ]
            gone = message.status in ("run_finished", "run_closed")
            want(
                gone or (message.status == "busy") == bool(running),
                "submits do not overlap",
                message,
                running,
            )
        elif isinstance(message, operator.RunCreated):
            want(message.run in disk.runs, "a created run is durable", message)
        elif isinstance(message, gateway.RunClosed) and isinstance(request, gateway.CloseRun):
            want(disk.states[request.run].phase != "open", "a closed run is durably closed", request)
        elif isinstance(message, wire.ResultsReported) and isinstance(request, wire.ReportResults):
            for result in request.results:
                self._taken(result)
        elif isinstance(request, gateway.ResultsRequest) and getattr(message, "rows", None):
            gate = disk.outcome(submit_group(request.run, request.submit_index, "train"), 0)
            category = None if gate is None or gate.outcome.failure is None else gate.outcome.failure.category
            shown = gate is not None and category != "init_error"
            want(shown, "nothing is shown before index 0 shows a Policy", request, gate)
        elif isinstance(message, wire.HeartbeatReply) and isinstance(request, wire.Heartbeat):
            for held in request.held:
                group, _, first = held.job_id.rpartition("/")
                row = disk.outcome(group, int(first))
                notified = (
                    row is None or held.lease_id in self._handed_in or held.lease_id in message.cancelled
                )
                want(notified, "who plays what is done already is told to stop", held, row)
        elif isinstance(message, wire.Leases) and isinstance(request, wire.LeaseRequest):
            for lease in message.leases:
                self._leased(request.worker, lease)

    def _taken(self, result: wire.JobResult) -> None:
        """Check an acknowledged result: the worker now drops it."""
        group = result.job_id.rpartition("/")[0]
        job = None if self._core is None else self._core.state.jobs.get(result.job_id)
        if result.begun is not None and job is not None and self._attempts.get(job.job_id) == result.attempt:
            row = self._disk.begun.get((group, job.first))
            want(row is not None and row.begun == result.begun, "what was handed back stands", result, row)
        parts = group.split("/")
        state = self._disk.states.get(parts[0])
        if state is None or state.phase == "finished":
            return
        if parts[-1] == "train" and self._disk.submits[parts[0], int(parts[1][1:])].status is not None:
            return
        if result.kind == "done":
            late = any(
                each.failure is not None and each.failure.category == "act_timeout"
                for each in result.episodes
            )
            for each in result.episodes:
                stored = self._disk.outcome(group, each.index) is not None
                want(stored or late, "an acknowledged outcome is durable", result)

    def _leased(self, worker: str, lease: wire.Lease) -> None:
        core, disk, job = self._core, self._disk, lease.job
        group = job.job_id.rpartition("/")[0]
        known = self._granted.get(lease.lease_id)
        want(known is None, "an attempt is leased once", lease, known)
        highest = self._attempts.get(job.job_id, 0)
        want(lease.attempt > highest, "attempts grow, over restarts too", lease, highest)
        self._attempts[job.job_id] = lease.attempt
        self._grant(worker, lease, disk.incarnation)
        for spec in job.episodes:
            want(disk.outcome(group, spec.index) is None, "what is done is not played again", lease)
        self._thrown_once(lease)
        able = self._simulation.workers.get(worker)
        want(able is None or job.env in able.envs, "a worker gets what it can play", worker, job.env)
        run, *_, split = group.split("/")
        if run == "evaluation":
            return
        hidden = split in ("validation", "heldout")
        want(not hidden or disk.states[run].phase == "closed", "an open run plays nothing hidden", lease)
        pin = disk.states[run].fingerprint_class
        mine = None if core is None else core.state.workers[worker].profile.classes[job.env]
        want(mine in (None, pin), "a run is played by its fingerprint class", worker, lease.lease_id)

    def _grant(self, worker: str, lease: wire.Lease, term: int) -> None:
        self._granted[lease.lease_id] = worker, term
        self._granted_to[lease.job.job_id, lease.attempt] = worker, term
        self._granted_at[lease.lease_id] = self._simulation.world.now

    def _thrown_once(self, lease: wire.Lease) -> None:
        """A hidden episode resumes from the actions that its policy had returned, unless its worker
        cannot have reported them."""
        job, now = lease.job, self._simulation.world.now
        group, _, first = job.job_id.rpartition("/")
        row = self._disk.begun.get((group, int(first)))
        want(job.begun == (None if row is None else row.begun), "what stands is gone on from", lease, row)
        for worker in self._simulation.workers.values():
            last, since = self._heard.get(worker.name, (-1e9, now))
            reported = [
                each for each in worker.outbox if each.job_id == job.job_id and each.begun is not None
            ]
            played = [
                each.lease_id
                for each in worker.running.values()
                if each.job.job_id == job.job_id and begun_of(each) not in (None, job.begun)
            ]
            for lease_id in [*(each.lease_id for each in reported if each.begun != job.begun), *played]:
                known = self._granted[lease_id][1] == self._disk.incarnation
                heard = now - last <= HEARD_S and since < self._granted_at[lease_id]
                want(not (known and heard), "a hidden episode is played once", lease, lease_id)

    def refused(self, message: Any) -> None:
        """Check the reply to a submit that must be refused."""
        want(isinstance(message, wire.Refused), "a wrong submit is refused", message)

    def submit_refused(self, plan: PlannedRun, position: int, message: wire.Refused) -> None:
        planned = plan.submits[position]
        if plan.cancel_at is None:
            want(planned not in plan.admitted(), "a right submit is accepted", message, planned)

    def submit_seen(
        self, plan: PlannedRun, index: int, rows: list[OutcomeRow], done: gateway.SubmitDone
    ) -> None:
        """A gateway has read a submit to its end."""
        if plan.cancel_at is not None:
            return
        expected = self._expected[plan.name].submits[index]
        want(done.status == expected.status, "a verdict is right", plan.name, index, done, expected.status)
        indexes = [row.index for row in rows]
        want(len(set(indexes)) == len(indexes), "an episode is shown once", indexes)
        if expected.status == "ok":
            seen = {row.index: row.outcome.episode_return for row in rows}
            wanted = {place: each.episode_return for place, each in enumerate(expected.episodes)}
            want(seen == wanted, "a gateway sees the right episodes", plan.name, index, seen, wanted)
        if expected.status == "init_error":
            want(not rows, "nothing is shown of a bundle without a Policy", indexes)

    def finished(self, plan: PlannedRun, result: operator.RunFinished) -> None:
        """An operator has received a run's result."""
        self.finished_runs.add(plan.name)
        if plan.hostile:
            return
        if plan.cancel_at is not None and result.status == "cancelled":
            return
        expected = self._expected[plan.name]
        statuses = [each.status for each in result.submits]
        want(statuses == [each.status for each in expected.submits], "verdicts", plan.name, statuses)
        used = sum(len(each.episodes) for each in expected.submits)
        want(result.budget_used == used, "each episode is charged once", plan.name, result.budget_used, used)
        for index, each in enumerate(expected.submits):
            reported = result.submits[index]
            want(
                (reported.mean_return, reported.val_mean) == (each.mean, each.val_mean),
                "means",
                reported,
                each,
            )
        got = (result.status, result.best_submit_index, result.heldout_returns, result.random_heldout_returns)
        wanted = (expected.status, expected.best, expected.heldout, expected.random)
        want(got == wanted, "a run comes to what it does without faults", plan.name, got, wanted)

    def evaluated(self, split: str, seconds: float) -> None:
        """An evaluation has ended."""
        quick = split == "heldout" or self._simulation.faults != Faults() or seconds <= EVALUATED_S
        want(quick, "open cases are played beside agents", seconds)

    # ---- the core ----

    def loaded(self, core: Core) -> None:
        self._core = core
        check_invariants(core.state)

    def stepped(self, core: Core) -> None:
        self._steps += 1
        quiet_s = self._simulation.world.now - max(self._moved_at, self._simulation.world.calm_at)
        if quiet_s > QUIET_S:
            status = core.status(self._simulation.world.now, reason_text)
            want(False, "it goes on", f"no commit for {quiet_s:.0f} s", status.runs, status.stalls)
        for flow in core.state.unpinned.values():
            want(fleet.offer(core.state, flow) is None, "only runs without workers are unpinned", flow.id)
        if self._steps % VALIDATE_EVERY == 0:
            check_invariants(core.state)
            self._drained(core)

    def _drained(self, core: Core) -> None:
        for name in core.state.out_of_service:
            worker = core.state.workers.get(name)
            if worker is not None:
                late = [
                    lease.id
                    for lease in worker.leases.values()
                    if lease.granted_at > self.drained_at.get(name, 1e18) and not lease.doubtful
                ]
                want(not late, "a worker out of service gets no work", name, late)

    def logged(self, log: Log) -> None:
        if log.event == "job_retried":
            self.retries += 1
            self.unreasoned += 1

    def playing(self, worker: str, lease: wire.Lease) -> None:
        """A worker starts to play a lease."""
        granted = self._granted.get(lease.lease_id)
        want(granted and granted[0] == worker, "a worker plays its own leases", worker, lease.lease_id)

    # ---- the end ----

    def ended(self, core: Core | None) -> None:
        """All runs are over: none of their state is left in memory, and every retry had a reason."""
        want(core is not None, "the coordinator is there in the end")
        assert core is not None
        check_invariants(core.state)
        left = (len(core.state.groups), len(core.state.jobs), len(core.state.polls), len(core.state.runs))
        want(left == (0, 0, 0, 0), "nothing is left in memory", left)
        if self._simulation.harmless:
            want(self.unreasoned == 0, "nothing is retried without a fault", self.unreasoned)
