"""Which runs are there, and why nothing more is taken of those that are not open."""

from __future__ import annotations

from evopolicy_common.wire.refusals import Refusal
from evopolicy_coordinator.core.events import RequestId
from evopolicy_coordinator.core.model import Run
from evopolicy_coordinator.core.state import State
from evopolicy_coordinator.core.step import Step


def live(state: State, request: RequestId, name: str, step: Step) -> Run | None:
    """The unfinished run of that name; None, and the request is refused, when there is none."""
    run = state.runs.get(name)
    if run is None:
        step.refuse(request, *over(state, name))
    return run


def over(state: State, name: str) -> tuple[Refusal, str]:
    """Why nothing more is taken of a run that is not open, in a word and a sentence."""
    last = state.finished.get(name)
    if last is not None and last.cancelled:
        return Refusal.RUN_CANCELLED, f"run {name!r} was cancelled by the operator"
    if last is not None:
        return Refusal.RUN_FINISHED, f"run {name!r} is finished"
    if name in state.runs:
        return Refusal.RUN_CLOSED, f"run {name!r} is closed and takes no more submits"
    return Refusal.UNKNOWN_RUN, f"there is no run {name[:64]!r}"
