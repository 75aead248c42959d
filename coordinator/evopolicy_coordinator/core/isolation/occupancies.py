"""How long a lease occupies the kernel of its worker.

Rules that this module owns:
- A lease occupies its kernel until its worker has released it: by reporting a result, or by a heartbeat that does not
  name it and was sent after the lease had arrived or was lost. If the worker fell silent, the occupancy stays for
  `CoreSettings.silent_bar_s`; within that time the worker has stopped the lease by itself.
- A heartbeat releases nothing on another kernel, and nothing that a worker of another machine was leased under the
  same name.
- After a start each known worker counts as playing anything.
"""

from __future__ import annotations

from collections.abc import Iterable

from evopolicy_common.messages.worker import HeldLease
from evopolicy_coordinator.core.contract.records import KernelRow
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.isolation.conflicts import put, related
from evopolicy_coordinator.core.structures import pop_entry
from evopolicy_coordinator.core.tables.model import Occupancies, Occupancy, OpenLease, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep


def leased(state: State, lease: OpenLease, worker: Worker, serial: int, step: CoreStep) -> None:
    """Enter the occupancy of a lease that a worker was granted or continues."""
    before = state.lingering.get(worker.name, {}).get(lease.id)
    if before is not None:
        forget(state, before, step)
    group = lease.job.group
    if not (group.hidden or group.kind == "train"):
        return
    place = (worker.name, worker.kernel, worker.machine, group.flow.case_set)
    lease.occupancy = Occupancy(lease.id, *place, group.hidden, lease, serial)
    _enter(lease.occupancy)


def _enter(occupancy: Occupancy) -> None:
    case_set = occupancy.case_set
    if case_set is not None:
        case_set.users += 1
    put(_index(occupancy), case_set, occupancy.key, occupancy)


def _index(occupancy: Occupancy) -> Occupancies:
    return occupancy.kernel.hidden if occupancy.hidden else occupancy.kernel.train


def vacate(state: State, lease: OpenLease, worker: Worker, step: CoreStep, *, sure: bool) -> None:
    """A worker no longer holds a lease: surely, or only by the coordinator's decision."""
    occupancy, lease.occupancy = lease.occupancy, None
    if occupancy is None:
        return
    occupancy.lease = None
    if sure:
        _gone(state, occupancy, step)
    else:
        _linger(state, occupancy, max(worker.last_seen, lease.granted_at))


def _gone(state: State, occupancy: Occupancy, step: CoreStep) -> None:
    """Remove an ended occupancy, and mark the work that it barred."""
    index, case_set = _index(occupancy), occupancy.case_set
    pop_entry(index, case_set, occupancy.key)
    if not related(index, case_set):
        conflicts.freed(state, case_set, step, train_too=occupancy.hidden)
    conflicts.tidy(state, occupancy.kernel)
    state.case_sets.leave(case_set)


def forget(state: State, occupancy: Occupancy, step: CoreStep) -> None:
    """Remove a lingering occupancy that has surely ended."""
    pop_entry(state.lingering, occupancy.worker, occupancy.id)
    _gone(state, occupancy, step)


def heard(state: State, worker: Worker, named: set[str], settled: int, step: CoreStep) -> None:
    """Process a heartbeat: the worker has released those given-up leases that it does not name."""
    for occupancy in list(state.lingering.get(worker.name, {}).values()):
        if occupancy.id in named:
            occupancy.until = step.now + state.settings.silent_bar_s
        elif surely(worker, occupancy, settled):
            forget(state, occupancy, step)


def surely(worker: Worker, occupancy: Occupancy | None, settled: int) -> bool:
    """Whether a heartbeat that does not name a lease proves that its worker does not hold it and never will. All polls
    of the worker up to number `settled` are finished; 0: it does not number its polls."""
    if occupancy is None:
        return True
    if (occupancy.kernel, occupancy.machine) != (worker.kernel, worker.machine):
        return False
    if settled == 0:
        return True
    serial = occupancy.serial
    if serial == 0:
        # Leases that it held before its first request arrived before it sent the first poll of this session.
        return worker.first_serial is not None and settled >= worker.first_serial - 1
    return settled >= serial


def unknown(state: State, worker: Worker, item: HeldLease, step: CoreStep) -> None:
    """Enter an occupancy for a lease of an earlier incarnation that a worker names but that does not count: the worker
    may play it until it has stopped."""
    known = item.attempt > state.first_attempt or item.lease_id in state.lingering.get(worker.name, {})
    if known or not state.isolates:
        return
    job = state.jobs.get(item.job_id)
    group_id = item.job_id.rpartition("/")[0]
    train = group_id.endswith("/train")
    if job is not None:
        if not (job.group.hidden or job.group.kind == "train"):
            return
        train, case_set = job.group.kind == "train", job.group.flow.case_set
    else:
        run = state.runs.get(item.job_id.partition("/")[0])
        case_set = None if run is None else run.flow.case_set
    place = (worker.name, worker.kernel, worker.machine, case_set)
    occupancy = Occupancy(item.lease_id, *place, not train, None)
    _enter(occupancy)
    _linger(state, occupancy, step.now)


def _linger(state: State, occupancy: Occupancy, since: float) -> None:
    """Keep an occupancy whose worker may have been silent since then."""
    occupancy.until = since + state.settings.silent_bar_s
    state.lingering.setdefault(occupancy.worker, {})[occupancy.id] = occupancy
    state.timers.arm_once(("linger", occupancy.worker), occupancy.until)


def expire(state: State, name: str, step: CoreStep) -> None:
    """A worker's deadline: remove the given-up occupancies whose time is up."""
    for occupancy in list(state.lingering.get(name, {}).values()):
        assert occupancy.until is not None
        if step.now >= occupancy.until:
            forget(state, occupancy, step)
    if name in state.lingering:
        until = min(occupancy.until or step.now for occupancy in state.lingering[name].values())
        state.timers.arm(("linger", name), until)


# ---- workers ----


def joined(state: State, worker: Worker, step: CoreStep) -> None:
    """Enter a newly registered worker on its kernel."""
    worker.kernel.workers[worker.name] = None
    row = KernelRow(worker=worker.name, boot_id=worker.kernel.boot_id, machine=worker.machine)
    if state.known_kernels.get(worker.name) != row:
        state.known_kernels[worker.name] = row
        step.persist(row)


def forgotten(state: State, worker: Worker) -> None:
    if state.workers.get(worker.name) is not worker:
        worker.kernel.workers.pop(worker.name, None)
        conflicts.tidy(state, worker.kernel)


def load(state: State, known_kernels: Iterable[KernelRow], step: CoreStep) -> None:
    """Restore the kernels of workers at their last registration, before any job is played: they
    may still play there."""
    for known in known_kernels:
        state.known_kernels[known.worker] = known
        kernel = conflicts.kernel(state, known.boot_id)
        for hidden in (True, False):
            if hidden and not known.boot_id:
                continue
            name = f"{known.worker} before, {'hidden' if hidden else 'train'}"
            occupancy = Occupancy(name, known.worker, kernel, known.machine, None, hidden, None)
            _enter(occupancy)
            _linger(state, occupancy, step.now)
