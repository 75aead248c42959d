"""Invariants of a core's state, which hold between any two steps."""

from __future__ import annotations

from collections import Counter

from evopolicy_coordinator.core.contract.records import submit_group
from evopolicy_coordinator.core.isolation.conflicts import all_related, related
from evopolicy_coordinator.core.structures import InvariantError
from evopolicy_coordinator.core.tables.model import JOB, N_PRIORITIES, RUN, SUBMIT, JobState
from evopolicy_coordinator.core.tables.state import State


def check_invariants(state: State) -> None:
    """Raises InvariantError, which names the record concerned, at the first violation."""
    _jobs(state)
    _queue(state)
    _workers(state)
    _isolation(state)
    for run in state.runs.values():
        parts = (run.ledger.available, run.ledger.reserved, run.ledger.settled)
        want(run.id, sum(parts) == run.ledger.granted and min(parts) >= 0, "the budget is conserved")
        phase = run.state.phase
        want(run.id, RUN[phase], "only unfinished runs are open")
        unsettled = [row.submit_index for row in run.submits if SUBMIT[row.status or "open"]]
        is_open = [] if run.open is None else [run.open]
        want(run.id, unsettled == is_open, "only the open submit lacks a verdict")
        want(run.id, (run.open is not None) == (run.ledger.reserved > 0), "an open submit has a reservation")
        if run.open is not None:
            group_of = submit_group(run.id, run.open, "train")
            want(run.id, group_of in state.groups, "an open submit has its group")
        ended = [row for row in run.submits if row.status is not None and not row.refunded]
        settled = sum(len(row.env_instances) for row in ended)
        want(run.id, settled == run.ledger.settled, "the settled episodes are those of the ended submits")


def _isolation(state: State) -> None:
    """Hidden jobs are on other kernels than agents and train jobs of related runs; a case set's users are counted."""
    for kernel in state.kernels.values() if state.isolates else ():
        for occupancy in all_related(kernel.hidden, None):
            if occupancy.lease is None or not occupancy.lease.live:
                continue
            others = (kernel, state.everywhere)
            beside = [each for there in others for each in all_related(there.train, occupancy.case_set)]
            # The worker's own lingering train occupancies do not count: when its lease was adopted, its heartbeat named
            # every job that it plays.
            train = any(each.lease is not None or each.worker != occupancy.worker for each in beside)
            apart = not train and not any(related(there.permits, occupancy.case_set) for there in others)
            want(occupancy.id, apart, "a hidden job shares no kernel with related agents and train jobs")
            want(occupancy.id, kernel is not state.everywhere, "a hidden job's kernel is known")
    for worker in state.workers.values():
        for lease in worker.leases.values():
            group = lease.job.group
            there = (lease.occupancy is not None) == (group.hidden or group.kind == "train")
            want(lease.id, there, "hidden and train leases have occupancies")
    flows = {group.flow for group in state.groups.values()}
    flows |= {run.flow for run in state.runs.values()} | {each.flow for each in state.evaluations.values()}
    users = Counter(flow.case_set for flow in flows if flow.case_set is not None)
    for kernel in state.kernels.values():
        for index in (kernel.permits, kernel.asks, kernel.hidden, kernel.train, kernel.reservations):
            users.update({case_set: len(there) for case_set, there in index.items() if case_set is not None})
    for case_set in state.case_sets._known.values():
        want("", case_set.users == users[case_set], "a case set is kept while it has users")
    for group in state.groups.values():
        run = state.runs.get(group.run)
        early = run and group.hidden and run.state.phase == "open"
        want(group.id, not early, "an open run plays nothing hidden")
    for group in state.held:
        want(group.id, group.held_since is not None and not group.closed, "only open groups are held")


def want(key: str, holds: object, what: str) -> None:
    """Raises InvariantError when `holds` is false. `key` names the record concerned."""
    if not holds:
        raise InvariantError(f"{key}: violated: {what}")


def _jobs(state: State) -> None:
    live = 0
    ready: dict[JobState, None] = {}
    for flow in {group.flow for group in state.groups.values()}:
        current = (job for line in flow.ready for generation, job in line if generation == job.generation)
        ready |= dict.fromkeys(current)
    ends = not state.adopting or ("adopt", "") in state.timers
    want("", ends, "a job that waits for adoption has a deadline")
    for group in state.groups.values():
        n_open = sum(job.n for job in group.jobs.values())
        want(group.id, n_open + group.done == group.n, "each episode is open or done")
        leased = sum(job.lease is not None for job in group.jobs.values())
        want(group.id, leased == group.n_leased, "leased jobs are counted")
        live += leased
        for job in group.jobs.values():
            key = job.job_id
            want(key, state.jobs.get(key) is job, "an open job is known by its id")
            holds = {
                "queued": job in (state.suspects if job.alone else ready),
                "leased": job.lease is not None,
                "backing_off": ("job", key) in state.timers,
                "adopting": job in state.adopting,
            }
            places = [place for place, there in holds.items() if there]
            want(key, places == [job.place], f"the job is where its field says ({job.place}): {places}")
            want(key, JOB[job.place], "an open job has a further transition")
            if job.reserved is not None:
                emptied = state.workers.get(job.reserved)
                want(key, emptied and emptied.reserved is job, "a suspect's worker reserves it")
            lease = job.lease
            if lease is not None:
                worker = state.workers.get(lease.worker)
                held = worker is not None and worker.leases.get(lease.id) is lease
                want(key, held and lease.live, "the job's lease is live and held by its worker")
                want(key, lease.attempt in job.held_attempts, "the attempt is among the held ones")
    n_jobs = sum(len(group.jobs) for group in state.groups.values())
    want("", len(state.jobs) == n_jobs, "every job belongs to an open group")
    want("", live == state.n_live, "live leases are counted")


def _queue(state: State) -> None:
    flows = {group.flow for group in state.groups.values()}
    for job in state.suspects:
        want(job.job_id, job.queued and job.alone, "a suspect waits")
    for flow in flows:
        leased = sum(group.n_leased for group in state.groups.values() if group.flow is flow)
        want(flow.id, leased == flow.n_leased, "a flow counts its leased jobs")
        hidden = sum(group.hidden for group in state.groups.values() if group.flow is flow)
        want(flow.id, hidden == flow.n_hidden, "a flow counts its open groups of hidden jobs")
        unpinned = state.unpinned.get(flow.id) is flow
        want(flow.id, unpinned == (flow.pin is None), "a flow without a pin waits for one")
        for priority in range(N_PRIORITIES):
            valid = [job for generation, job in flow.ready[priority] if job.generation == generation]
            want(flow.id, len(valid) == flow.n_ready[priority], "ready jobs are counted")
            stray = [job for job in valid if not job.queued or job.priority != priority or job.alone]
            want(flow.id, not stray, "only queued jobs of that priority are in the queue")
            if flow.lane is not None and flow.n_ready[priority]:
                want(flow.id, flow.in_heap[priority], "a flow with ready jobs is in its lane's heap")
    for lane in state.lanes.values():
        for priority in range(N_PRIORITIES):
            total = sum(flow.n_ready[priority] for flow in flows if flow.lane is lane)
            want(str(lane.key), total == lane.n_ready[priority], "a lane counts its flows' ready jobs")
        waiting = [job for job in state.jobs.values() if job.queued and job.group.flow.lane is lane]
        for priority in range(N_PRIORITIES):
            case_sets = Counter(job.group.flow.case_set for job in waiting if job.priority == priority)
            want(str(lane.key), dict(case_sets) == lane.waiting[priority], "waiting case sets are counted")
        for reservation in lane.reservations.values():
            there = reservation.kernel.reservations.get(reservation.case_set, {})
            want(str(lane.key), there.get(str(lane.key)) is reservation, "its kernel lists a reservation")
        for profile in lane.profiles:
            want(str(lane.key), (lane in profile.busy) == any(lane.n_ready), "profiles list busy lanes")


def _workers(state: State) -> None:
    for profile in state.profiles.values():
        workers = [state.workers[name] for name in profile.workers]
        key = str(sorted(profile.classes.items()))
        want(key, sum(worker.slots for worker in workers) == profile.slots, "slots are counted")
        for name in profile.parked:
            want(name, state.workers[name].poll is not None, "a parked worker has a poll")
        for names in profile.warm.values():
            want(key, names.keys() <= profile.parked.keys(), "warm workers are parked")

    for worker in state.workers.values():
        want(worker.name, worker.state != "lost" or not worker.leases, "a lost worker holds nothing")
        timed = ("worker", worker.name) in state.timers or worker.state == "lost"
        want(worker.name, timed, "a connected worker has a deadline")
        live = [lease.job.priority for lease in worker.leases.values() if lease.live]
        held = [live.count(priority) for priority in range(N_PRIORITIES)]
        want(worker.name, (len(live), held) == (worker.n_live, worker.held), "live leases are counted")
        want(worker.name, state.sessions.get(worker.session) == worker.name, "the worker's session is known")
        if worker.reserved is not None:
            want(worker.name, worker.reserved.reserved == worker.name, "its suspect knows the worker")
        if worker.alone is not None:
            want(worker.name, worker.alone.id in worker.leases, "its lone suspect is leased to it")
