"""The runs that take requests, requests for permits, and an operator's statement that an agent is gone."""

from __future__ import annotations

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages.run_settings import ELSEWHERE, HiddenIsolation
from evopolicy_coordinator.core.agents import permits
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.reasons import NotDoneError, Reason, because
from evopolicy_coordinator.core.contract.records import PermitRow, RunRow
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.structures.timers import Poll
from evopolicy_coordinator.core.tables.model import EVERYWHERE, Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep

ASK_AGAIN_S = 10.0
"""A declined permit request is kept for this long, until the gateway repeats it."""
MAX_PLACES = 16
"""Kernels on which a run's agent may be: enough for an agent that moves, and for machines that restart. With more, a
hostile gateway could keep hidden jobs from every kernel, and add rows without end."""


def live(state: State, name: str) -> Run:
    """Returns the unfinished run of that name. Raises NotDoneError for any other."""
    run = state.runs.get(name)
    if run is None:
        raise NotDoneError(over(state, name))
    return run


def known_run(state: State, name: str) -> Run | None:
    """Returns the run of that name; None for a finished one. Raises NotDoneError for an unknown one."""
    if name not in state.capabilities:
        raise NotDoneError("unknown_run", run=name)
    return state.runs.get(name)


def check_whole(run: Run, n_submits: int) -> None:
    """Raises NotDoneError (UNKNOWN_SUBMIT) when a gateway knows of more accepted submits: this is an earlier backup."""
    if n_submits > len(run.submits):
        raise NotDoneError("unknown_submit", run=run.id, n=len(run.submits), submit=n_submits - 1)


def over(state: State, name: str) -> Reason:
    """Returns why a run that is not open refuses requests."""
    last = state.finished.get(name)
    if last is not None and last.cancelled:
        return because("run_cancelled", run=name)
    if last is not None:
        return because("run_finished", run=name)
    if name in state.runs:
        return because("run_takes_no_more", run=name)
    return because("unknown_run", run=name[:64])


# ---- permits ----


def requested(state: State, event: events.Requested[gateway.RequestPermit], step: CoreStep) -> None:
    """A gateway requests that its agent may be alive on a kernel."""
    message = event.message
    run = state.runs.get(message.run)
    if run is None or run.state.phase != "open":
        raise NotDoneError(over(state, message.run))
    kernel = permits.place(run, message.boot_id)
    if kernel is None:
        step.reply(event.request, gateway.Permit(granted=True))
        return
    places = permits.places(state, run.id)
    if kernel not in places and len(places) >= MAX_PLACES:
        raise NotDoneError("too_many_places", run=run.id, n=MAX_PLACES)
    row = PermitRow(run=run.id, boot_id=kernel, host=message.host if kernel == message.boot_id else "")
    waits_for = permits.ask_permit(state, run, row, step)
    if waits_for is None:
        step.reply(event.request, gateway.Permit(granted=True))
        return
    state.timers.arm(("ask", (run.id, kernel)), step.now + max(0.0, message.wait_s) + ASK_AGAIN_S)
    poll = Poll(event.request, "permit", permits.poll_target(run.id, kernel))
    if not state.polls.wait(poll, message.wait_s, step.now):
        step.reply(event.request, gateway.Permit(granted=False), waits_for)


def answer(state: State, poll: Poll, step: CoreStep) -> None:
    """A gateway's wait for a permit has timed out."""
    _, run, boot_id = poll.target.split(" ", 2)
    waits_for = conflicts.permit_conflict(state, state.runs[run].case_set, conflicts.kernel(state, boot_id))
    step.reply(poll.request, gateway.Permit(granted=False), waits_for)


def demand_permit(state: State, run: Run, step: CoreStep) -> None:
    """Raises NotDoneError (UNAVAILABLE) while a run's agent, which may be on any machine, lacks a permit. For a run
    whose gateway requests none, requests the permit for any kernel."""
    kernel = permits.place(run, EVERYWHERE)
    if run.state.phase != "open" or kernel is None or permits.permits_of_run(state, run.id):
        return
    waits_for = permits.ask_permit(state, run, PermitRow(run=run.id, boot_id=kernel), step)
    if waits_for is not None:
        state.timers.arm(("ask", (run.id, kernel)), step.now + ASK_AGAIN_S)
        raise NotDoneError("may_not_start", waits_for=waits_for)


def agent_gone(state: State, event: events.Requested[operator.AgentGone], step: CoreStep) -> None:
    """An operator confirms that a run's agent is no longer alive."""
    message = event.message
    known_run(state, message.run)
    permits.end(state, message.run, step, "by an operator's command", boot_id=message.boot_id)
    step.reply(event.request, operator.Done())


def stamp(state: State, row: RunRow) -> HiddenIsolation:
    """The isolation that a new run is stored with."""
    if not state.isolates:
        return "shared"
    return "waived" if row.settings.agent_host == ELSEWHERE else "exclusive"


def resume(state: State, run: Run, step: CoreStep) -> None:
    """Restore the isolation and permits of an unfinished run in a core that was just loaded."""
    before = run.state.isolation
    if before == "unknown":
        if run.state.phase == "open" and not permits.permits_of_run(state, run.id):
            # Its gateway so far requested no permit.
            kernel = permits.place(run, EVERYWHERE)
            if kernel is not None:
                row = PermitRow(run=run.id, boot_id=kernel, granted_at=step.now)
                permits.restore(state, row, run.case_set)
                step.persist(row)
    elif before != "shared" and not state.isolates:
        step.change_run(run, isolation="shared")
