"""Membership: workers' requests and operators' commands decide who is connected, who gets work, and under which class.

Rules that this module owns:
- A request under a session that is not the worker's current one is refused; the worker then registers again.
- The reply to a heartbeat may be delayed; it is sent at once when there is a lease to stop.
- A lost liveliness token is a hint: it only brings the worker's deadline forward.
- A worker name stays bound to its machine while the worker is connected.
- A token lets a limited number of workers join, with a limited size of descriptions.
- A lease that no heartbeat names for a time to live is given up. No lease expires while the loop itself may have been
  late.
- A worker that sent no request for a time to live is lost, with all its leases.
- Draining and pausing outlive restarts. An operator's change of a run's fingerprint class is recorded in the run.
"""

from __future__ import annotations

from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.reasons import NotDoneError
from evopolicy_coordinator.core.contract.records import WorkerRow
from evopolicy_coordinator.core.isolation import conflicts, occupancies
from evopolicy_coordinator.core.leasing import fleet, leases, pins
from evopolicy_coordinator.core.leasing.jobs import JobFailure
from evopolicy_coordinator.core.tables.model import Profile, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep, ResultReported
from evopolicy_coordinator.core.workers import scheduler


def registered(state: State, event: events.WorkerRegistered, step: CoreStep) -> None:
    """A worker joins, or joins again under a new session."""
    message = event.message
    old = state.workers.get(message.worker)
    if old is not None and old.state != "lost" and old.machine != event.machine:
        # Otherwise one machine could play under another's name, and the other would be blamed.
        raise NotDoneError("name_taken", worker=message.worker)
    if not fleet.has_room(state, event):
        raise NotDoneError("no_room", n=fleet.MAX_WORKERS, size=fleet.MAX_DESCRIBED_BYTES)
    if old is not None:
        fleet.drop_poll(state, old, step)
        fleet.answer_beat(state, old, (), step)
    state.timers.disarm(("forget", message.worker))
    worker = fleet.register(state, event, conflicts.kernel(state, message.boot_id), step)
    occupancies.joined(state, worker, step)
    if old is not None and old.kernel is not worker.kernel:
        occupancies.forgotten(state, old)
    reply = wire.Registered(
        session=event.session,
        lease_ttl_s=state.settings.lease_ttl_s,
        heartbeat_s=state.settings.heartbeat_s,
        refused=pins.refused_runs(state, worker.profile),
        refused_environments=event.refused_environments,
        hidden_bar="" if message.boot_id or not state.isolates else conflicts.NO_BOOT_ID,
    )
    step.reply(event.request, reply)
    name = _class_of_worker(state, worker.profile)
    step.log("info", "worker_registered", worker=worker.name, slots=worker.slots, fingerprint_class=name)
    pins.pin_waiting(state, worker, step)


def worker_of(
    state: State,
    event: events.Requested[wire.LeaseRequest | wire.Heartbeat | wire.ReportResults],
    step: CoreStep,
) -> Worker:
    """Returns the worker that sent the request. Raises NotDoneError when its session is unknown."""
    message = event.message
    known = state.workers.get(message.worker)
    was_lost = known is not None and known.state == "lost"
    worker = fleet.of_session(state, message.worker, message.session, step.now)
    if worker is None:
        raise NotDoneError("unknown_session", worker=message.worker)
    state.timers.arm_once(("worker", worker.name), step.now + state.settings.lease_ttl_s)
    if was_lost:
        pins.pin_waiting(state, worker, step)
    return worker


def lease_requested(state: State, event: events.Requested[wire.LeaseRequest], step: CoreStep) -> None:
    scheduler.poll(state, worker_of(state, event, step), event, step)


def heartbeat(state: State, event: events.Requested[wire.Heartbeat], step: CoreStep) -> None:
    """Renew the leases that a worker names, and reply with those to stop."""
    message = event.message
    worker = worker_of(state, event, step)
    fleet.answer_beat(state, worker, (), step)
    stop = leases.hear(state, worker, message.held, step, settled=message.settled)
    worker.beat = event.request
    if stop or not message.wait_s > 0.0:
        fleet.answer_beat(state, worker, stop, step)
    else:
        state.timers.arm(("beat", worker.name), step.now + min(message.wait_s, state.settings.max_wait_s))


def results_reported(state: State, event: events.Requested[wire.ReportResults], step: CoreStep) -> None:
    """Take results, and answer once they are durable."""
    worker = worker_of(state, event, step)
    for result in event.message.results:
        step.tell(ResultReported(worker, result))
    step.reply_last(event.request, wire.ResultsReported(n=len(event.message.results)))


def liveness_lost(state: State, event: events.LivenessLost, step: CoreStep) -> None:
    """Check the worker's leases sooner than otherwise; a hint only."""
    worker = state.workers.get(event.worker)
    if worker is not None and worker.state != "lost" and worker.doubted_at is None:
        worker.doubted_at = step.now
        state.timers.arm(("worker", worker.name), step.now + state.settings.liveness_grace_s)


def worker_state(state: State, event: events.Requested[operator.SetWorker], step: CoreStep) -> None:
    """Drain, pause or reactivate a worker; durable, also for one that is not connected."""
    message = event.message
    step.persist(WorkerRow(worker=message.worker, state=message.state))
    worker = state.workers.get(message.worker)
    if worker is not None and message.state != "active":
        fleet.drop_poll(state, worker, step)
    fleet.set_state(state, message.worker, message.state)
    if worker is not None:
        fleet.answer_beat(state, worker, (), step)
        state.freed[worker.name] = None
        pins.pin_waiting(state, worker, step)
        for lane in worker.profile.lanes.values():
            step.dirty[lane] = None
    step.reply(event.request, operator.Done())


def repinned(state: State, event: events.Requested[operator.RepinRun], step: CoreStep) -> None:
    """Pin an unfinished run to another class of workers on an operator's command."""
    message = event.message
    run = state.runs.get(message.run)
    if run is None:
        raise NotDoneError("no_unfinished_run", run=message.run)
    able = [each for each in state.profiles.values() if each.offers(run.flow)]
    # Accepts the environment's class, and the whole worker's class, which the list of workers shows.
    offered = {_class_of_worker(state, each): each for each in able}
    offered |= {each.classes[run.flow.env]: each for each in able}
    if message.fingerprint_class not in offered:
        raise NotDoneError(
            "unknown_class", name=message.fingerprint_class, offered=", ".join(offered) or "none"
        )
    profile = offered[message.fingerprint_class]
    name = profile.classes[run.flow.env]
    text = f"{run.state.fingerprint_class} → {name}: {message.reason}"
    step.change_run(
        run,
        fingerprint_class=name,
        overrides=(*run.state.overrides, text),
        description=run.state.description or profile.descriptions[run.flow.env],
        fingerprint=run.state.fingerprint or profile.fingerprints[run.flow.env],
    )
    run.flow.description = run.state.description
    pins.place(state, run.flow, name, step)
    step.log("warning", "run_repinned", run=run.id, override=text)
    step.reply(event.request, operator.Done())


def _class_of_worker(state: State, profile: Profile) -> str:
    return profile.fingerprint.class_name(cpu=state.settings.fingerprint_cpu)


def forget(state: State, name: str, _step: CoreStep) -> None:
    """The deadline of a worker that was lost long ago."""
    worker = state.workers.get(name)
    if worker is not None and worker.state == "lost":
        fleet.forget(state, worker)
        occupancies.forgotten(state, worker)


FORGET_S = 3600.0
"""A lost worker is listed for this long."""


def check_due(state: State, name: str, step: CoreStep) -> None:
    """A worker's deadline: give up expired leases, declare a silent worker lost, and set the next deadline."""
    worker, settings, now = state.workers.get(name), state.settings, step.now
    if worker is None:
        return
    if now < state.hold_until:
        state.timers.arm(("worker", worker.name), state.hold_until)
        return
    silent_at = worker.last_seen + settings.lease_ttl_s
    if worker.doubted_at is not None:
        silent_at = min(silent_at, worker.doubted_at + settings.liveness_grace_s)
    if worker.state != "lost" and now >= silent_at:
        lose(state, worker, step)
        return
    running = {lease.id for lease in worker.running()}
    deadlines = [] if worker.state == "lost" else [silent_at]
    for lease in list(worker.leases.values()):
        due = lease.renewed + settings.lease_ttl_s if lease.orphan_until is None else lease.orphan_until
        # For each episode of a job the policy's limits plus `job_deadline_s`, the coordinator's own bound, which
        # also covers the wait in a batch.
        limits = lease.job.group.template.limits
        each_s = limits.episode_wall_s + limits.init_wall_s + settings.job_deadline_s
        overdue = (lease.started_at or lease.granted_at) + lease.job.n * each_s
        if now >= overdue and lease.live:
            leases.stop(state, lease, step)
            leases.give_back(state, lease.job, "overdue", worker, step, ran=True)
        elif now >= due:
            live, orphan = lease.live, lease.orphan_until is not None
            leases.release(state, worker, lease, step)
            if live:
                failure: JobFailure = "worker_lost" if orphan else "unlisted"
                leases.give_back(state, lease.job, failure, worker, step, ran=orphan and lease.id in running)
        else:
            deadlines.append(min(due, overdue) if lease.live else due)
    if deadlines:
        state.timers.arm(("worker", worker.name), min(deadlines))


def lose(state: State, worker: Worker, step: CoreStep) -> None:
    """Declare a silent worker lost: all its jobs go back, and those that it was playing become suspects."""
    running = {lease.id for lease in worker.running()}
    fleet.count_out(worker)
    step.log("warning", "worker_lost", worker=worker.name, held=len(worker.leases), running=len(running))
    _take_all(state, worker, "worker_lost", (), running, step)
    state.timers.arm(("forget", worker.name), step.now + FORGET_S)


def _take_all(
    state: State, worker: Worker, failure: JobFailure, stop: tuple[str, ...], ran: set[str], step: CoreStep
) -> None:
    """Answer a worker's poll and heartbeat, with the leases to stop, and put all its jobs back."""
    fleet.drop_poll(state, worker, step)
    fleet.answer_beat(state, worker, stop, step)
    for lease in list(worker.leases.values()):
        live = lease.live
        leases.release(state, worker, lease, step)
        if live:
            leases.give_back(state, lease.job, failure, worker, step, ran=lease.id in ran)
