"""Reasons of refusals and waits: codes with their arguments. The shell puts them into words (`server.reason_texts`)."""

from __future__ import annotations

from typing import Any, NamedTuple

from evopolicy_common.refusals import Refusal

REFUSALS: dict[str, Refusal] = {
    # Runs and evaluations.
    "unknown_run": Refusal.UNKNOWN_RUN,
    "no_unfinished_run": Refusal.UNKNOWN_RUN,
    "unknown_evaluation": Refusal.UNKNOWN_EVALUATION,
    "run_cancelled": Refusal.RUN_CANCELLED,
    "run_finished": Refusal.RUN_FINISHED,
    "run_closed": Refusal.RUN_CLOSED,
    "run_takes_no_more": Refusal.RUN_CLOSED,
    "run_exists": Refusal.BAD_SETTINGS,
    "budget_below_one": Refusal.BAD_SETTINGS,
    "submit_bounds": Refusal.BAD_SETTINGS,
    "minimum_over_budget": Refusal.BAD_SETTINGS,
    "no_cases": Refusal.BAD_SETTINGS,
    "evaluation_without_cases": Refusal.BAD_REQUEST,
    "epoch_revealed": Refusal.BAD_SETTINGS,
    "epoch_in_use": Refusal.BUSY,
    # Submits.
    "busy": Refusal.BUSY,
    "key_used": Refusal.KEY_CONFLICT,
    "no_bundle": Refusal.BAD_REQUEST,
    "unknown_submit": Refusal.UNKNOWN_SUBMIT,
    "unknown_case": Refusal.INVALID_ENV_INSTANCE,
    "too_few": Refusal.BUDGET_INVALID,
    "too_many": Refusal.BUDGET_INVALID,
    "over_budget": Refusal.BUDGET_INVALID,
    "no_worker_yet": Refusal.NO_WORKER,
    "may_not_start": Refusal.UNAVAILABLE,
    "too_many_places": Refusal.BAD_REQUEST,
    # Workers.
    "name_taken": Refusal.NAME_TAKEN,
    "no_room": Refusal.TOO_LARGE,
    "unknown_session": Refusal.UNKNOWN_WORKER,
    "unknown_class": Refusal.UNKNOWN_CLASS,
}
"""The status of a refusal with that code."""


class Reason(NamedTuple):
    """A code and its arguments by name; an argument may be another reason."""

    code: str
    about: dict[str, Any]


def because(code: str, **about: Any) -> Reason:
    return Reason(code, about)


class NotDoneError(Exception):
    """A rule does not carry out its request: the request is refused with the reason."""

    def __init__(self, code: str | Reason, **about: Any) -> None:
        super().__init__(code)
        self.reason = because(code, **about) if isinstance(code, str) else code
