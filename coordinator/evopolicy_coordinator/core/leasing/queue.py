"""Waiting jobs: in lanes by required capabilities, by priority, and by fair share between runs.

Rules that this module owns:
- A lane is (environment, sandbox tier, fingerprint class); a flow (a run, or an evaluation) is in one lane, or in none
  until it is pinned to a class.
- Priorities of an earlier rank (`RANKS`) go first, whatever the shares are.
- Between flows of one rank the one with the least play time goes first (start-time fair queueing: each rank has a
  virtual clock, which each lease moves on by its part of a flow's share; an idle flow starts at the clock, so that
  idleness earns nothing, and new flows without end keep no other waiting). A worker that has the environment or
  the bundle warm may deviate from this by a bounded amount.
- Within a flow jobs go in order; jobs that return after a failure go to the front.
- A job is not leased to a worker that it avoids while its lane has another one.
- No operation visits all jobs, all flows or all workers: flows are in heaps, removed entries are void by generation.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection

from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.tables.model import (
    HIDDEN_FIRST,
    N_PRIORITIES,
    RANKS,
    Flow,
    JobState,
    Lane,
    Profile,
    Worker,
)
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep

RECHECK_S = 1.0
"""A lane is checked again after this time when jobs wait although workers wait too (they avoid each other)."""

SKIPS_MAX = 16
"""Most jobs of a flow that are skipped because they avoid the polling worker; after that the flow is passed over."""

PASSES_MAX = 4
"""Most flows that are passed over because all their jobs were skipped."""

BARRED_MAX = 64
"""Most flows, or case sets of a lane, that are passed over because they conflict with the polling worker's kernel."""


_RANK = tuple(next(n for n, rank in enumerate(RANKS) if each in rank) for each in range(N_PRIORITIES))


# ---- lanes and profiles ----


def add_profile(state: State, profile: Profile) -> None:
    """Let workers of a new profile serve the lanes that they can."""
    state.profiles[profile.key] = profile
    for lane in state.lanes.values():
        _join(profile, lane)


def drop_profile(state: State, profile: Profile) -> None:
    """Forget a profile without workers."""
    del state.profiles[profile.key]
    for lane in profile.lanes.values():
        del lane.profiles[profile]


def place(state: State, flow: Flow, pin: str) -> Lane:
    """Move a flow with its waiting jobs into the lane of class `pin`."""
    old = flow.lane
    suspects = [job.priority for job in state.suspects if job.group.flow is flow]
    if old is not None:
        for priority in range(N_PRIORITIES):
            old.n_ready[priority] -= flow.n_ready[priority]
            old.count(priority, flow, -flow.n_ready[priority] - suspects.count(priority))
        _settle(old)
        old.n_flows -= 1
    key = (flow.env, flow.tier, pin)
    lane = state.lanes.get(key)
    if lane is None:
        lane = state.lanes[key] = Lane(key)
        for profile in state.profiles.values():
            _join(profile, lane)
    flow.pin, flow.lane = pin, lane
    lane.n_flows += 1
    if flow.case_set is not None:
        flow.case_set.lanes[lane] = None
    for priority in range(N_PRIORITIES):
        flow.in_heap[priority] = False
        lane.count(priority, flow, flow.n_ready[priority] + suspects.count(priority))
        if flow.n_ready[priority]:
            lane.n_ready[priority] += flow.n_ready[priority]
            _enter(flow, lane, priority)
    _settle(lane)
    return lane


def _join(profile: Profile, lane: Lane) -> None:
    if profile.serves(lane.key):
        profile.lanes[lane.key] = lane
        lane.profiles[profile] = None
        if any(lane.n_ready):
            profile.busy[lane] = None


def _enter(flow: Flow, lane: Lane, priority: int) -> None:
    if not flow.in_heap[priority]:
        flow.in_heap[priority] = True
        heapq.heappush(lane.heaps[priority], (flow.served[priority], flow.seq, flow))


def _settle(lane: Lane) -> None:
    """Update in the lane's profiles whether it has waiting jobs."""
    for profile in lane.profiles:
        if any(lane.n_ready):
            profile.busy[lane] = None
        else:
            profile.busy.pop(lane, None)


# ---- jobs ----


def put(state: State, job: JobState, step: CoreStep, *, front: bool = False) -> None:
    """Queue a job, and mark its lane for the scheduler."""
    flow, priority, lane = job.group.flow, job.priority, job.group.flow.lane
    job.move("queued")
    job.generation += 1
    if lane is not None:
        lane.count(priority, flow, 1)
        step.dirty[lane] = None
    if job.alone:
        state.suspects[job] = None
        return
    ready = flow.ready[priority]
    (ready.appendleft if front else ready.append)((job.generation, job))
    if flow.n_ready[priority] == 0:
        # An idle flow starts at the clock, so that idleness earns nothing.
        flow.served[priority] = max(flow.served[priority], state.clock[_RANK[priority]])
    flow.n_ready[priority] += 1
    if lane is not None:
        lane.n_ready[priority] += 1
        _enter(flow, lane, priority)
        if lane.n_ready[priority] == 1:
            _settle(lane)


def withdraw(state: State, job: JobState) -> None:
    """Remove a waiting job from the queue; the caller leases, closes or queues it at once."""
    if job.place != "queued":
        return
    flow, priority = job.group.flow, job.priority
    job.generation += 1
    if flow.lane is not None:
        flow.lane.count(priority, flow, -1)
    if job.alone:
        state.suspects.pop(job, None)
        return
    flow.n_ready[priority] -= 1
    if flow.n_ready[priority] == 0:
        flow.ready[priority].clear()
    lane = flow.lane
    if lane is not None:
        lane.n_ready[priority] -= 1
        if lane.n_ready[priority] == 0:
            _settle(lane)


def take_job(state: State, worker: Worker, warm: Collection[str], now: float) -> JobState | None:
    """Remove and return the next job for `worker`; None when no waiting job is for it."""
    for rank in _ranks(worker):
        passed: list[tuple[Flow, int]] = []
        barred = 0
        job: JobState | None = None
        while job is None and len(passed) - barred < PASSES_MAX and barred < BARRED_MAX:
            best = _best(state, worker, rank, warm)
            if best is None or best[0].lane is None:
                break
            flow, priority = best
            lane = best[0].lane
            if conflicts.conflict(state, priority, flow.case_set, worker):
                barred += 1
            else:
                job = _first(flow, priority, worker, now, sole=lane.workers() <= 1)
            if job is None:
                heapq.heappop(lane.heaps[priority])
                flow.in_heap[priority] = False
                passed.append(best)
        for flow, priority in passed:
            if flow.lane is not None:
                _enter(flow, flow.lane, priority)
        if job is not None:
            _serve(state, job)
            return job
    return None


def leading(state: State, worker: Worker) -> tuple[Flow, int] | None:
    """The flow that goes first among those that the worker may be leased, and its priority; None when none waits."""
    for rank in _ranks(worker):
        best = _best(state, worker, rank, ())
        if best is not None:
            return best
    return None


def may_serve(state: State, lane: Lane, worker: Worker) -> bool:
    """Whether any job that waits in the lane may be leased on the worker's kernel."""
    return any(
        lane.n_ready[priority] and open_to(state, lane, priority, worker) for priority in range(N_PRIORITIES)
    )


def open_to(state: State, lane: Lane, priority: int, worker: Worker) -> bool:
    """Whether jobs of some case set that waits in the lane may be leased on the worker's kernel."""
    there = lane.waiting[priority]
    if not there:
        return False
    if len(there) > BARRED_MAX or not conflicts.concerns(state, priority, worker):
        return True
    return any(not conflicts.conflict(state, priority, case_set, worker) for case_set in there)


def _serve(state: State, job: JobState) -> None:
    flow, priority = job.group.flow, job.priority
    withdraw(state, job)
    clock, cost_s = max(state.clock[_RANK[priority]], flow.served[priority]), flow.cost_s(job)
    state.clock[_RANK[priority]] = clock + cost_s / (len(state.runs) + len(state.evaluations))
    flow.served[priority] += cost_s


def _best(
    state: State, worker: Worker, rank: tuple[int, ...], warm: Collection[str]
) -> tuple[Flow, int] | None:
    if not worker.profile.busy:
        return None
    best: tuple[Flow, int] | None = None
    best_score = 0.0
    concerned = [priority for priority in rank if conflicts.concerns(state, priority, worker)]
    for lane in worker.profile.busy:
        for priority in rank:
            if not lane.n_ready[priority] or not (heap := lane.heaps[priority]):
                continue
            if priority in concerned and not open_to(state, lane, priority, worker):
                continue
            score, _, flow = heap[0]
            if flow.lane is not lane or not flow.n_ready[priority] or score != flow.served[priority]:
                first = lane.top(priority)
                if first is None:
                    continue
                flow, score = first, first.served[priority]
            if warm and (flow.env in warm or (_next(flow, priority).group.template.bundle or "") in warm):
                score -= state.settings.warm_bonus_s
            if best is None or score < best_score or (score == best_score and flow.seq < best[0].seq):
                best, best_score = (flow, priority), score
    return best


def _first(flow: Flow, priority: int, worker: Worker, now: float, *, sole: bool) -> JobState | None:
    """The flow's first job that may go to `worker` and does not avoid it; drops void entries on the way."""
    ready = flow.ready[priority]
    skipped: list[tuple[int, JobState]] = []
    best: JobState | None = None
    while ready and len(skipped) < SKIPS_MAX:
        generation, job = ready[0]
        if job.generation != generation:
            ready.popleft()
        elif job.avoid == worker.name and now < job.avoid_until and not sole:
            skipped.append(ready.popleft())
        else:
            best = job
            break
    ready.extendleft(reversed(skipped))
    return best


def next_bundle(lane: Lane) -> tuple[str | None, str] | None:
    """Bundle and environment of the lane's next job; None when none waits."""
    for priority in range(N_PRIORITIES):
        flow = lane.top(priority) if lane.n_ready[priority] else None
        if flow is not None:
            template = _next(flow, priority).group.template
            return template.bundle, template.env
    return None


def _ranks(worker: Worker) -> tuple[tuple[int, ...], ...]:
    return HIDDEN_FIRST if worker.kernel.reservations else RANKS


def _next(flow: Flow, priority: int) -> JobState:
    """The first of a flow's ready jobs, which must exist. Drops void entries ahead of it."""
    ready = flow.ready[priority]
    while ready[0][1].generation != ready[0][0]:
        ready.popleft()
    return ready[0][1]


# ---- jobs that return ----


def backed_off(state: State, job_id: str, step: CoreStep) -> None:
    """A job's back-off after an infrastructure failure is over."""
    job = state.jobs.get(job_id)
    if job is not None and job.place == "backing_off":
        put(state, job, step, front=True)


def give_up_adopting(state: State, _what: str, step: CoreStep) -> None:
    """No heartbeat has claimed these jobs since the core was loaded: play them again."""
    for job in list(state.adopting):
        del state.adopting[job]
        put(state, job, step)
