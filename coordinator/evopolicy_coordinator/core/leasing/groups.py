"""Groups of jobs: a submit's train episodes, a checkpoint's hidden ones, an evaluation's, an audit's replay.

Rules that this module owns: what of a group is not done is queued when it opens; nothing of it is played once it is closed.
"""

from __future__ import annotations

from evopolicy_coordinator.core.model import JobGroup, JobState
from evopolicy_coordinator.core.state import State
from evopolicy_coordinator.core.step import Step

from . import fleet, leases, queue
from .jobs import open_jobs


def open_group(state: State, group: JobGroup, step: Step) -> None:
    """Queue what is not done of a group. While loading, jobs wait to be adopted first."""
    state.groups[group.id] = group
    loading, heads = state.loading, []
    if loading is not None:
        heads = loading.heads.pop(group.id, [])
        loading.reloaded.append(group)
    for job in open_jobs(group, heads, state.first_attempt, step.now):
        state.jobs[job.job_id] = job
        if loading is not None:
            begun = loading.begun.get((group.id, job.first))
            if begun is not None:
                job.begun, job.begun_attempt = begun.begun, begun.attempt
            job.move("adopting")
            state.adopting[job] = None
        else:
            queue.put(state, job, step)
    state.story.tell(step.now, step.stimulus_id, group.id, f"opened, {group.done} of {group.n} done")


def close_group(state: State, group: JobGroup, step: Step, why: str) -> None:
    """Nothing more is played of a group; what is leased is stopped."""
    for job in list(group.jobs.values()):
        close_job(state, job, step, why)
    group.closed = True
    leases.let_go(state, group, step.now)
    state.groups.pop(group.id, None)
    state.timers.disarm(("submit", group.id))
    state.story.tell(step.now, step.stimulus_id, group.id, f"closed: {why}")


def close_job(state: State, job: JobState, step: Step, why: str) -> None:
    """A job is open no more."""
    if job.lease is not None:
        leases.stop(state, job.lease, step, why)
    job.parting = None
    queue.withdraw(state, job)
    fleet.unreserve(state, job)
    state.adopting.pop(job, None)
    state.timers.disarm(("job", job.job_id))
    job.move("closed")
    del job.group.jobs[job.first]
    del state.jobs[job.job_id]


def promote(state: State, group: JobGroup, priority: int, step: Step) -> None:
    """Move a group's open jobs to another priority."""
    if group.priority == priority:
        return
    group.priority = priority
    for job in group.jobs.values():
        queued = job.queued
        queue.withdraw(state, job)
        if job.lease is not None:
            held = state.workers[job.lease.worker].held
            held[job.priority] -= 1
            held[priority] += 1
        job.priority = priority
        if queued:
            queue.put(state, job, step)
        elif job.lease is not None:
            leases.list_hidden(state, job.lease, state.workers[job.lease.worker], step)
