"""Finds unfinished runs, and the reason why other runs refuse requests."""

from __future__ import annotations

from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.core.contract.events import RequestId
from evopolicy_coordinator.core.contract.reasons import Reason, because
from evopolicy_coordinator.core.tables.model import Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step


def live(state: State, request: RequestId, name: str, step: Step) -> Run | None:
    """Returns the unfinished run of that name; otherwise refuses the request and returns None."""
    run = state.runs.get(name)
    if run is None:
        step.refuse(request, *over(state, name))
    return run


def over(state: State, name: str) -> tuple[Refusal, Reason]:
    """Returns why a run that is not open refuses requests."""
    last = state.finished.get(name)
    if last is not None and last.cancelled:
        return Refusal.RUN_CANCELLED, because("run_cancelled", run=name)
    if last is not None:
        return Refusal.RUN_FINISHED, because("run_finished", run=name)
    if name in state.runs:
        return Refusal.RUN_CLOSED, because("run_takes_no_more", run=name)
    return Refusal.UNKNOWN_RUN, because("unknown_run", run=name[:64])
