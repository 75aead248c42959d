"""What an open group waits for while nothing of it is leased."""

from __future__ import annotations

from evopolicy_common.messages.gateway import FREE_SLOT
from evopolicy_coordinator.core.isolation import bars
from evopolicy_coordinator.core.model import Flow, JobGroup
from evopolicy_coordinator.core.state import State


def waits_for(state: State, group: JobGroup) -> str:
    """What an open group waits for when nothing of it is leased, in words that an agent may read; else empty."""
    if group.n_leased or group.closed or not group.jobs:
        return ""
    flow = group.flow
    if missing := waits_for_workers(state, flow):
        return missing
    if obstacle := bars.obstacle(state, group):
        return obstacle
    if any(job.place == "parting" for job in group.jobs.values()):
        return "workers to hand back what they were told to stop"
    if any(job.lease is None and not job.queued for job in group.jobs.values()):
        waits_to_adopt = any(job in state.adopting for job in group.jobs.values())
        return "workers to report after a restart" if waits_to_adopt else "another try after a fault of ours"
    profiles = () if flow.lane is None else flow.lane.profiles
    if all(("bench", name) in state.timers for profile in profiles for name in profile.workers):
        return "workers whose jobs kept failing to be tried again"
    return FREE_SLOT


def waits_for_workers(state: State, flow: Flow) -> str:
    """The workers that a run or an evaluation waits for, in words that an agent may read; empty when some are at work."""
    if flow.lane is not None and flow.lane.slots():
        return ""
    wanted = f"a worker that offers {flow.env} with sandbox tier {flow.tier}"
    able = [
        worker
        for worker in state.workers.values()
        if flow.env in worker.profile.descriptions and flow.tier in worker.profile.key[1]
    ]
    same = [worker for worker in able if flow.pin in (None, worker.profile.fingerprint_class)]
    if len(same) < len(able):
        wanted += ", of the same versions as the run began with"
    # Nothing of audits reaches an agent.
    words = {"quarantined": "out of service"}
    away = sorted({words.get(worker.state, worker.state) for worker in same if worker.state != "active"})
    return f"{wanted}: those that do are {' or '.join(away)}" if away else wanted
