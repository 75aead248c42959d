"""Groups of jobs: a submit's train episodes, a checkpoint's hidden ones, an evaluation's.

Rules that this module owns:
- A group is a list of episodes with indexes 0 … n − 1, cut into jobs; each index gets exactly one outcome.
- The unfinished jobs of a group are queued when it opens; none of them is played after it is closed.
- Of a finished episode only its digest is kept, and only while the group is open.
"""

from __future__ import annotations

from evopolicy_coordinator.core.contract.records import OutcomeHead
from evopolicy_coordinator.core.leasing import fleet, leases, queue
from evopolicy_coordinator.core.tables.model import JobGroup, JobState, OutcomeDigest
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep


def open_group(state: State, group: JobGroup, step: CoreStep) -> None:
    """Queue the unfinished jobs of a group. While the core is loaded, jobs first wait to be adopted."""
    state.groups[group.id] = group
    group.flow.n_hidden += group.hidden
    loading, heads = state.loading, []
    if loading is not None:
        heads = loading.heads.pop(group.id, [])
        loading.reloaded.append(group)
    for job in _cut(group, heads, state.first_attempt, step.now):
        state.jobs[job.job_id] = job
        if loading is not None:
            begun = loading.begun.get((group.id, job.first))
            if begun is not None:
                job.begun, job.begun_attempt = begun.begun, begun.attempt
            job.move("adopting")
            state.adopting[job] = None
        else:
            queue.put(state, job, step)


def _cut(group: JobGroup, heads: list[OutcomeHead], attempts: int, now: float) -> list[JobState]:
    """Fill `group.digests` from the stored heads and `group.jobs` with the unfinished jobs, in order.

    A job of several episodes is stored whole or not at all.
    """
    for head in sorted(heads, key=lambda head: head.seq):
        if head.success is not None:
            group.solved[head.index] = head.success
        group.digests[head.index] = OutcomeDigest(
            head.episode_return, head.length, head.failure, head.trajectory
        )
    # With policy scope `submit`, the episodes that share one Policy are one job.
    per_job = group.template.modulo if group.template.scope == "submit" else 1
    for first in range(0, group.n, per_job):
        if first in group.digests:
            continue
        group.jobs[first] = JobState(
            job_id=f"{group.id}/{first}",
            group=group,
            first=first,
            n=min(per_job, group.n - first),
            attempts=attempts,
            priority=group.priority,
            since=now,
        )
    return list(group.jobs.values())


def close_group(state: State, group: JobGroup, step: CoreStep) -> None:
    """Close a group: its leased jobs are stopped, and no more of its jobs are played."""
    for job in list(group.jobs.values()):
        close_job(state, job, step)
    group.closed = True
    group.flow.n_hidden -= group.hidden
    leases.let_go(state, group, step.now)
    state.groups.pop(group.id, None)
    state.timers.disarm(("submit", group.id))


def close_job(state: State, job: JobState, step: CoreStep) -> None:
    """Stop and remove an open job."""
    if job.lease is not None:
        leases.stop(state, job.lease, step)
    queue.withdraw(state, job)
    fleet.unreserve(state, job)
    state.adopting.pop(job, None)
    state.timers.disarm(("job", job.job_id))
    job.move("closed")
    del job.group.jobs[job.first]
    del state.jobs[job.job_id]
