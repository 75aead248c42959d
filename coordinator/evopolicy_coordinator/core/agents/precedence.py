"""Precedence between hidden jobs and agents that keep each other from the same kernels.

Rules that this module owns:
- Agents have precedence at first. When the hidden jobs of a run or an evaluation were kept from all kernels for
  `CoreSettings.hidden_wait_s` in total, one kernel is reserved for them until the last is played: the one with the
  fewest related agents, then train jobs.
- A kernel counts only while a worker there plays or polls that may play them (environment, tier, fingerprint class).
  A reserved kernel that no longer counts is released.
- A reserved kernel grants no related permit. Once no related permit is left, no related train job is leased there, and
  hidden jobs go before others.
- Hidden jobs that come later do not prolong a reservation: they wait for their own time, so that train jobs and agents
  have their turn in between.
- An agent that keeps hidden jobs from a reserved kernel is stopped `CoreSettings.agent_wait_s` after its permit was
  granted: its run is cancelled. A run that never ends could otherwise keep others from their scores for ever.
- A submit is held while none of its episodes runs because hidden jobs occupy all its kernels. That time counts against
  no limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from evopolicy_coordinator.core.contract.records import submit_group
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.isolation.conflicts import all_related
from evopolicy_coordinator.core.leasing import leases
from evopolicy_coordinator.core.structures import pop_entry
from evopolicy_coordinator.core.tables.model import (
    HIDDEN,
    TRAIN,
    CaseSet,
    Flow,
    Kernel,
    Lane,
    LaneKey,
    Reservation,
)
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import AgentOverdue, CoreStep

CHECK_S = 1.0
"""Interval between checks of waiting hidden jobs, and of train jobs that hidden ones may keep waiting."""


def watch(state: State, lane: Lane, step: CoreStep) -> None:
    """Schedule the lane's next check, if it has anything to check."""
    if state.isolates and (lane.waiting[HIDDEN] or lane.reservations or lane.waiting[TRAIN]):
        state.timers.arm_once(("hidden", lane.key), step.now + CHECK_S)


def check_due(state: State, key: LaneKey, step: CoreStep) -> None:
    """A lane's deadline: reserve a kernel for hidden jobs that have waited for long, or release it; update the
    held submits."""
    lane = state.lanes.get(key)
    if lane is None:
        return
    passed_s = min(step.now - lane.checked_at, 2 * CHECK_S)
    lane.checked_at = step.now
    for reservation in list(lane.reservations.values()):
        if not any(flow.n_hidden and flow.lane is lane for flow in reservation.flows):
            _release(state, reservation, step, "its hidden cases are played")
        elif reservation.kernel not in _at_work(state, lane, step.now):
            _release(state, reservation, step, "no worker is left that plays them")
    for case_set in [each for each in lane.waiting[HIDDEN] if each is not None]:
        at_work = partial(_at_work, state, lane, step.now)
        if any(at_work()) and all(conflicts.hidden_conflict(state, case_set, each) for each in at_work()):
            _kept(state, lane, case_set, passed_s, step)
    _train(state, lane, step)
    watch(state, lane, step)


def _at_work(state: State, lane: Lane, now: float) -> Iterator[Kernel]:
    """The known kernels with an active worker that may serve the lane, and plays or has just polled. One that never
    polls may be stuck, or its kernel made up. One by one: the first free one of thousands decides."""
    for worker in (state.workers[name] for profile in lane.profiles for name in profile.workers):
        asked = worker.polled_at is not None and now - worker.polled_at <= state.settings.lease_ttl_s
        if worker.kernel is not state.everywhere and (worker.poll or worker.n_live or asked):
            yield worker.kernel


def _kept(state: State, lane: Lane, case_set: CaseSet, passed_s: float, step: CoreStep) -> None:
    """Count the wait of a case set's hidden jobs, which are kept from all kernels; reserve one for those that have
    waited for long."""
    waiting: dict[Flow, None] = {flow: None for _, _, flow in lane.heaps[HIDDEN] if flow.n_ready[HIDDEN]}
    waiting |= {job.group.flow: None for job in state.suspects if job.priority == HIDDEN}
    long: dict[Flow, None] = {}
    for flow in waiting:
        if flow.lane is lane and flow.case_set is case_set:
            flow.kept_s += passed_s
            if flow.kept_s >= state.settings.hidden_wait_s:
                long[flow] = None
    reservation = lane.reservations.get(case_set)
    if reservation is not None:
        reservation.flows.update(long)
        _end_overdue(state, reservation, step)
    elif long:
        _reserve(state, lane, case_set, long, step)


def _end_overdue(state: State, reservation: Reservation, step: CoreStep) -> None:
    """Report the runs whose agents have kept hidden jobs from a reserved kernel for too long."""
    for kernel in (reservation.kernel, state.everywhere):
        for row in all_related(kernel.permits, reservation.case_set):
            if row.run in state.runs and step.now - row.granted_at >= state.settings.agent_wait_s:
                step.tell(AgentOverdue(state.runs[row.run]))


def _reserve(state: State, lane: Lane, case_set: CaseSet, flows: dict[Flow, None], step: CoreStep) -> None:
    def in_the_way(kernel: Kernel) -> tuple[int, int]:
        return len(all_related(kernel.permits, case_set)), len(all_related(kernel.train, case_set))

    kernel = min(_at_work(state, lane, step.now), key=in_the_way)
    reservation = lane.reservations[case_set] = Reservation(kernel, lane, case_set, flows)
    case_set.users += 1
    conflicts.put(kernel.reservations, case_set, str(lane.key), reservation)
    step.dirty[lane] = None
    step.log("info", "hidden_first", env=lane.key[0], boot_id=kernel.boot_id, agents=in_the_way(kernel)[0])


def _release(state: State, reservation: Reservation, step: CoreStep, why: str) -> None:
    """Release a reserved kernel: agents have precedence again."""
    kernel, case_set, lane = reservation.kernel, reservation.case_set, reservation.lane
    del lane.reservations[case_set]
    pop_entry(kernel.reservations, case_set, str(lane.key))
    step.log("info", "agents_first", env=lane.key[0], boot_id=kernel.boot_id, why=why)
    conflicts.freed(state, case_set, step)
    conflicts.tidy(state, kernel)
    state.case_sets.leave(case_set)


def _train(state: State, lane: Lane, step: CoreStep) -> None:
    """Start or stop counting the time for which submits are held."""
    barred = {
        case_set
        for case_set in (lane.waiting[TRAIN] if lane.slots() else ())
        if all(conflicts.train_conflict(state, case_set, each) for each in conflicts.serving(state, lane))
    }
    for group in [group for group in state.held if group.flow.lane is lane]:
        if group.flow.case_set not in barred:
            leases.let_go(state, group, step.now)
    if not barred:
        return
    waiting = {flow.id: None for _, _, flow in lane.heaps[TRAIN]}
    waiting |= {job.group.run: None for job in state.suspects if job.priority == TRAIN}
    for name in waiting:
        run = state.runs.get(name)
        open_group = "" if run is None or run.open is None else submit_group(run.id, run.open, "train")
        submitted = state.groups.get(open_group)
        if (
            submitted is None
            or submitted.n_leased
            or submitted.flow.lane is not lane
            or submitted.flow.case_set not in barred
        ):
            continue
        if submitted.held_since is None:
            submitted.held_since = step.now
            state.held[submitted] = None
