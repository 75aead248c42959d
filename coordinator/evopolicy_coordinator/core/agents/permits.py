"""Permits: an agent's right to be alive on a kernel.

Rules that this module owns:
- A permit ends when its run's gateway closes the run, `CANCELLED_S` after its run is cancelled, or by an operator's
  command; never by silence, and never by a report of another run's gateway or of a worker.
- A permit on a kernel that no worker names, such as that of a machine before its restart, bars nothing.
- While a permit is requested, no related hidden job is leased on its kernel, unless the kernel is reserved for them
  (`precedence`). It is granted once those that are played there have ended.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from evopolicy_common.messages import gateway
from evopolicy_common.messages.run_settings import ELSEWHERE
from evopolicy_coordinator.core.contract.reasons import Reason
from evopolicy_coordinator.core.contract.records import PermitRow, RunRow, RunStateRow
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.isolation.conflicts import put
from evopolicy_coordinator.core.structures import pop_entry
from evopolicy_coordinator.core.tables.model import Ask, CaseSet, Kernel, Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep

CANCELLED_S = 30.0
"""An agent has this long to end after its run was cancelled."""


def place(run: Run, boot_id: str) -> str | None:
    """Boot id of the kernel of a run's agent when its gateway reports `boot_id`; None: on no kernel of the cluster."""
    declared = run.row.settings.agent_host
    return None if declared == ELSEWHERE else (declared or boot_id)


def permits_of_run(state: State, run: str) -> list[tuple[Kernel, PermitRow]]:
    return [(kernel, row) for kernel, (row, _) in state.permits.get(run, {}).items()]


def places(state: State, run: str) -> set[str]:
    """Boot ids of the kernels on which a run has or requests a permit."""
    return {kernel.boot_id for kernel, _ in permits_of_run(state, run)} | {
        boot_id for name, boot_id in state.asks if name == run
    }


# ---- requests ----


def ask_permit(state: State, run: Run, row: PermitRow, step: CoreStep) -> Reason | None:
    """Request a permit, again or for the first time. Returns the reason that it waits for; None when it is granted."""
    kernel, case_set = conflicts.kernel(state, row.boot_id), run.case_set
    if run.id in kernel.permits.get(case_set, ()):
        return None
    if run.id not in kernel.asks.get(case_set, ()):
        case_set.users += 1
        ask = state.asks[run.id, kernel.boot_id] = Ask(row, case_set, kernel)
        put(kernel.asks, case_set, run.id, ask)
    return _grant(state, run.id, kernel, case_set, step)


def _grant(state: State, run: str, kernel: Kernel, case_set: CaseSet, step: CoreStep) -> Reason | None:
    waits_for = conflicts.permit_conflict(state, case_set, kernel)
    if waits_for is not None:
        return waits_for
    ask = _withdraw(state, run, kernel, case_set)
    assert ask is not None
    row = msgspec.structs.replace(ask.row, granted_at=step.now)
    restore(state, row, case_set)
    step.persist(row)
    step.log("info", "permit_granted", run=run, host=row.host, boot_id=row.boot_id)
    for poll in state.polls.take_all(poll_target(run, row.boot_id)):
        step.reply(poll.request, gateway.Permit(granted=True))
    return None


def restore(state: State, row: PermitRow, case_set: CaseSet) -> None:
    case_set.users += 1
    kernel = conflicts.kernel(state, row.boot_id)
    put(kernel.permits, case_set, row.run, row)
    state.permits.setdefault(row.run, {})[kernel] = row, case_set


def _withdraw(state: State, run: str, kernel: Kernel, case_set: CaseSet) -> Ask | None:
    ask = pop_entry(kernel.asks, case_set, run)
    state.asks.pop((run, kernel.boot_id), None)
    if ask is not None:
        state.timers.disarm(("ask", (run, kernel.boot_id)))
        state.case_sets.leave(case_set)
    return ask


def forget_ask(state: State, run: str, boot_id: str, step: CoreStep) -> None:
    """Remove a permit request that was not repeated, and free the jobs that it barred."""
    ask = state.asks.get((run, boot_id))
    if ask is not None:
        conflicts.freed(state, ask.case_set, step, train_too=False)
        _withdraw(state, run, ask.kernel, ask.case_set)
        conflicts.tidy(state, ask.kernel)


def ask_ended(state: State, key: tuple[str, str], step: CoreStep) -> None:
    """A permit request's deadline: it was not repeated in time."""
    forget_ask(state, *key, step)


def settle(state: State, step: CoreStep) -> None:
    """At the end of a step: grant requested permits that have become possible."""
    state.grantable = False
    for ask in list(state.asks.values()):
        _grant(state, ask.row.run, ask.kernel, ask.case_set, step)


def drop_asks(state: State, run: str, reason: Reason, step: CoreStep) -> None:
    """Remove a run's permit requests and refuse its waiting polls."""
    for name, boot_id in [key for key in state.asks if key[0] == run]:
        forget_ask(state, name, boot_id, step)
        for poll in state.polls.take_all(poll_target(name, boot_id)):
            step.refuse(poll.request, reason)


# ---- the end ----


def end(state: State, run: str, step: CoreStep, why: str, *, boot_id: str = "") -> None:
    """End the permits of a run whose agent is gone, from one kernel or (`boot_id` empty) from all. Its permit for an
    unknown kernel ends in both cases."""
    for kernel, row in permits_of_run(state, run):
        if boot_id in ("", kernel.boot_id) or kernel is state.everywhere:
            _end(state, kernel, row, step, why)
    if not permits_of_run(state, run):
        state.timers.disarm(("cancelled", run))


def _end(state: State, kernel: Kernel, row: PermitRow, step: CoreStep, why: str) -> None:
    _, case_set = state.permits[row.run][kernel]
    pop_entry(state.permits, row.run, kernel)
    pop_entry(kernel.permits, case_set, row.run)
    step.persist(msgspec.structs.replace(row, ended_at=step.now))
    step.log("info", "permit_ended", run=row.run, host=row.host, boot_id=row.boot_id, why=why)
    conflicts.freed(state, case_set, step)
    conflicts.tidy(state, kernel)
    state.case_sets.leave(case_set)


def agent_ended(state: State, run: str, step: CoreStep) -> None:
    """A cancelled run's deadline: its agent has had its time to end."""
    end(state, run, step, "its run was cancelled")


def cancelled(state: State, run: str, step: CoreStep, at: float | None = None) -> None:
    """Set the deadline after which the permits of a cancelled run end; its agent is being ended."""
    if permits_of_run(state, run):
        state.timers.arm(("cancelled", run), (step.now if at is None else at) + CANCELLED_S)


def load(
    state: State,
    rows: Iterable[PermitRow],
    runs: dict[str, RunRow],
    states: dict[str, RunStateRow],
    step: CoreStep,
) -> None:
    """Restore the stored permits, before any job is played."""
    for row in rows:
        run = runs.get(row.run)
        if run is None or row.ended_at is not None:
            continue
        case_set = state.case_sets.join(run.settings.env, (*run.validation, *run.heldout, *run.related))
        restore(state, row, case_set)
        state.case_sets.leave(case_set)
        stored = states.get(row.run)
        if stored is not None and stored.phase == "finished":
            at = step.now if stored.closed_at is None else min(stored.closed_at, step.now)
            state.timers.arm_once(("cancelled", row.run), at + CANCELLED_S)


# ---- in words ----


def agents(state: State, run: str) -> str:
    """The place of a run's agent, in words; empty for nowhere."""
    return ", ".join(sorted(row.host or row.boot_id or "everywhere" for _, row in permits_of_run(state, run)))


def poll_target(run: str, boot_id: str) -> str:
    return f"permit {run} {boot_id}"
