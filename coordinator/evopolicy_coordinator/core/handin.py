"""Results that workers hand in: committed once, whatever is sent twice, late, or by whom it should not be.

Rules that this module owns:
- A job's outcome is committed from any attempt while the job is open; the first to arrive wins. A verdict about a limit
  counts only from the attempt that is live, whose worker was never silent for long, and during which this process never
  stood still: else a frozen worker would blame the policy for it. Such an attempt is played again.
- A later outcome of the same episode is only compared; a difference is reported as nondeterminism.
- An attempt that another worker was given, or that was never given, is ignored and logged, also after a restart: a lease's
  name proves its grant. So is one of a worker that the job's group bars.
- An outcome that is not what was asked for (wrong episodes, a return that is not finite) is the worker's failure.
- What a policy can do to its slot is an outcome, and what it cannot is played again without a limit: `failed`, or `slot_died` in
  the words of workers of earlier versions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from evopolicy_common.messages.episode import TIME_LIMITS, EpisodeOutcome
from evopolicy_common.messages.worker import JobResult

from . import audit
from .jobs import JobState, mark_of
from .leases import Lease
from .records import OutcomeRow
from .retry import Mishap
from .turn import Turn
from .workers import Worker

if TYPE_CHECKING:
    from .machine import Core


def take(core: Core, worker: Worker, result: JobResult, turn: Turn) -> None:
    """Take in one result of a hand-in."""
    job = core.jobs.get(result.job_id)
    lease = worker.leases.get(result.lease_id)
    granted = core.book.granted(result.lease_id, result.job_id, result.attempt, worker)
    if job is None or not granted:
        _closed(core, worker, lease, result, turn, granted=granted)
        return
    if job.group.bars(worker):
        turn.log("warning", "result_of_foreign_lease", worker=worker.name, lease=result.lease_id)
        return
    live = lease is not None and lease.live and job.lease is lease
    silent = lease is None or _silent(core, lease, turn.now)
    if lease is not None:
        core.book.release(worker, lease, turn, f"handed in: {result.kind}", sure=True)
    if result.kind == "done":
        _done(core, worker, job, result, turn, live=live, silent=silent)
    elif live:
        if result.kind != "returned":
            core.fleet.failed(worker, turn)
        mishap: Mishap = "returned" if result.kind == "returned" else "failed"
        core.book.give_back(job, mishap, worker, turn, ran=True, error=result.error)


def _closed(
    core: Core, worker: Worker, lease: Lease | None, result: JobResult, turn: Turn, *, granted: bool
) -> None:
    """A result of a job that is done or was cancelled, or of a lease that this worker was not given."""
    if lease is not None:
        live = lease.live
        core.book.release(worker, lease, turn, f"handed in late: {result.kind}", sure=True)
        if live:
            error = f"its result is said to be of {result.job_id[:80]!r}, attempt {result.attempt}"
            core.fleet.failed(worker, turn)
            core.book.give_back(lease.job, "failed", worker, turn, ran=True, error=error)
    group = core.groups.get(result.job_id.rpartition("/")[0])
    if group is None:
        return
    if not granted:
        turn.log("warning", "result_of_foreign_lease", worker=worker.name, lease=result.lease_id[:200])
        return
    if result.kind != "done":
        return
    for outcome in result.episodes:
        mark = group.marks.get(outcome.index)
        if mark is not None and mark != mark_of(outcome) and not _limit_verdict(outcome):
            turn.log(
                "warning",
                "nondeterministic_result",
                job=result.job_id,
                worker=worker.name,
                episode=outcome.index,
                first=tuple(mark),
                later=tuple(mark_of(outcome)),
            )
            core.nondeterministic(group, turn)


def _silent(core: Core, lease: Lease, now: float) -> bool:
    """Whether the holder of a lease may have stood still during it."""
    if lease.job.failures >= core.settings.doubts_max:
        return False
    unheard_s = now - lease.renewed
    return lease.doubtful or lease.granted_at < core.stalled_at or unheard_s > core.settings.silence_s


def _limit_verdict(outcome: EpisodeOutcome) -> bool:
    failure = outcome.failure
    return failure is not None and (failure.category in TIME_LIMITS or failure.limit is not None)


def _fault(job: JobState, episodes: tuple[EpisodeOutcome, ...]) -> str | None:
    """Why the outcomes cannot be those of the job; None when they can."""
    indexes = [outcome.index for outcome in episodes]
    if indexes != list(range(job.first, job.first + job.n)):
        return f"outcomes of episodes {indexes[:8]} for a job of {job.first} to {job.first + job.n - 1}"
    for outcome in episodes:
        numbers = [
            outcome.episode_return,
            outcome.wall_s,
            outcome.policy_cpu_s,
            *outcome.reward_components.values(),
        ]
        if outcome.failure is not None:
            numbers += [outcome.failure.limit or 0.0, outcome.failure.used or 0.0]
        if not all(math.isfinite(number) for number in numbers):
            return f"episode {outcome.index} has a number that is not finite: {numbers}"
        if outcome.length < 0:
            return f"episode {outcome.index} has length {outcome.length}"
    return None


def _done(
    core: Core, worker: Worker, job: JobState, result: JobResult, turn: Turn, *, live: bool, silent: bool
) -> None:
    fault = _fault(job, result.episodes)
    if fault is not None:
        turn.log("error", "result_refused", job=job.job_id, worker=worker.name, fault=fault)
        if live:
            core.fleet.failed(worker, turn)
            core.book.give_back(job, "failed", worker, turn, ran=True, error=fault)
        return
    if (silent or not live) and any(_limit_verdict(outcome) for outcome in result.episodes):
        core.chronicle.tell(turn.now, turn.stimulus_id, result.lease_id, "late limit verdict, not counted")
        if live:
            core.book.give_back(
                job, "unlisted", worker, turn, ran=True, error="limit verdict after a silence"
            )
        return
    worker.failures = 0
    commit(core, worker, job, result, turn)


def commit(core: Core, worker: Worker, job: JobState, result: JobResult, turn: Turn) -> None:
    """Make the outcomes durable and the job done."""
    group = job.group
    core.close_job(job, turn, "done by another attempt")
    for outcome in result.episodes:
        row = OutcomeRow(
            group=group.id,
            index=outcome.index,
            seq=group.done,
            outcome=outcome,
            job_id=job.job_id,
            attempt=result.attempt,
            worker=worker.name,
            fingerprint_class=worker.profile.fingerprint_class,
            at=turn.now,
        )
        group.marks[outcome.index] = mark_of(outcome)
        turn.persist(row)
        if group.kind != "audit":
            group.flow.observe(outcome.wall_s)
    core.chronicle.tell(
        turn.now, turn.stimulus_id, job.job_id, f"committed attempt {result.attempt} of {worker.name}"
    )
    if group.kind == "audit":
        audit.replayed(core, worker, group, turn)
        return
    core.count_done(len(result.episodes), turn.now)
    audit.sample(core, worker, group, result.episodes, turn)
    core.concluded(group, result.episodes, turn)
