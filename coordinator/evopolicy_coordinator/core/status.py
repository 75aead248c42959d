"""What an operator may see of the whole: workers, runs, and what waits longer than it should, and for what.

Looks at everything, so it is for a status request only, never for an event.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from evopolicy_common.messages.gateway import FREE_SLOT
from evopolicy_common.messages.operator import RunStatus, WorkerStatus
from evopolicy_common.messages.worker import Fingerprint

from . import audit
from .finalisation import progress
from .jobs import AUDIT, JobGroup
from .queue import Flow, Lane, Profile
from .runs import Run

if TYPE_CHECKING:
    from .machine import Core
    from .workers import Worker

RATE_S = 60


class CoreStatus(NamedTuple):
    """The core's part of a `StatusReply`."""

    episodes_done: int
    """Since the core was loaded."""
    episodes_per_s: float
    """Over the last minute."""
    workers: tuple[WorkerStatus, ...]
    runs: tuple[RunStatus, ...]
    stalls: tuple[str, ...]
    audit_share: float
    audits: dict[str, int]
    """Of the unfinished runs, by state."""
    disputes: tuple[str, ...]
    quarantined: dict[str, str]


class Rate:
    """Episodes done, in all and over the last minute; one count a second is kept."""

    def __init__(self) -> None:
        self.total = 0
        self._seconds: deque[list[int]] = deque(maxlen=RATE_S)

    def count(self, n: int, now: float) -> None:
        """`n` more are done."""
        self.total += n
        second = int(now)
        if self._seconds and self._seconds[-1][0] == second:
            self._seconds[-1][1] += n
        else:
            self._seconds.append([second, n])

    def per_s(self, now: float) -> float:
        """Episodes a second over the last minute."""
        return sum(n for second, n in self._seconds if second > now - RATE_S) / RATE_S


def waits_for(core: Core, group: JobGroup) -> str:
    """What an open group waits for when nothing of it is leased, in words that an agent may read; else empty."""
    if group.n_leased or group.closed or not group.jobs:
        return ""
    flow = group.flow
    if missing := waits_for_workers(core, flow):
        return missing
    if obstacle := core.isolation.obstacle(group):
        return obstacle
    if any(job.lease is None and not job.queued for job in group.jobs.values()):
        waits_to_adopt = any(job in core.adopting for job in group.jobs.values())
        return "workers to report after a restart" if waits_to_adopt else "another try after a fault of ours"
    profiles = () if flow.lane is None else flow.lane.profiles
    if all(("bench", name) in core.timers for profile in profiles for name in profile.workers):
        return "workers whose jobs kept failing to be tried again"
    return FREE_SLOT


def waits_for_workers(core: Core, flow: Flow) -> str:
    """The workers that a run or an evaluation waits for, in words that an agent may read; empty when some are at work."""
    if flow.lane is not None and flow.lane.slots():
        return ""
    wanted = f"a worker that offers {flow.env} with sandbox tier {flow.tier}"
    able = [
        worker
        for worker in core.fleet.workers.values()
        if flow.env in worker.profile.descriptions and flow.tier in worker.profile.key[1]
    ]
    same = [worker for worker in able if flow.pin in (None, worker.profile.fingerprint_class)]
    if len(same) < len(able):
        wanted += ", of the same versions as the run began with"
    # Nothing of audits reaches an agent.
    words = {"quarantined": "out of service"}
    away = sorted({words.get(worker.state, worker.state) for worker in same if worker.state != "active"})
    return f"{wanted}: those that do are {' or '.join(away)}" if away else wanted


def status(core: Core, now: float) -> CoreStatus:
    """The core's part of a `StatusReply`."""
    workers = tuple(_worker(core, worker, now) for worker in core.fleet.workers.values())
    runs = tuple(_run(core, run) for run in core.runs.values())
    audits: dict[str, int] = {}
    for row in [row for run in core.runs.values() for row in run.audits.values()]:
        audits[row.state] = audits.get(row.state, 0) + 1
    return CoreStatus(
        episodes_done=core.rate.total,
        episodes_per_s=core.rate.per_s(now),
        workers=workers,
        runs=runs,
        stalls=_stalls(core, now),
        audit_share=core.settings.audit_share,
        audits=audits,
        disputes=(*core.disputes, *audit.undecided(core)),
        quarantined=dict(core.fleet.quarantined),
    )


def _worker(core: Core, worker: Worker, now: float) -> WorkerStatus:
    profile = worker.profile
    live = [lease for lease in worker.leases.values() if lease.live]
    return WorkerStatus(
        worker=worker.name,
        host=worker.host,
        slots=worker.slots,
        state=worker.state,
        tiers=tuple(sorted(profile.key[1])),
        environments=tuple(sorted(profile.descriptions)),
        fingerprint=profile.fingerprint_class,
        versions={**_versions(profile.fingerprint), "cpu": profile.fingerprint.cpu},
        held=len(live),
        running=sum(lease.running for lease in live),
        last_seen_s=max(0.0, now - worker.last_seen),
        refused=refused_runs(core, worker),
        boot_id=worker.kernel.boot_id,
        hidden_bar=core.isolation.bar_of_worker(worker),
    )


def refused_runs(core: Core, worker: Worker) -> dict[str, str]:
    """Runs of its environments that a worker gets no work of, and why."""
    profile = worker.profile
    refused = {
        run.id: _mismatch(run, profile)
        for run in core.runs.values()
        if run.flow.env in profile.descriptions and run.flow.pin not in (None, profile.fingerprint_class)
    }
    return refused | {
        run.id: f"the run demands sandbox tier {run.flow.tier}; the worker has {', '.join(sorted(profile.key[1]))}"
        for run in core.runs.values()
        if run.flow.env in profile.descriptions and run.flow.tier not in profile.key[1]
    }


def _mismatch(run: Run, profile: Profile) -> str:
    text = (
        f"the run is pinned to fingerprint class {run.flow.pin}, the worker is of class"
        f" {profile.fingerprint_class}"
    )
    began, here = run.state.fingerprint, profile.fingerprint
    if began is None:
        return text
    theirs, ours = _versions(began), _versions(here)
    differing = [
        f"{name} {theirs.get(name, 'none')} there, {ours.get(name, 'none')} here"
        for name in sorted(theirs.keys() | ours.keys())
        if theirs.get(name) != ours.get(name)
    ]
    return f"{text} ({'; '.join(differing)})" if differing else text


def _versions(fingerprint: Fingerprint) -> dict[str, str]:
    own = {"evopolicy-worker": fingerprint.code_version, "python": fingerprint.python}
    return {**own, **fingerprint.packages}


def _run(core: Core, run: Run) -> RunStatus:
    groups = [group for group in core.groups.values() if group.run == run.id and group.kind != "audit"]
    waiting = [text for group in groups if (text := waits_for(core, group))]
    return RunStatus(
        run=run.id,
        entry=run.row.settings.entry,
        env=run.row.settings.env,
        phase=progress(core, run).phase,
        budget=run.row.budget,
        remaining_budget=run.ledger.available,
        n_submits=len(run.submits),
        queued=sum(run.flow.n_ready[:AUDIT]),
        running=run.flow.n_leased,
        done=run.ledger.settled + sum(group.done for group in groups),
        waits_for=waiting[0] if waiting else progress(core, run).waits_for,
        agent_host=core.isolation.agents(run.id),
    )


def _stalls(core: Core, now: float) -> tuple[str, ...]:
    """What waits longer than `stall_s`, oldest group first."""
    stalls: list[str] = []
    limit_s = core.settings.stall_s
    for group in core.groups.values():
        if group.kind == "audit":  # which wait as long as there is anything else to do
            continue
        waiting = [job for job in group.jobs.values() if job.lease is None and now - job.since > limit_s]
        if waiting:
            oldest = min(waiting, key=lambda job: job.since)
            what = waits_for(core, group) or _behind(group.flow.lane)
            again = (
                f", after {oldest.failures} faults, the last: {oldest.last_failure}"
                if oldest.failures
                else ""
            )
            stalls.append(
                f"{len(waiting)} jobs of {group.id} wait for {what}; {oldest.job_id} for {now - oldest.since:.0f} s{again}"
            )
        for job in group.jobs.values():
            lease = job.lease
            if lease is not None and lease.running and now - lease.progress_at > limit_s:
                stalls.append(
                    f"{job.job_id} makes no progress on {lease.worker} for {now - lease.progress_at:.0f} s "
                    f"at step {lease.steps}"
                )
    return tuple(stalls)


def _behind(lane: Lane | None) -> str:
    slots = 0 if lane is None else lane.slots()
    return f"a free slot among {slots}"
