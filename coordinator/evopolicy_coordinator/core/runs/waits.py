"""The reason why an open group waits while none of its jobs is leased."""

from __future__ import annotations

from evopolicy_coordinator.core.contract.reasons import Reason, because
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.tables.model import Flow, JobGroup
from evopolicy_coordinator.core.tables.state import State

_SHOWN = 3
"""At most so many workers are named with what they lack."""


def waits_for(state: State, group: JobGroup) -> Reason | None:
    """Returns the reason why an open group waits; None when one of its jobs is leased."""
    if group.n_leased or group.closed or not group.jobs:
        return None
    flow = group.flow
    if missing := waits_for_workers(state, flow):
        return missing
    if obstacle := conflicts.obstacle(state, group):
        return obstacle
    if any(job.lease is None and not job.queued for job in group.jobs.values()):
        waits_to_adopt = any(job in state.adopting for job in group.jobs.values())
        return because("adoption" if waits_to_adopt else "own_fault")
    profiles = () if flow.lane is None else flow.lane.profiles
    if all(("bench", name) in state.timers for profile in profiles for name in profile.workers):
        return because("bench")
    return because("free_slot")


def waits_for_workers(state: State, flow: Flow) -> Reason | None:
    """Returns the workers that a run or an evaluation waits for; None when its lane has active ones."""
    if flow.lane is not None and flow.lane.slots():
        return None
    able = [worker for worker in state.workers.values() if worker.profile.offers(flow)]
    same = [worker for worker in able if flow.pin in (None, worker.profile.classes[flow.env])]
    later = [
        worker
        for worker in state.workers.values()
        if flow.env in worker.undescribed and flow.tier in worker.profile.key[1]
    ]
    if any(worker.state == "active" for worker in later):
        return because("description", env=flow.env)
    away = {worker.state for worker in (*same, *later) if worker.state != "active"}
    lacking = [
        (worker.name, worker.missing_tiers[flow.tier])
        for worker in state.workers.values()
        if worker.state != "lost"
        and flow.tier in worker.missing_tiers
        and (flow.env in worker.profile.classes or flow.env in worker.undescribed)
    ]
    failed = [
        (worker.name, worker.failed_environments[flow.env])
        for worker in state.workers.values()
        if worker.state != "lost" and flow.env in worker.failed_environments
    ]
    return because(
        "workers",
        env=flow.env,
        tier=flow.tier,
        same_versions=len(same) < len(able),
        away=tuple(sorted(away)),
        connected=any(worker.state != "lost" for worker in state.workers.values()),
        lacking=tuple(lacking[:_SHOWN]),
        failed=() if able or later else tuple(failed[:_SHOWN]),
    )
