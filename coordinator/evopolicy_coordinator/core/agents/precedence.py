"""Precedence between hidden jobs and agents that keep each other from the same kernels.

Rules that this module owns:
- Agents have precedence at first. When hidden jobs of closed runs, or of an operator, were kept from all kernels that
  could play them for `CoreSettings.hidden_wait_s` in total, one kernel is reserved for them until none of them is left:
  the one with the fewest related agents, then train jobs. Hidden jobs of open runs never cause this.
- No agent is stopped for hidden jobs, except one whose permit keeps them from a reserved kernel and was granted
  `CoreSettings.agent_wait_s` ago: its run is cancelled. A run that never ends could otherwise keep others from their
  scores for ever.
- A reserved kernel grants no related permit. Once no related permit is left, no related train job is leased there, and
  hidden jobs go before others.
- A submit is held while none of its episodes runs because hidden jobs occupy all its kernels. That time counts against
  no limit.
"""

from __future__ import annotations

from evopolicy_coordinator.core.contract.records import submit_group
from evopolicy_coordinator.core.isolation import conflicts, kernels
from evopolicy_coordinator.core.isolation.kernels import all_related
from evopolicy_coordinator.core.leasing import leases
from evopolicy_coordinator.core.structures import take
from evopolicy_coordinator.core.tables.model import (
    EARLY_VALIDATION,
    EVERYWHERE,
    TRAIN,
    CaseSet,
    Kernel,
    Lane,
    LaneKey,
    Reversal,
)
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import AgentOverdue, Step

CHECK_S = 1.0
"""Interval between checks of waiting hidden jobs, and of train jobs that hidden ones may keep waiting."""

DONE_CHECKS = 3
"""After this many checks without hidden jobs they count as done: jobs that follow from the last one may
take a moment to queue."""


def watch(state: State, lane: Lane, step: Step) -> None:
    """Schedule the lane's next check, if it has anything to check."""
    if state.isolates and (lane.backlog or lane.kept_s or lane.reversals or lane.waiting[TRAIN]):
        state.timers.arm_once(("hidden", lane.key), step.now + CHECK_S)


def check_due(state: State, key: LaneKey, step: Step) -> None:
    """A lane's deadline: reserve a kernel for hidden jobs that have waited for long, or release it; update the
    held submits."""
    lane = state.lanes.get(key)
    if lane is None:
        return
    passed_s = min(step.now - lane.checked_at, 2 * CHECK_S)
    lane.checked_at = step.now
    there = kernels.serving(state, lane)
    for case_set in {**lane.backlog, **lane.kept_s, **lane.reversals}:
        _hidden(state, lane, case_set, there, passed_s, step)
    _train(state, lane, there, step)
    watch(state, lane, step)


def _hidden(
    state: State, lane: Lane, case_set: CaseSet, there: dict[Kernel, None], passed_s: float, step: Step
) -> None:
    reversal = lane.reversals.get(case_set)
    played = _played(state, lane, case_set)
    if played or lane.backlog.get(case_set):
        lane.done_checks.pop(case_set, None)
    else:
        lane.done_checks[case_set] = lane.done_checks.get(case_set, 0) + 1
        if lane.done_checks[case_set] >= DONE_CHECKS:
            del lane.done_checks[case_set]
            lane.kept_s.pop(case_set, None)
            if reversal is not None:
                release_kernel(state, reversal, step, "no hidden case of closed runs is left")
        return
    if reversal is not None:
        if reversal.kernel not in there:
            release_kernel(state, reversal, step, "its workers are gone")
        elif not played:
            _end_overdue(state, reversal, step)
        return
    barred = []
    for kernel in there:
        if kernel.boot_id == EVERYWHERE:
            continue
        if conflicts.hidden_conflict(state, case_set, kernel):
            barred.append(kernel)
        elif _at_work(state, kernel):
            return
    if played or not barred:
        return
    kept_s = lane.kept_s[case_set] = lane.kept_s.get(case_set, 0.0) + passed_s
    if kept_s >= state.settings.hidden_wait_s:
        _reserve_kernel(state, lane, case_set, barred, step)


def _at_work(state: State, kernel: Kernel) -> bool:
    """Whether any worker on a kernel plays or asks for jobs. Others may have made the kernel up."""
    return any(state.workers[name].poll or state.workers[name].n_live for name in kernel.workers)


def _end_overdue(state: State, reversal: Reversal, step: Step) -> None:
    """Report the runs whose agents have kept hidden jobs from a reserved kernel for too long."""
    for kernel in (reversal.kernel, state.everywhere):
        for row in all_related(kernel.permits, reversal.case_set):
            if row.run in state.runs and step.now - row.granted_at >= state.settings.agent_wait_s:
                step.tell(AgentOverdue(state.runs[row.run]))


def _played(state: State, lane: Lane, case_set: CaseSet) -> bool:
    """Whether hidden jobs of the lane's closed runs are leased, or wait for their worker's release."""
    return any(
        occupancy.lease is not None
        and (occupancy.lease.live or occupancy.lease.parting)
        and occupancy.lease.job.group.flow.closed
        for kernel in state.kernels.values()
        for occupancy in kernel.hidden.get(case_set, {}).values()
        if occupancy.lease is not None and occupancy.lease.job.group.flow.lane is lane
    )


def _reserve_kernel(state: State, lane: Lane, case_set: CaseSet, barred: list[Kernel], step: Step) -> None:
    def in_the_way(kernel: Kernel) -> tuple[int, int]:
        return len(all_related(kernel.permits, case_set)), len(all_related(kernel.train, case_set))

    kernel = min(barred, key=in_the_way)
    reversal = lane.reversals[case_set] = Reversal(kernel, lane, case_set)
    case_set.users += 1
    kernels.put(kernel.reversals, case_set, str(lane.key), reversal)
    for occupancy in all_related(kernel.hidden, case_set):
        lease = occupancy.lease
        if lease is not None and lease.live and lease.job.priority == EARLY_VALIDATION:
            leases.put_off(state, lease, step)
    step.dirty[lane] = None
    step.log("info", "hidden_first", env=lane.key[0], boot_id=kernel.boot_id, agents=in_the_way(kernel)[0])


def release_kernel(state: State, reversal: Reversal, step: Step, why: str) -> None:
    """Release a reserved kernel: agents have precedence again."""
    kernel, case_set = reversal.kernel, reversal.case_set
    del reversal.lane.reversals[case_set]
    take(kernel.reversals, case_set, str(reversal.lane.key))
    step.log("info", "agents_first", env=reversal.lane.key[0], boot_id=kernel.boot_id, why=why)
    kernels.freed(state, case_set, step)
    kernels.tidy(state, kernel)
    state.case_sets.leave(case_set)


def _train(state: State, lane: Lane, there: dict[Kernel, None], step: Step) -> None:
    """Start or stop counting the time for which submits are held."""
    barred = {
        case_set
        for case_set in lane.waiting[TRAIN]
        if there and all(conflicts.train_conflict(state, case_set, kernel) for kernel in there)
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
