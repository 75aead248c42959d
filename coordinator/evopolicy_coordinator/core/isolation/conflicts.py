"""Conflicts that keep hidden jobs, train jobs and agents from a kernel.

Rules that this module owns:
- A hidden job is leased on a known kernel only, and only while no related run has or requests a permit there and no
  related train job is leased there. Neither a permit nor a train job is granted while a related hidden job is there.
- A kernel that is reserved for hidden jobs grants no related permits and, once no related permit is left there, no
  related train jobs. A run that holds a permit there continues, so that it can end.
- A gateway learns nothing of this except that it waits for hidden cases.
- A kernel is identified by its boot id; an unknown kernel counts as every kernel.
- When a kernel is freed, lanes and permit requests that may have waited for it are marked for the scheduler.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from evopolicy_coordinator.core.contract.reasons import Reason, because
from evopolicy_coordinator.core.contract.records import PermitRow
from evopolicy_coordinator.core.tables.model import (
    HIDDEN,
    TRAIN,
    CaseSet,
    JobGroup,
    JobState,
    Kernel,
    Lane,
    Worker,
)
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep

T = TypeVar("T")


def kernel(state: State, boot_id: str) -> Kernel:
    """Returns the kernel with that boot id; creates it if it is new."""
    kernel = state.kernels.get(boot_id)
    if kernel is None:
        kernel = state.kernels[boot_id] = Kernel(boot_id)
    return kernel


def tidy(state: State, kernel: Kernel) -> None:
    present = (kernel.workers, kernel.permits, kernel.asks, kernel.hidden, kernel.train, kernel.reservations)
    if kernel is not state.everywhere and not any(present):
        state.kernels.pop(kernel.boot_id, None)


def serving(state: State, lane: Lane) -> Iterator[Kernel]:
    """The kernels of the active workers that may serve a lane, one by one as in `precedence._at_work`."""
    workers = state.workers
    return (workers[name].kernel for profile in lane.profiles for name in profile.workers)


def freed(state: State, case_set: CaseSet | None, step: CoreStep, *, train_too: bool = True) -> None:
    """Mark the lanes of a case set's waiting jobs after a bar was lifted on some kernel: for hidden jobs, and with
    `train_too` also for train jobs and permits."""
    state.grantable = state.grantable or train_too
    lanes: Iterable[Lane] = state.lanes.values()
    if case_set is not None:
        lanes = [lane for each in case_set.relatives for lane in each.lanes]
    for lane in lanes:
        if lane not in step.dirty and lane.waits_of(case_set, train_too=train_too):
            step.dirty[lane] = None


# ---- occupants of a kernel, by case set ----


def related(index: dict[CaseSet | None, dict[str, T]], case_set: CaseSet | None) -> dict[str, T] | None:
    """The entries in `index` of one of the case set's relatives; None when it has none."""
    if not index:
        return None
    if case_set is None:
        return next(iter(index.values()))
    for each in case_set.relatives:
        there = index.get(each)
        if there is not None:
            return there
    return index.get(None)


def all_related(index: dict[CaseSet | None, dict[str, T]], case_set: CaseSet | None) -> list[T]:
    """All entries in `index` of the case set's relatives."""
    if not index:
        return []
    case_sets = index if case_set is None else (*case_set.relatives, None)
    return [each for member in case_sets for each in index.get(member, {}).values()]


def put(index: dict[CaseSet | None, dict[str, T]], case_set: CaseSet | None, name: str, what: T) -> None:
    """Enter `what` under its case set and name."""
    index.setdefault(case_set, {})[name] = what


NO_BOOT_ID = (
    "the worker does not report its kernel's boot id, so an agent may be on the same one; install the coordinator's"
    " version of evopolicy there"
)


def concerns(state: State, priority: int, worker: Worker) -> bool:
    """Whether `conflict` may hold for any case set."""
    if priority == TRAIN:
        kernel = worker.kernel
        there = kernel.hidden or kernel.reservations or state.everywhere.hidden
        return state.isolates and (bool(there) or kernel is state.everywhere)
    return state.isolates and priority == HIDDEN


def conflict(state: State, priority: int, case_set: CaseSet | None, worker: Worker) -> bool:
    """Whether a job of that priority and case set must not be leased to a worker now."""
    if not state.isolates:
        return False
    if priority == TRAIN:
        return train_conflict(state, case_set, worker.kernel)
    if priority != HIDDEN:
        return False
    return hidden_conflict(state, case_set, worker.kernel) is not None or _train_waits(case_set, worker)


def _train_waits(case_set: CaseSet | None, worker: Worker) -> bool:
    """Whether related train jobs wait for workers like this one: hidden jobs must not delay them."""
    assert case_set is not None
    if related(worker.kernel.reservations, case_set):
        return False
    busy = worker.profile.busy
    return any(
        lane in busy and each in lane.waiting[TRAIN] for each in case_set.relatives for lane in each.lanes
    )


def train_conflict(state: State, case_set: CaseSet | None, kernel: Kernel) -> bool:
    """Whether hidden jobs keep train jobs of a case set from a kernel."""
    if kernel is state.everywhere:
        return any(
            related(each.hidden, case_set) or reserved_there(state, each, case_set)
            for each in state.kernels.values()
        )
    if related(kernel.hidden, case_set) or related(state.everywhere.hidden, case_set):
        return True
    return bool(kernel.reservations) and reserved_there(state, kernel, case_set)


def reserved_there(state: State, kernel: Kernel, case_set: CaseSet | None) -> bool:
    """Whether the kernel is reserved for related hidden jobs and train jobs of the case set are held back for it."""
    return related(kernel.reservations, case_set) is not None and not permits_there(state, kernel, case_set)


def permits_there(state: State, kernel: Kernel, case_set: CaseSet | None) -> dict[str, PermitRow] | None:
    """Permits of the case set's relatives that may be on a kernel; None for none."""
    return related(kernel.permits, case_set) or related(state.everywhere.permits, case_set)


def hidden_conflict(state: State, case_set: CaseSet | None, kernel: Kernel) -> str | None:
    """Why hidden jobs of a case set must not be leased on a kernel: `kernel`, `agent`, `asked` or
    `train`; None: they may."""
    if kernel is state.everywhere:
        return "kernel"
    if permits_there(state, kernel, case_set):
        return "agent"
    reserved = related(kernel.reservations, case_set)
    if not reserved and (related(kernel.asks, case_set) or related(state.everywhere.asks, case_set)):
        return "asked"
    if related(kernel.train, case_set) or related(state.everywhere.train, case_set):
        return "train"
    return None


def permit_conflict(state: State, case_set: CaseSet, kernel: Kernel) -> Reason | None:
    """The reason why a permit must wait; None when it may be granted."""
    if not state.isolates:
        return None
    there = state.kernels.values() if kernel is state.everywhere else (kernel, state.everywhere)
    if any(related(each.reservations, case_set) for each in there):
        return because("scoring")
    occupancies = [occupancy for each in there for occupancy in all_related(each.hidden, case_set)]
    if not occupancies:
        return None
    if any(each.lease is not None for each in occupancies):
        return because("scoring")
    return because("to_report")


def adoptable(state: State, job: JobState, worker: Worker) -> bool:
    """Whether a job that a worker reports to hold since before the core was loaded may continue there."""
    case_set, here = job.group.flow.case_set, (worker.kernel, state.everywhere)
    if not state.isolates or not (job.group.hidden or job.priority == TRAIN):
        return True
    if job.priority == TRAIN:
        there = [occupancy for each in here for occupancy in all_related(each.hidden, case_set)]
    elif hidden_conflict(state, case_set, worker.kernel) in ("kernel", "agent"):
        return False
    else:
        there = [occupancy for each in here for occupancy in all_related(each.train, case_set)]
    # This worker's own lingering occupancies do not count: its heartbeat names every lease that it holds.
    return all(occupancy.lease is None and occupancy.worker == worker.name for occupancy in there)


# ---- reasons ----


def conflict_of_worker(state: State, worker: Worker) -> str:
    """Why a worker plays no hidden episodes now; empty when it may."""
    kernel = worker.kernel
    if not state.isolates:
        return ""
    if kernel is state.everywhere:
        return NO_BOOT_ID
    rows = [
        row
        for each in (kernel, state.everywhere)
        for there in each.permits.values()
        for row in there.values()
    ]
    return f"the agent of {rows[0].run} may be alive there" if rows else ""


def obstacle(state: State, group: JobGroup) -> Reason | None:
    """The reason that keeps an open group from all workers that could play it; None when it has none of this kind.

    For a train group the only such reason is hidden jobs.
    """
    lane, case_set = group.flow.lane, group.flow.case_set
    if lane is None or not state.isolates or not (group.hidden or group.kind == "train") or not lane.slots():
        return None
    if group.kind == "train":
        barred = all(train_conflict(state, case_set, kernel) for kernel in serving(state, lane))
        return because("scoring") if barred else None
    why: set[str] = set()
    for kernel in serving(state, lane):
        reason = hidden_conflict(state, case_set, kernel)
        if reason is None:
            return None
        why.add(reason)
    for kernel in serving(state, lane):
        permits = permits_there(state, kernel, case_set)
        if permits is not None:
            row = next(iter(permits.values()))
            return because("agent_alive", run=row.run, place=row.host or row.boot_id)
    if "asked" in why:
        return because("agent_starting")
    if "train" in why:
        return because("related_train")
    return because("unknown_kernel")
