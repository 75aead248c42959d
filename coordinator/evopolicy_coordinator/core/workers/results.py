"""Results that workers report: committed once, even if they are sent twice, late, or by the wrong worker.

Rules that this module owns:
- A job's outcome is committed from any attempt while the job is open; the first to arrive wins. A limit verdict counts
  only from the live attempt, and only if its worker was never silent for long and this process was never blocked
  during it; otherwise a frozen worker would blame the policy.
  An attempt whose verdict does not count is played again.
- A later outcome of the same episode is only compared; a difference is reported as nondeterminism.
- The actions that the policy of a given-back attempt had returned stand: no later attempt gives the policy a second
  try. If a worker that was silent for long reports that a limit ended the attempt, its actions do not stand.
- An attempt that was granted to another worker, or never granted, is ignored and logged, also after a restart: a
  lease's name proves its grant.
- An outcome that does not fit the job (wrong episodes, a number that is not finite, or beyond 1e100) or a page for its
  gateway is the worker's failure.
- The time that an episode took counts for the fair share only up to the time for which its worker had the lease.
- A failure that a policy can cause in its slot is an outcome. A failure that it cannot cause is retried without limit.
  An environment that keeps ending a job is given up (`jobs.in_vain`).
"""

from __future__ import annotations

from evopolicy_common.messages.bounds import LARGEST
from evopolicy_common.messages.episode import TIME_LIMITS, EpisodeOutcome
from evopolicy_common.messages.worker import JobResult
from evopolicy_coordinator.core.contract.records import BegunRow, OutcomeRow
from evopolicy_coordinator.core.leasing import fleet, groups, jobs, leases
from evopolicy_coordinator.core.leasing.jobs import JobFailure
from evopolicy_coordinator.core.tables.model import JobState, OpenLease, Worker, outcome_digest
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import (
    CoreStep,
    EnvironmentFailed,
    EpisodesDone,
    ResultReported,
    ResultsDiffered,
)

MAX_OUTCOME_BYTES = 2 << 20
"""Largest sum of an outcome's texts, names and bytes. A worker uploads larger recordings as blobs. A page has at least
one episode, whatever its size, so a run with a larger outcome could never tell its gateway."""
MAX_LENGTH = 2**31 - 1


def take_result(state: State, news: ResultReported, step: CoreStep) -> None:
    worker, result = news.worker, news.result
    job = state.jobs.get(result.job_id)
    lease = worker.leases.get(result.lease_id)
    granted = leases.granted(state, result.lease_id, result.job_id, result.attempt, worker)
    if job is None or not granted:
        _closed(state, worker, lease, result, step, granted=granted)
        return
    live = lease is not None and lease.live and job.lease is lease
    silent = lease is None or _silent(state, lease, step.now)
    leased_s = None if lease is None else step.now - lease.granted_at
    if result.kind != "done":
        _keep_begun(job, lease, result, step, silent=silent)
    if lease is not None:
        leases.release(state, worker, lease, step, sure=True)
    if result.kind == "done":
        silent = silent or not live
        _done(state, worker, job, result, step, live=live, silent=silent, leased_s=leased_s)
    elif live:
        if result.kind != "returned" and not result.environment_fault:
            fleet.failed(state, worker, step)
        failure: JobFailure = "returned" if result.kind == "returned" else "failed"
        leases.give_back(state, job, failure, worker, step, ran=True, error=result.error)
        if result.environment_fault:
            _environment_fault(state, worker, job, result.error, step)


def _environment_fault(state: State, worker: Worker, job: JobState, error: str, step: CoreStep) -> None:
    """Count an attempt that the environment has ended; give the environment up after enough of them."""
    faults, lane = job.faults, job.group.flow.lane
    faults.n += 1
    faults.since = faults.since or step.now
    faults.on.add(worker.machine or worker.name)
    names = [name for profile in lane.profiles for name in profile.workers] if lane is not None else []
    able = map(state.workers.__getitem__, names)
    if jobs.in_vain(state.settings, faults, {each.machine or each.name for each in able}, step.now):
        step.tell(EnvironmentFailed(job.group, f"{error}; {faults.n} attempts at {job.job_id} ended so"))


def _keep_begun(
    job: JobState, lease: OpenLease | None, result: JobResult, step: CoreStep, *, silent: bool
) -> None:
    """Keep the actions of an unfinished attempt's policy for the next attempt, unless that plays already."""
    kept = result.begun is not None and not (silent and result.limit_verdict)
    if kept and job.lease in (None, lease) and result.attempt > job.begun_attempt:
        job.begun, job.begun_attempt = result.begun, result.attempt
        group = job.group.id
        step.persist(BegunRow(group=group, first=job.first, attempt=result.attempt, begun=result.begun))


def _closed(
    state: State,
    worker: Worker,
    lease: OpenLease | None,
    result: JobResult,
    step: CoreStep,
    *,
    granted: bool,
) -> None:
    """Process a result of a job that is done or was cancelled, or of a lease that this worker was not granted."""
    if lease is not None:
        live = lease.live
        leases.release(state, worker, lease, step, sure=True)
        if live:
            error = f"its result names {result.job_id[:80]!r}, attempt {result.attempt}"
            fleet.failed(state, worker, step)
            leases.give_back(state, lease.job, "failed", worker, step, ran=True, error=error)
    group = state.groups.get(result.job_id.rpartition("/")[0])
    if group is None:
        return
    if not granted:
        step.log("warning", "result_of_foreign_lease", worker=worker.name, lease=result.lease_id[:200])
        return
    if result.kind != "done":
        return
    for outcome in result.episodes:
        digest = group.digests.get(outcome.index)
        if digest is not None and digest != outcome_digest(outcome) and not _limit_verdict(outcome):
            step.log(
                "warning",
                "nondeterministic_result",
                job=result.job_id,
                worker=worker.name,
                episode=outcome.index,
                first=tuple(digest),
                later=tuple(outcome_digest(outcome)),
            )
            step.tell(ResultsDiffered(group))


def _silent(state: State, lease: OpenLease, now: float) -> bool:
    """Whether the holder of a lease may have been frozen during it."""
    if lease.job.failures >= state.settings.doubts_max:
        return False
    unheard_s = now - lease.renewed
    return lease.doubtful or lease.granted_at < state.stalled_at or unheard_s > state.settings.silence_s


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
        wrong = [number for number in numbers if not abs(number) <= LARGEST]
        if wrong:
            return (
                f"episode {outcome.index} has a number that is not finite or beyond {LARGEST:g}: {wrong[0]}"
            )
        if not 0 <= outcome.length <= MAX_LENGTH or outcome.wall_s < 0.0:
            return f"episode {outcome.index} has length {outcome.length} and took {outcome.wall_s} s"
        size = _size(outcome)
        if size > MAX_OUTCOME_BYTES:
            return f"episode {outcome.index} takes {size:,} bytes; {MAX_OUTCOME_BYTES:,} are the limit"
    return None


def _size(outcome: EpisodeOutcome) -> int:
    parts: list[str | bytes] = [outcome.stdout, outcome.stderr, *outcome.reward_components]
    parts += [ref.inline or b"" for ref in (outcome.trajectory, outcome.video) if ref is not None]
    if outcome.failure is not None:
        parts += [outcome.failure.message, outcome.failure.traceback]
    return sum(map(len, parts))


def _done(
    state: State,
    worker: Worker,
    job: JobState,
    result: JobResult,
    step: CoreStep,
    *,
    live: bool,
    silent: bool,
    leased_s: float | None,
) -> None:
    fault = _fault(job, result.episodes)
    if fault is not None:
        step.log("error", "result_refused", job=job.job_id, worker=worker.name, fault=fault)
        if live:
            fleet.failed(state, worker, step)
            leases.give_back(state, job, "failed", worker, step, ran=True, error=fault)
        return
    if silent and any(_limit_verdict(outcome) for outcome in result.episodes):
        if live:
            leases.give_back(
                state, job, "unlisted", worker, step, ran=True, error="limit verdict after a silence"
            )
        return
    worker.failures = 0
    _commit(state, worker, job, result, step, leased_s)


def _commit(
    state: State, worker: Worker, job: JobState, result: JobResult, step: CoreStep, leased_s: float | None
) -> None:
    """Make the outcomes durable, and close the job. `leased_s`: how long the worker has had it; None: unknown."""
    group = job.group
    groups.close_job(state, job, step)
    if job.begun is not None:
        step.persist(BegunRow(group=group.id, first=job.first, attempt=result.attempt, begun=None))
    for outcome in result.episodes:
        row = OutcomeRow(
            group=group.id,
            index=outcome.index,
            seq=group.done,
            outcome=outcome,
            job_id=job.job_id,
            attempt=result.attempt,
            worker=worker.name,
            fingerprint_class=worker.profile.classes[group.flow.env],
            at=step.now,
        )
        group.digests[outcome.index] = outcome_digest(outcome)
        if outcome.success is not None:
            group.solved[outcome.index] = outcome.success
        step.persist(row)
        if leased_s is not None:
            # The fair share counts in this time, so a worker must not be able to make it up.
            group.flow.observe(min(outcome.wall_s, max(leased_s, 1.0)))
    state.rate.count(len(result.episodes), step.now)
    step.tell(EpisodesDone(group, worker, result.episodes))
