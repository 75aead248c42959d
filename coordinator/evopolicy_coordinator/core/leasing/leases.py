"""Leases: a worker's right to play a job, and what happens to the job when it ends. `membership` decides when a lease
expires.

Rules that this module owns:
- A job has at most one live lease. Every lease has the job's next attempt number; given-up attempts are fenced off:
  their failures do not affect the job, and their holders must stop. (An outcome is accepted from any attempt, see
  `workers.results`: it is the same on every worker.)
- Heartbeats that name a lease keep it alive. A lease that never arrived at its worker is given up.
- A lease that this incarnation did not grant is adopted from its holder's heartbeat if its job waits.
- Giving up a job's lease puts the job back as `jobs.decide` says; only jobs that ran are blamed.
- A worker that stops a policy's hidden job returns the policy's actions so far, and the next attempt plays them first.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterable

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.isolation import conflicts, occupancies
from evopolicy_coordinator.core.leasing import fleet, queue
from evopolicy_coordinator.core.leasing.jobs import JobFailure, build, decide
from evopolicy_coordinator.core.tables.model import JobGroup, JobState, OpenLease, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep, JobRetried

MISSING_BEATS = 3
"""A lease that its worker has not named for this many heartbeat intervals since the grant has never arrived."""


def lease_id(secret: bytes, job_id: str, attempt: int, worker: str) -> str:
    """A lease's name, made from its job, attempt and worker: equal in every incarnation.

    Only a holder of the run's secret can make it. It proves to a later incarnation, which has no list of earlier
    leases, that this worker was granted this attempt.
    """
    proof = hmac.digest(secret, f"lease|{job_id}|{attempt}|{worker}".encode(), hashlib.sha256)
    return f"{job_id}#{attempt}#{proof[:12].hex()}"


def granted(state: State, name: str, job_id: str, attempt: int, worker: Worker) -> bool:
    """Whether a lease of that name was granted to the worker, by this incarnation or an earlier one."""
    group = state.groups.get(job_id.rpartition("/")[0])
    if group is None:
        return False
    return hmac.compare_digest(
        name.encode(), lease_id(group.flow.secret, job_id, attempt, worker.name).encode()
    )


# ---- granting ----


def grant(state: State, job: JobState, worker: Worker, step: CoreStep) -> wire.Lease:
    """Lease a job that has just left the queue."""
    job.attempts += 1
    serial = 0 if worker.poll is None else worker.poll.serial
    lease = _enter(state, job, worker, job.attempts, step, serial=serial)
    job.held_attempts.add(lease.attempt)
    group = job.group
    description = group.flow.description or worker.profile.descriptions[group.template.env]
    return wire.Lease(
        lease_id=lease.id,
        attempt=lease.attempt,
        stimulus_id=group.stimulus_id,
        job=build(job, description),
        stop_in_silence=group.hidden and state.isolates,
    )


def _enter(
    state: State, job: JobState, worker: Worker, attempt: int, step: CoreStep, *, serial: int
) -> OpenLease:
    now = step.now
    name = lease_id(job.group.flow.secret, job.job_id, attempt, worker.name)
    lease = OpenLease(name, job, worker.name, attempt, granted_at=now, renewed=now, progress_at=now)
    job.lease = lease
    job.move("leased")
    worker.leases[name] = lease
    worker.n_live += 1
    worker.held[job.priority] += 1
    group = job.group
    group.n_leased += 1
    group.flow.n_leased += 1
    state.n_live += 1
    occupancies.leased(state, lease, worker, serial, step)
    let_go(state, group, now)
    if group.first_leased_at is None:
        group.first_leased_at = now
        limit_s = group.template.limits.submit_wall_s
        if group.kind == "train" and limit_s is not None:
            state.timers.arm(("submit", group.id), now + limit_s)
    if job.alone:
        worker.alone = lease
    state.timers.arm_once(("worker", worker.name), now + state.settings.lease_ttl_s)
    return lease


def let_go(state: State, group: JobGroup, now: float) -> None:
    """Stop counting the time for which a submit is held."""
    if group.held_since is not None:
        group.held_s = group.held_until_s(now)
        group.held_since = None
        del state.held[group]


# ---- heartbeats ----


def hear(
    state: State, worker: Worker, held: Iterable[wire.HeldLease], step: CoreStep, *, settled: int
) -> tuple[str, ...]:
    """Process a heartbeat: renew the named leases, adopt unknown ones whose job waits. Returns the leases that the
    worker is to stop. All polls of the worker up to number `settled` are finished."""
    now = step.now
    stop: list[str] = []
    named: set[str] = set()
    for item in held:
        named.add(item.lease_id)
        lease = worker.leases.get(item.lease_id) or _adopt(state, worker, item, step)
        if lease is None:
            occupancies.unknown(state, worker, item, step)
        elif lease.live:
            lease.doubtful = lease.doubtful or now - lease.renewed > state.settings.silence_s
            lease.renewed = now
            lease.orphan_until = None
        if lease is None or not lease.live:
            stop.append(item.lease_id)
            continue
        lease.named = True
        lease.running = item.running
        if item.running and lease.started_at is None:
            lease.started_at = now
        if (item.episodes_done, item.steps) != (lease.episodes_done, lease.steps):
            lease.episodes_done, lease.steps, lease.progress_at = item.episodes_done, item.steps, now
    missing_since = now - MISSING_BEATS * state.settings.heartbeat_s
    for lease in [each for each in worker.leases.values() if each.id not in named]:
        if not lease.live:
            _leave(state, worker, lease, step, sure=occupancies.surely(worker, lease.occupancy, settled))
        elif not lease.named and lease.granted_at < missing_since and now >= state.hold_until:
            sure = occupancies.surely(worker, lease.occupancy, settled)
            release(state, worker, lease, step, sure=sure)
            give_back(state, lease.job, "unlisted", worker, step, ran=False)
    occupancies.heard(state, worker, named, settled, step)
    return tuple(stop)


def _adopt(state: State, worker: Worker, item: wire.HeldLease, step: CoreStep) -> OpenLease | None:
    """Adopt a lease of an earlier incarnation that a worker still holds; None when it must not continue."""
    job = state.jobs.get(item.job_id)
    if (
        job is None
        or job.lease is not None
        or item.attempt in job.held_attempts
        or not granted(state, item.lease_id, item.job_id, item.attempt, worker)
        or not conflicts.adoptable(state, job, worker)
    ):
        return None
    fleet.unreserve(state, job)
    queue.withdraw(state, job)
    state.timers.disarm(("job", job.job_id))
    state.adopting.pop(job, None)
    job.held_attempts.add(item.attempt)
    lease = _enter(state, job, worker, item.attempt, step, serial=0)
    lease.doubtful = True
    return lease


# ---- giving up ----


def end(state: State, lease: OpenLease) -> None:
    """The lease no longer counts. Its worker learns of it from its next heartbeat, or at once if one waits."""
    if not lease.live:
        return
    lease.live = False
    job = lease.job
    job.lease = None
    job.group.n_leased -= 1
    job.group.flow.n_leased -= 1
    state.n_live -= 1
    worker = state.workers[lease.worker]
    worker.n_live -= 1
    worker.held[job.priority] -= 1


def stop(state: State, lease: OpenLease, step: CoreStep) -> None:
    """End a lease that its worker still holds; a waiting poll or heartbeat is answered with it at
    the end of this step."""
    end(state, lease)
    step.stops.setdefault(lease.worker, []).append(lease.id)


def release(state: State, worker: Worker, lease: OpenLease, step: CoreStep, *, sure: bool = False) -> None:
    """End a lease that its worker has released. `sure`: the worker reported so; otherwise it is the
    coordinator's assumption."""
    end(state, lease)
    _leave(state, worker, lease, step, sure=sure)


def _leave(state: State, worker: Worker, lease: OpenLease, step: CoreStep, *, sure: bool) -> None:
    worker.leases.pop(lease.id, None)
    occupancies.vacate(state, lease, worker, step, sure=sure)
    if worker.alone is lease:
        worker.alone = None
    state.freed[worker.name] = None


def give_back(
    state: State,
    job: JobState,
    failure: JobFailure,
    worker: Worker,
    step: CoreStep,
    *,
    ran: bool,
    error: str = "",
) -> None:
    """Put a job whose lease has ended back into the queue, as `jobs.decide` says."""
    retry = decide(state.settings, failure, failures=job.failures + 1, ran=ran)
    job.since = step.now
    if retry.counted:
        job.failures += 1
        job.last_failure = f"{failure} on {worker.name}" + (f": {error[:400]}" if error else "")
        step.tell(JobRetried(job, worker.name, failure))
        step.log(
            "warning",
            "job_retried",
            job=job.job_id,
            worker=worker.name,
            failure=failure,
            failures=job.failures,
            delay_s=retry.delay_s,
            alone=retry.alone,
            error=error[:2000],
        )
    job.alone = job.alone or retry.alone
    if retry.avoid:
        job.avoid, job.avoid_until = worker.name, step.now + retry.delay_s + state.settings.avoid_s
    if retry.delay_s > 0.0:
        job.move("backing_off")
        state.timers.arm(("job", job.job_id), step.now + retry.delay_s)
    else:
        queue.put(state, job, step, front=True)
