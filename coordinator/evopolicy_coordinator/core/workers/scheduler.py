"""Matches waiting jobs with waiting workers.

Rules that this module owns:
- Work is pulled: a worker's poll states how many leases it can take and waits until there are some. Free slots are
  filled first. In advance a worker gets only short episodes, worth about `batch_s` per slot, even more of them than it
  requested, but never so many that another idle worker gets none.
- A poll that has timed out gets no lease: while the loop was blocked, its worker has given it up and would never see
  the reply.
- New work goes first to a waiting worker that has its bundle warm, then to one with its environment warm, then to the
  longest waiting.
- At the end of each step `dispatch` leases the work that the step made available; apart from it only a poll and the
  end of a bench time call the scheduler.
- A suspect, a job that may crash workers, runs alone, on an idle worker or on one that is emptied for it; that worker
  gets no other job in the meantime.
"""

from __future__ import annotations

import math
from itertools import islice

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.agents import permits, precedence
from evopolicy_coordinator.core.contract.events import Requested
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.leasing import fleet, leases, queue
from evopolicy_coordinator.core.tables.model import JobState, Lane, LeasePoll, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep

PREFETCH_BELOW_S = 1.0
"""Longer episodes are leased to free slots only: the time to fetch them is negligible beside their play time."""

TRIES_MAX = 4
"""Most parked workers tried for a lane in one step; the rest waits for the next step."""

SKIPPED_MAX = 64
"""Most parked workers on kernels barred to a lane that are skipped in one step."""

SUSPECTS_MAX = 16
"""Most suspects checked in one step."""

LEASES_MAX = 256
"""Most leases in one reply: it must fit into a message."""

EPISODES_MAX = 2048
"""Most episodes leased at once, but always at least one job."""

HELD_MAX = 16_384
"""Most leases that a worker may hold: its heartbeats name them all."""


def poll(state: State, worker: Worker, event: Requested[wire.LeaseRequest], step: CoreStep) -> None:
    """A worker polls for leases; an older poll of it is answered with none."""
    message = event.message
    fleet.drop_poll(state, worker, step)
    worker.polled_at = step.now
    if message.n < 1 or event.waited_s > message.wait_s + state.settings.late_s:
        step.reply(event.request, wire.Leases(leases=()))
        return
    wait_s = min(max(message.wait_s - event.waited_s, 0.0), state.settings.max_wait_s)
    warm = frozenset(message.warm_bundles) | frozenset(message.warm_environments)
    n = max(1, min(message.n, 2 * worker.slots))
    worker.poll = LeasePoll(event.request, n, warm, until=step.now + wait_s, serial=message.serial)
    if worker.first_serial is None:
        worker.first_serial = message.serial
    if not _serve(state, worker, step):
        state.timers.arm(("lease", worker.name), step.now + wait_s)
        _park(state, worker, step)


def _park(state: State, worker: Worker, step: CoreStep) -> None:
    """Park a worker's poll for new work, if it has a free slot. Otherwise its next free slot
    brings the poll up again."""
    if worker.n_live >= worker.slots or worker.reserved is not None:
        return
    if not fleet.available(worker, step.now):
        return
    fleet.park(worker)
    for lane in worker.profile.busy:
        state.timers.arm_once(("lane", lane.key), step.now + queue.RECHECK_S)


def _serve(state: State, worker: Worker, step: CoreStep) -> bool:
    """Answer a worker's poll if there are leases for it; returns whether it was answered."""
    granted = _fill(state, worker, step)
    if granted:
        fleet.answer_poll(state, worker, tuple(granted), step)
    return bool(granted)


def _fill(state: State, worker: Worker, step: CoreStep) -> list[wire.Lease]:
    poll = worker.poll
    if poll is None or not fleet.available(worker, step.now):
        return []
    if step.now > poll.until + state.settings.late_s:
        return []
    if state.suspects and (suspect := _next_suspect(state, worker, step)) is not None:
        return [suspect]
    if worker.reserved is not None:
        return []
    free = worker.slots - worker.n_live
    given: list[wire.Lease] = []
    limit = min(_limit(state, worker, poll.n, free), LEASES_MAX, HELD_MAX - len(worker.leases))
    n_episodes = 0
    while len(given) < limit and n_episodes < EPISODES_MAX:
        job = queue.take_job(state, worker, poll.warm, step.now)
        if job is None:
            break
        given.append(leases.grant(state, job, worker, step))
        n_episodes += job.n
    return given


def _limit(state: State, worker: Worker, n: int, free: int) -> int:
    """Returns how many leases a poll for `n` gets at most; `free` of the worker's slots are idle.

    Leases beyond the free slots are of short episodes only, only while the worker holds no lease of lower priority, and
    no more than the worker's share of the waiting jobs.
    """
    settings, leader = state.settings, queue.leading(state, worker)
    if leader is None or leader[0].lane is None:
        return 0
    at_least = min(n, max(0, free))
    flow, priority = leader
    assert flow.lane is not None
    episode_s = flow.episode_s
    behind_hidden = any(worker.held[priority + 1 :])
    if episode_s is None or episode_s >= PREFETCH_BELOW_S or behind_hidden:
        return at_least
    ahead = min(settings.batch_max, 1 + int(settings.batch_s / max(episode_s, 1e-4)))
    share = math.ceil(sum(flow.lane.n_ready) * worker.slots / max(1, flow.lane.slots()))
    return max(at_least, min(worker.slots * ahead - worker.n_live, share))


# ---- the end of a step ----


def dispatch(state: State, step: CoreStep) -> None:
    """Lease the work that this step made available."""
    if state.grantable:
        permits.settle(state, step)
    while state.freed:
        name = next(iter(state.freed))
        del state.freed[name]
        worker = state.workers.get(name)
        if worker is not None and worker.poll is not None and name not in worker.profile.parked:
            reconsider(state, worker, step)
    if state.suspects:
        _place_suspects(state, step)
    fed = list(step.dirty)
    step.dirty.clear()
    for lane in fed:
        _feed(state, lane, step)
    for lane in fed:
        precedence.watch(state, lane, step)
    for name, stops in step.stops.items():
        _tell_stops(state, name, tuple(stops), step)


def _place_suspects(state: State, step: CoreStep) -> None:
    """Offer waiting suspects to idle workers."""
    for job in list(islice(state.suspects, SUSPECTS_MAX)):
        lane = job.group.flow.lane
        if lane is not None and job.queued:
            for profile in lane.profiles:
                for name in list(islice(profile.parked, TRIES_MAX)):
                    worker = state.workers[name]
                    if not _serve(state, worker, step):
                        _to_the_back(state, worker, step)


def _tell_stops(state: State, name: str, stops: tuple[str, ...], step: CoreStep) -> None:
    """Notify a worker of leases to stop if a heartbeat or poll of it waits; otherwise its next heartbeat does so."""
    worker = state.workers.get(name)
    if worker is None:
        return
    if worker.beat is not None:
        fleet.answer_beat(state, worker, stops, step)
    elif worker.poll is not None:
        fleet.answer_poll(state, worker, (), step, stops)


def reconsider(state: State, worker: Worker, step: CoreStep) -> None:
    """Serve a waiting poll of a worker that may have become available."""
    if worker.poll is None or not fleet.available(worker, step.now):
        return
    if not _serve(state, worker, step):
        _park(state, worker, step)


def bench_ended(state: State, name: str, step: CoreStep) -> None:
    """A worker's bench time is over."""
    worker = state.workers.get(name)
    if worker is not None:
        reconsider(state, worker, step)


def _feed(state: State, lane: Lane, step: CoreStep) -> None:
    """Answer parked polls while the lane has jobs for them."""
    tries = 0
    while any(lane.n_ready) and tries < TRIES_MAX:
        worker = _parked(state, lane)
        if worker is None:
            return
        if _serve(state, worker, step):
            tries = 0
        else:
            tries += 1
            _to_the_back(state, worker, step)
    if any(lane.n_ready):
        state.timers.arm_once(("lane", lane.key), step.now + queue.RECHECK_S)


def _to_the_back(state: State, worker: Worker, step: CoreStep) -> None:
    fleet.unpark(worker)
    _park(state, worker, step)


def _parked(state: State, lane: Lane) -> Worker | None:
    """The waiting worker that should get the lane's next job; None for none."""
    following = queue.next_bundle(lane)
    if following is None:
        return None
    workers = state.workers
    for item in following:
        for profile in lane.profiles if item is not None else ():
            for name in islice(profile.warm.get(item or "", ()), SKIPPED_MAX):
                if queue.may_serve(state, lane, workers[name]):
                    return workers[name]
    for profile in lane.profiles:
        for name in islice(profile.parked, SKIPPED_MAX):
            if queue.may_serve(state, lane, workers[name]):
                return workers[name]
    return None


def _next_suspect(state: State, worker: Worker, step: CoreStep) -> wire.Lease | None:
    """Lease a suspect to an idle worker; a busy worker may be reserved for one instead (returns None)."""
    idle = not worker.leases
    if worker.reserved is not None:
        job = worker.reserved
        if not job.queued or _barred(state, job, worker):
            worker.reserved = job.reserved = None
        elif not idle:
            return None
        else:
            return _alone(state, job, worker, step)
    for job in list(islice(state.suspects, SUSPECTS_MAX)):
        lane = job.group.flow.lane
        if lane is None or worker.profile not in lane.profiles:
            continue
        if job.reserved is not None and not idle:
            continue
        if job.avoid == worker.name and step.now < job.avoid_until and lane.workers() > 1:
            continue
        if _barred(state, job, worker):
            continue
        if idle:
            return _alone(state, job, worker, step)
        job.reserved, worker.reserved = worker.name, job
        return None
    return None


def _barred(state: State, job: JobState, worker: Worker) -> bool:
    return conflicts.conflict(state, job.priority, job.group.flow.case_set, worker)


def _alone(state: State, job: JobState, worker: Worker, step: CoreStep) -> wire.Lease:
    fleet.unreserve(state, job)
    queue.withdraw(state, job)
    return leases.grant(state, job, worker, step)
