"""The occupants of each kernel, and the consequences when one leaves.

Rules that this module owns:
- A kernel is identified by its boot id; an unknown kernel counts as every kernel.
- When a kernel is freed, lanes and permit requests that may have waited for it are marked for the scheduler.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

from evopolicy_coordinator.core.tables.model import CaseSet, Kernel, Lane
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step

T = TypeVar("T")


def kernel(state: State, boot_id: str) -> Kernel:
    """Returns the kernel with that boot id; creates it if it is new."""
    kernel = state.kernels.get(boot_id)
    if kernel is None:
        kernel = state.kernels[boot_id] = Kernel(boot_id)
    return kernel


def tidy(state: State, kernel: Kernel) -> None:
    """Forget a kernel without occupants."""
    present = (kernel.workers, kernel.permits, kernel.asks, kernel.hidden, kernel.train, kernel.reservations)
    if kernel is not state.everywhere and not any(present):
        state.kernels.pop(kernel.boot_id, None)


def serving(state: State, lane: Lane) -> dict[Kernel, None]:
    """The kernels of the active workers that may serve a lane."""
    workers = state.workers
    return {workers[name].kernel: None for profile in lane.profiles for name in profile.workers}


def freed(state: State, case_set: CaseSet | None, step: Step, *, train_too: bool = True) -> None:
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
