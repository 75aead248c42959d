"""How long a lease is on the kernel of its worker.

Rules that this module owns:
- A lease is on its kernel until its worker has let go of it: told so by a heartbeat that was sent after the lease had
  arrived or was lost, or by handing in. One whose worker fell silent stays for `CoreSettings.silent_bar_s`, within which
  the worker has stopped it by itself.
- After a start each worker that was known counts as playing anything.
"""

from __future__ import annotations

from collections.abc import Iterable

from evopolicy_common.messages.worker import HeldLease
from evopolicy_coordinator.core.model import Lease, Stay, Worker
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
    stay = Stay(
        lease.id,
        worker.name,
        worker.kernel,
        worker.machine_id,
        group.flow.family,
        group.hidden,
        lease,
        serial,
    )
    lease.stay = stay
    _enter(state, stay)


def _enter(state: State, stay: Stay) -> None:
    family = stay.family
    if family is not None:
        family.users += 1
        if stay.hidden:
            family.hidden_on[stay.kernel] = family.hidden_on.get(stay.kernel, 0) + 1
    put(stay.kernel.hidden if stay.hidden else stay.kernel.train, stay.family, stay.key, stay)


def left(state: State, lease: Lease, worker: Worker, step: Step, *, sure: bool) -> None:
    """A lease is a worker's no more: surely, or by our word alone."""
    stay, lease.stay = lease.stay, None
    if stay is None:
        return
    stay.lease = None
    if sure:
        _gone(state, stay, step)
        return
    stay.until = max(worker.last_seen, lease.granted_at) + state.settings.silent_bar_s
    state.lingering.setdefault(stay.worker, {})[stay.id] = stay
    state.timers.arm_once(("linger", stay.worker), stay.until)


def _gone(state: State, stay: Stay, step: Step) -> None:
    """A stay has ended: what it barred may go on."""
    index = stay.kernel.hidden if stay.hidden else stay.kernel.train
    family = stay.family
    take(index, family, stay.key)
    if stay.hidden and family is not None:
        left = family.hidden_on[stay.kernel] - 1
        if left:
            family.hidden_on[stay.kernel] = left
        else:
            del family.hidden_on[stay.kernel]
    if not related(index, family):
        kernels.freed(state, family, step, train_too=stay.hidden)
    kernels.tidy(state, stay.kernel)
    state.families.leave(family)


def forget(state: State, stay: Stay, step: Step) -> None:
    """What a worker had let go of, as far as was known, has surely ended."""
    there = state.lingering[stay.worker]
    del there[stay.id]
    if not there:
        del state.lingering[stay.worker]
    _gone(state, stay, step)


def heard(state: State, worker: Worker, named: set[str], settled: int, step: Step) -> None:
    """A heartbeat: of what was given up, a worker has let go of what it does not name."""
    for stay in list(state.lingering.get(worker.name, {}).values()):
        if stay.id in named:
            stay.until = step.now + state.settings.silent_bar_s
        elif surely(worker, stay, settled):
            forget(state, stay, step)


def surely(worker: Worker, stay: Stay | None, settled: int) -> bool:
    """Whether a heartbeat that does not name a lease shows that its worker does not hold it and never will."""
    if stay is None or settled == 0:
        return True
    serial = stay.serial
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
        Stay(item.lease_id, worker.name, worker.kernel, worker.machine_id, family, not train, None),
        step,
    )


def _linger(state: State, stay: Stay, step: Step) -> None:
    stay.until = step.now + state.settings.silent_bar_s
    _enter(state, stay)
    state.lingering.setdefault(stay.worker, {})[stay.id] = stay
    state.timers.arm_once(("linger", stay.worker), stay.until)


def expire(state: State, name: str, step: Step) -> None:
    """A worker's deadline for what it has not told of."""
    for stay in list(state.lingering.get(name, {}).values()):
        assert stay.until is not None
        if step.now >= stay.until:
            forget(state, stay, step)
    if name in state.lingering:
        until = min(stay.until or step.now for stay in state.lingering[name].values())
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
    for stay in list(state.lingering.get(worker.name, {}).values()):
        if stay.kernel is not worker.kernel and stay.machine_id == worker.machine_id != "":
            forget(state, stay, step)


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
            _linger(state, Stay(name, known.worker, kernel, known.machine_id, None, hidden, None), step)
