"""Suspects: jobs that may crash workers.

Rule that this module owns: a suspect runs alone, on an idle worker or on one that is emptied for it; that worker gets
no other job in the meantime.
"""

from __future__ import annotations

from itertools import islice

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.leasing import fleet, leases, queue
from evopolicy_coordinator.core.tables.model import JobState, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step

SUSPECTS_MAX = 16
"""Most suspects checked in one step."""


def next_suspect(state: State, worker: Worker, step: Step) -> wire.Lease | None:
    """Lease a suspect to an idle worker; a busy worker may be reserved for one instead (returns None)."""
    idle = not worker.leases
    if worker.reserved is not None:
        job = worker.reserved
        if not job.queued or _barred(state, job, worker):
            worker.reserved = job.reserved = None
        elif not idle:
            return None
        else:
            return _alone(state, job, worker, step)
    for job in list(islice(state.suspects, SUSPECTS_MAX)):
        lane = job.group.flow.lane
        if lane is None or worker.profile not in lane.profiles:
            continue
        if job.reserved is not None and not idle:
            continue
        if job.avoid == worker.name and step.now < job.avoid_until and lane.workers() > 1:
            continue
        if _barred(state, job, worker):
            continue
        if idle:
            return _alone(state, job, worker, step)
        job.reserved, worker.reserved = worker.name, job
        return None
    return None


def _barred(state: State, job: JobState, worker: Worker) -> bool:
    return conflicts.conflict(state, job.priority, job.group.flow.case_set, worker)


def _alone(state: State, job: JobState, worker: Worker, step: Step) -> wire.Lease:
    fleet.unreserve(state, job)
    queue.withdraw(state, job)
    return leases.grant(state, job, worker, step)
