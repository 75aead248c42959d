"""The operator's view: workers, runs, and jobs that wait longer than they should, with the reason.

It visits all state, so it serves status requests only, never events.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from evopolicy_common.messages.status import QueuedJobs, RunStatus, StatusReply, WorkerStatus
from evopolicy_coordinator.core.agents import permits
from evopolicy_coordinator.core.contract.reasons import Reason
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.leasing import pins
from evopolicy_coordinator.core.runs import finished
from evopolicy_coordinator.core.runs.waits import waits_for
from evopolicy_coordinator.core.tables.model import (
    PRIORITY_NAMES,
    RANKS,
    JobGroup,
    JobState,
    Profile,
    Run,
    Worker,
)
from evopolicy_coordinator.core.tables.state import State

Words = Callable[[Reason | None], str]
"""Puts a reason into words; returns an empty string for None."""


def status(state: State, now: float, words: Words) -> StatusReply:
    """Returns a reply with the core's fields; the shell adds its own. `words` puts a reason into words."""
    # Computed once per profile and once per run: thousands of workers have few profiles, and hundreds of runs
    # share the groups.
    profiles = {worker.profile: None for worker in state.workers.values()}
    status_of = {profile: _workers(state, profile, now) for profile in profiles}
    groups: dict[str, list[JobGroup]] = {}
    waits: dict[JobGroup, Reason] = {}
    for group in state.groups.values():
        groups.setdefault(group.run, []).append(group)
        if (reason := waits_for(state, group)) is not None:
            waits[group] = reason
    workers = tuple(status_of[worker.profile](worker) for worker in state.workers.values())
    runs = tuple(_run(state, run, groups.get(run.id, []), waits, words) for run in state.runs.values())
    return StatusReply(
        cluster="",
        version="",
        uptime_s=0.0,
        episodes_done=state.rate.total,
        episodes_per_s=state.rate.per_s(now),
        workers=workers,
        runs=runs,
        stalls=_stalls(state, now, words),
        queue=_queue(state, waits, words),
    )


def _queue(state: State, waits: dict[JobGroup, Reason], words: Words) -> tuple[QueuedJobs, ...]:
    grouped: dict[tuple[int, str], list[JobGroup]] = {}
    for group in state.groups.values():
        if group.jobs:
            grouped.setdefault((group.priority, group.flow.env), []).append(group)
    order = [priority for rank in RANKS for priority in rank]
    queue = []
    for priority, env in sorted(grouped, key=lambda key: (order.index(key[0]), key[1])):
        groups = grouped[priority, env]
        leased = sum(group.n_leased for group in groups)
        reasons = Counter(words(waits[group]) for group in groups if group in waits)
        queue.append(
            QueuedJobs(
                priority=PRIORITY_NAMES[priority],
                env=env,
                runs=len({group.run for group in groups}),
                waiting=sum(len(group.jobs) for group in groups) - leased,
                leased=leased,
                waits_for=dict(reasons),
            )
        )
    return tuple(queue)


def _workers(state: State, profile: Profile, now: float) -> Callable[[Worker], WorkerStatus]:
    """The status of each worker of a profile; what they share is computed once."""
    tiers, environments = tuple(sorted(profile.key[1])), tuple(sorted(profile.descriptions))
    fingerprint = profile.fingerprint.class_name(cpu=state.settings.fingerprint_cpu)
    versions = {**profile.fingerprint.versions(), "cpu": profile.fingerprint.cpu}
    refused = pins.refused_runs(state, profile)

    def status_of(worker: Worker) -> WorkerStatus:
        live = [lease for lease in worker.leases.values() if lease.live]
        return WorkerStatus(
            worker=worker.name,
            host=worker.host,
            slots=worker.slots,
            state=worker.state,
            tiers=tiers,
            environments=environments,
            fingerprint=fingerprint,
            versions=versions,
            held=len(live),
            running=sum(lease.running for lease in live),
            last_seen_s=max(0.0, now - worker.last_seen),
            refused=refused,
            boot_id=worker.kernel.boot_id,
            hidden_bar=conflicts.conflict_of_worker(state, worker),
            classes=profile.classes,
            playing=dict(Counter(lease.job.group.run for lease in live if lease.running)),
            installation=worker.installation,
            missing_tiers=worker.missing_tiers,
            failed_environments=worker.failed_environments,
        )

    return status_of


def _run(
    state: State, run: Run, groups: list[JobGroup], waits: dict[JobGroup, Reason], words: Words
) -> RunStatus:
    waiting = [waits[group] for group in groups if group in waits]
    progress, waits_at_end = finished.progress(state, run)
    row, settings = run.row, run.row.settings
    return RunStatus(
        run=row.run,
        entry=settings.entry,
        env=settings.env,
        exp_id=settings.exp_id,
        repeat=settings.repeat,
        budget=row.budget,
        created_at=row.created_at,
        phase=progress.phase,
        remaining_budget=run.ledger.available,
        n_submits=len(run.submits),
        queued=sum(run.flow.n_ready),
        running=run.flow.n_leased,
        done=run.ledger.settled + sum(group.done for group in groups),
        waits_for=words(waiting[0] if waiting else waits_at_end),
        agent_host=permits.agents(state, run.id),
        best_mean=max(
            (row.mean_return for row in run.submits if row.status == "ok" and row.mean_return is not None),
            default=None,
        ),
        retries=tuple(run.retries),
        origin=settings.replay_of or ("" if settings.start is None else settings.start.run),
    )


def _stalls(state: State, now: float, words: Words) -> tuple[str, ...]:
    """Lists jobs that have waited, or made no progress, for longer than `stall_s`: waiting ones by run and reason."""
    waits: dict[tuple[str, str], list[JobState]] = {}
    stalls: list[str] = []
    limit_s = state.settings.stall_s
    for group in state.groups.values():
        waiting = [job for job in group.jobs.values() if job.lease is None and now - job.since > limit_s]
        reason = waits_for(state, group) if waiting else None
        if waiting:
            what = words(reason) or f"a free slot among {group.flow.lane.slots() if group.flow.lane else 0}"
            waits.setdefault((group.run, what), []).extend(waiting)
        for job in group.jobs.values():
            lease = job.lease
            if lease is not None and lease.running and now - lease.progress_at > limit_s:
                stalls.append(
                    f"{job.job_id} makes no progress on {lease.worker} for {now - lease.progress_at:.0f} s "
                    f"at step {lease.steps}"
                )
    for (_, what), jobs in waits.items():
        oldest, groups = min(jobs, key=lambda job: job.since), {job.group.id for job in jobs}
        again = (
            f", after {oldest.failures} faults, the last: {oldest.last_failure}" if oldest.failures else ""
        )
        more = f" and {len(groups) - 1} more groups" if len(groups) > 1 else ""
        stalls.append(
            f"{len(jobs)} jobs of {oldest.group.id}{more} wait for {what};"
            f" {oldest.job_id} for {now - oldest.since:.0f} s{again}"
        )
    return tuple(stalls)
