"""Makes room: stops hidden jobs for train jobs that wait, and empties a worker for a suspect.

Rules that this module owns:
- A waiting train job stops hidden jobs; a suspect stops those of the worker that is emptied for it. Early
  validation is stopped without limit, others a bounded number of times. The hidden job goes back into the
  queue; its worker releases it and polls again.
- A suspect is a job that may crash workers. It runs alone, on an idle worker or on one that is emptied for it;
  that worker gets no other job in the meantime.
"""

from __future__ import annotations

from itertools import islice

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.leasing import fleet, leases, queue
from evopolicy_coordinator.core.tables.model import (
    EARLY_VALIDATION,
    HELDOUT,
    REFERENCE,
    TRAIN,
    CaseSet,
    JobState,
    Lane,
    Lease,
    Worker,
)
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step

VICTIMS_MAX = 256
"""Most hidden leases checked for a lane in one step."""

CASE_SETS_MAX = 8
"""Most case sets of waiting train jobs that hidden jobs are stopped for in one step."""

SUSPECTS_MAX = 16
"""Most suspects checked in one step."""


def preempt(state: State, lane: Lane, step: Step) -> None:
    """Stop hidden jobs for the train jobs that wait in the lane.

    The last leased are stopped first: they have progressed least, and in a batch they wait behind the others.
    """
    if any(any(profile.hidden) for profile in lane.profiles):
        # Hidden jobs that are spared now may have to be stopped later without any further event: a worker is no longer
        # avoided, or one that was to release a hidden job is lost.
        state.timers.arm_once(("lane", lane.key), step.now + queue.RECHECK_S)
    wanted = lane.n_ready[TRAIN] - lane.stopping
    avoided = queue.avoided(lane, TRAIN, step.now)
    for case_set in list(islice(lane.waiting[TRAIN], CASE_SETS_MAX)):
        wanted -= clear(state, lane, case_set, avoided, step)
    for priority in (EARLY_VALIDATION, HELDOUT, REFERENCE):
        for profile in lane.profiles:
            hidden = profile.hidden[priority]
            for lease in list(islice(reversed(hidden), VICTIMS_MAX)):
                job = lease.job
                if wanted <= 0:
                    return
                worker = state.workers[lease.worker]
                if lease.worker == avoided or conflicts.goes_first(lease):
                    continue
                if not queue.open_to(state, lane, TRAIN, worker):
                    continue
                if not may_stop(state, job):
                    del hidden[lease]
                    continue
                stop_hidden(state, lease, step)
                if worker.n_live < worker.slots:
                    # Only this stop frees a slot: the leases stopped before it were still waiting for one.
                    wanted -= 1
                    lane.stopping += 1
                    lease.stopped_for = lane


def clear(state: State, lane: Lane, case_set: CaseSet | None, avoided: str | None, step: Step) -> int:
    """Stop the related hidden jobs that keep a case set's train jobs from kernels, on as many kernels as have slots for
    them: a single hidden job bars its whole kernel. Returns the number of freed slots."""
    slots = 0
    wanted = lane.waiting[TRAIN].get(case_set, 0)
    for kernel, playing in conflicts.to_clear(state, case_set):
        if slots >= wanted:
            break
        there = [state.workers[name] for name in kernel.workers if name != avoided]
        room = sum(worker.slots for worker in there if worker.profile in lane.profiles)
        if not room:
            continue
        # A job that may not be stopped again plays to its end; no hidden job starts there in the meantime.
        lasting = any(not may_stop(state, lease.job) for lease in playing)
        for lease in playing:
            if not lasting or lease.job.priority != HELDOUT:
                stop_hidden(state, lease, step)
        if not lasting:
            slots += room
    return slots


def may_stop(state: State, job: JobState) -> bool:
    """Whether train jobs may stop a hidden job (once more)."""
    bounded = job.priority in (HELDOUT, REFERENCE)
    return not bounded or job.preemptions < state.settings.preemptions_max


def stop_hidden(state: State, lease: Lease, step: Step) -> None:
    """Stop a hidden job for train jobs; it goes back into the queue."""
    lease.job.preemptions += 1
    leases.put_off(state, lease, step)


# ---- suspects ----


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
        if job.priority >= EARLY_VALIDATION and (lane.n_ready[TRAIN] or not idle):
            continue
        if _barred(state, job, worker):
            continue
        if idle:
            return _alone(state, job, worker, step)
        _reserve(state, job, worker, step)
        return None
    return None


def _barred(state: State, job: JobState, worker: Worker) -> bool:
    return conflicts.conflict(state, job.priority, job.group.flow.case_set, worker)


def _reserve(state: State, job: JobState, worker: Worker, step: Step) -> None:
    """Start to empty a busy worker for a suspect; a train job stops the hidden jobs there rather than wait for them."""
    job.reserved = worker.name
    worker.reserved = job
    if job.priority == TRAIN:
        for lease in list(worker.leases.values()):
            first = conflicts.goes_first(lease)
            if lease.live and lease.job.priority != TRAIN and not first and may_stop(state, lease.job):
                stop_hidden(state, lease, step)


def _alone(state: State, job: JobState, worker: Worker, step: Step) -> wire.Lease:
    fleet.unreserve(state, job)
    queue.withdraw(state, job)
    return leases.grant(state, job, worker, step)
