"""Expiry of leases: the worker fell silent, does not name the lease, or holds it for too long.

Rules that this module owns:
- A lease that no heartbeat names for a time to live is given up. No lease expires while the loop itself may have been
  late.
- A worker that sent no request for a time to live is lost, with all its leases.
"""

from __future__ import annotations

from evopolicy_coordinator.core.leasing import fleet, leases
from evopolicy_coordinator.core.leasing.jobs import JobFailure
from evopolicy_coordinator.core.tables.model import JobState, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step

FORGET_S = 3600.0
"""A lost worker is listed for this long."""


def check_due(state: State, name: str, step: Step) -> None:
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
        overdue = (lease.started_at or lease.granted_at) + _longest_s(state, lease.job)
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


def _longest_s(state: State, job: JobState) -> float:
    """Longest time that a job may be held, seconds: for each episode the policy's limits plus `job_deadline_s`, the
    coordinator's own bound, which also covers the wait in a batch."""
    limits = job.group.template.limits
    each = limits.episode_wall_s + limits.init_wall_s + state.settings.job_deadline_s
    return job.n * each


def lose(state: State, worker: Worker, step: Step) -> None:
    """Declare a silent worker lost: all its jobs go back, and those that it was playing become suspects."""
    running = {lease.id for lease in worker.running()}
    fleet.count_out(worker)
    step.log("warning", "worker_lost", worker=worker.name, held=len(worker.leases), running=len(running))
    _take_all(state, worker, "worker_lost", (), running, step)
    state.timers.arm(("forget", worker.name), step.now + FORGET_S)


def _take_all(
    state: State, worker: Worker, failure: JobFailure, stop: tuple[str, ...], ran: set[str], step: Step
) -> None:
    """Answer a worker's poll and heartbeat, with the leases to stop, and put all its jobs back."""
    fleet.drop_poll(state, worker, step)
    fleet.answer_beat(state, worker, stop, step)
    for lease in list(worker.leases.values()):
        live = lease.live
        leases.release(state, worker, lease, step)
        if live:
            leases.give_back(state, lease.job, failure, worker, step, ran=lease.id in ran)
