"""How long a lease is on the kernel of its worker.

Rules that this module owns:
- A lease is on its kernel until its worker has let go of it: told so by a heartbeat that was sent after the lease had
  arrived or was lost, or by reporting. One whose worker fell silent stays for `CoreSettings.silent_bar_s`, within which
  the worker has stopped it by itself.
- After a start each worker that was known counts as playing anything.
"""

from __future__ import annotations

from collections.abc import Iterable

from evopolicy_common.messages.worker import HeldLease
from evopolicy_coordinator.core.model import Lease, Occupancy, Worker
from evopolicy_coordinator.core.records import KernelRow
from evopolicy_coordinator.core.state import State
from evopolicy_coordinator.core.step import Step

from . import kernels
from .kernels import put, related, take


def leased(state: State, lease: Lease, worker: Worker, serial: int, step: Step) -> None:
    """A worker was given a lease, or goes on with one."""
    before = state.lingering.get(worker.name, {}).get(lease.id)
    if before is not None:
        forget(state, before, step)
    group = lease.job.group
    if not (group.hidden or group.kind == "train"):
        return
    occupancy = Occupancy(
        lease.id,
        worker.name,
        worker.kernel,
        worker.machine_id,
        group.flow.family,
        group.hidden,
        lease,
        serial,
    )
    lease.occupancy = occupancy
    _enter(state, occupancy)


def _enter(state: State, occupancy: Occupancy) -> None:
    family = occupancy.family
    if family is not None:
        family.users += 1
        if occupancy.hidden:
            family.hidden_on[occupancy.kernel] = family.hidden_on.get(occupancy.kernel, 0) + 1
    put(
        occupancy.kernel.hidden if occupancy.hidden else occupancy.kernel.train,
        occupancy.family,
        occupancy.key,
        occupancy,
    )


def left(state: State, lease: Lease, worker: Worker, step: Step, *, sure: bool) -> None:
    """A lease is a worker's no more: surely, or by our word alone."""
    occupancy, lease.occupancy = lease.occupancy, None
    if occupancy is None:
        return
    occupancy.lease = None
    if sure:
        _gone(state, occupancy, step)
        return
    occupancy.until = max(worker.last_seen, lease.granted_at) + state.settings.silent_bar_s
    state.lingering.setdefault(occupancy.worker, {})[occupancy.id] = occupancy
    state.timers.arm_once(("linger", occupancy.worker), occupancy.until)


def _gone(state: State, occupancy: Occupancy, step: Step) -> None:
    """A stay has ended: what it barred may go on."""
    index = occupancy.kernel.hidden if occupancy.hidden else occupancy.kernel.train
    family = occupancy.family
    take(index, family, occupancy.key)
    if occupancy.hidden and family is not None:
        left = family.hidden_on[occupancy.kernel] - 1
        if left:
            family.hidden_on[occupancy.kernel] = left
        else:
            del family.hidden_on[occupancy.kernel]
    if not related(index, family):
        kernels.freed(state, family, step, train_too=occupancy.hidden)
    kernels.tidy(state, occupancy.kernel)
    state.families.leave(family)


def forget(state: State, occupancy: Occupancy, step: Step) -> None:
    """What a worker had let go of, as far as was known, has surely ended."""
    there = state.lingering[occupancy.worker]
    del there[occupancy.id]
    if not there:
        del state.lingering[occupancy.worker]
    _gone(state, occupancy, step)


def heard(state: State, worker: Worker, named: set[str], settled: int, step: Step) -> None:
    """A heartbeat: of what was given up, a worker has let go of what it does not name."""
    for occupancy in list(state.lingering.get(worker.name, {}).values()):
        if occupancy.id in named:
            occupancy.until = step.now + state.settings.silent_bar_s
        elif surely(worker, occupancy, settled):
            forget(state, occupancy, step)


def surely(worker: Worker, occupancy: Occupancy | None, settled: int) -> bool:
    """Whether a heartbeat that does not name a lease shows that its worker does not hold it and never will."""
    if occupancy is None or settled == 0:
        return True
    serial = occupancy.serial
    if serial == 0:
        # Whatever it held before it was first heard arrived before its first poll of this session was sent.
        return worker.first_serial is not None and settled >= worker.first_serial - 1
    return settled >= serial


def unknown(state: State, worker: Worker, item: HeldLease, step: Step) -> None:
    """A worker holds a lease that is not its any more: it may play it until it has stopped."""
    known = item.attempt > state.first_attempt or item.lease_id in state.lingering.get(worker.name, {})
    if known or not state.isolates:
        return
    job = state.jobs.get(item.job_id)
    group_id = item.job_id.rpartition("/")[0]
    train = group_id.endswith("/train")
    if job is not None:
        if not (job.group.hidden or job.group.kind == "train"):
            return
        train, family = job.group.kind == "train", job.group.flow.family
    else:
        run = state.runs.get(item.job_id.partition("/")[0])
        family = None if run is None else run.flow.family
    _linger(
        state,
        Occupancy(item.lease_id, worker.name, worker.kernel, worker.machine_id, family, not train, None),
        step,
    )


def _linger(state: State, occupancy: Occupancy, step: Step) -> None:
    occupancy.until = step.now + state.settings.silent_bar_s
    _enter(state, occupancy)
    state.lingering.setdefault(occupancy.worker, {})[occupancy.id] = occupancy
    state.timers.arm_once(("linger", occupancy.worker), occupancy.until)


def expire(state: State, name: str, step: Step) -> None:
    """A worker's deadline for what it has not told of."""
    for occupancy in list(state.lingering.get(name, {}).values()):
        assert occupancy.until is not None
        if step.now >= occupancy.until:
            forget(state, occupancy, step)
    if name in state.lingering:
        until = min(occupancy.until or step.now for occupancy in state.lingering[name].values())
        state.timers.arm(("linger", name), until)


# ---- workers ----


def joined(state: State, worker: Worker, step: Step) -> None:
    """A worker registered on its kernel."""
    worker.kernel.workers[worker.name] = None
    row = KernelRow(worker=worker.name, boot_id=worker.kernel.boot_id, machine_id=worker.machine_id)
    if state.known_kernels.get(worker.name) != row:
        state.known_kernels[worker.name] = row
        step.persist(row)


def replaced(state: State, worker: Worker, step: Step) -> None:
    """The same process, or one in its place: what an earlier one played on another kernel has ended with it."""
    for occupancy in list(state.lingering.get(worker.name, {}).values()):
        if occupancy.kernel is not worker.kernel and occupancy.machine_id == worker.machine_id != "":
            forget(state, occupancy, step)


def forgotten(state: State, worker: Worker) -> None:
    """A worker is not on its kernel any more."""
    if state.workers.get(worker.name) is not worker:
        worker.kernel.workers.pop(worker.name, None)
        kernels.tidy(state, worker.kernel)


def load(state: State, known_kernels: Iterable[KernelRow], step: Step) -> None:
    """Take in where workers were when they last registered, before anything is played: they may still play there."""
    for known in known_kernels:
        state.known_kernels[known.worker] = known
        kernel = kernels.kernel(state, known.boot_id)
        state.boots.setdefault(known.machine_id, {})[known.boot_id] = None
        for hidden in (True, False):
            if hidden and not known.boot_id:
                continue
            name = f"{known.worker} before, {'hidden' if hidden else 'train'}"
            _linger(state, Occupancy(name, known.worker, kernel, known.machine_id, None, hidden, None), step)
