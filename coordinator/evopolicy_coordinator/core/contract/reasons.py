"""Reasons of refusals and waits: codes with their arguments. The shell puts them into words (`server.reason_texts`)."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

Code = Literal[
    # Refused: runs and evaluations.
    "unknown_run",
    "no_unfinished_run",
    "unknown_evaluation",
    "run_cancelled",
    "run_finished",
    "run_closed",
    "run_takes_no_more",
    "run_exists",
    "budget_below_one",
    "submit_bounds",
    "minimum_over_budget",
    "no_cases",
    "evaluation_without_cases",
    "epoch_revealed",
    "epoch_in_use",
    # Refused: submits.
    "busy",
    "key_used",
    "no_bundle",
    "unknown_submit",
    "unknown_case",
    "too_few",
    "too_many",
    "too_many_rejected",
    "over_budget",
    "no_worker_yet",
    "may_not_start",
    "too_many_places",
    # Refused: workers.
    "name_taken",
    "no_room",
    "unknown_session",
    "forger",
    "quarantined",
    "unknown_class",
    # Waits of a group, a permit or a run.
    "workers",
    "description",
    "scoring",
    "being_put_off",
    "to_report",
    "agent_alive",
    "agent_starting",
    "related_train",
    "unknown_kernel",
    "hand_back",
    "adoption",
    "own_fault",
    "bench",
    "free_slot",
    "audits",
]


class Reason(NamedTuple):
    """A code and its arguments by name; an argument may be another reason."""

    code: Code
    about: dict[str, Any]


def because(code: Code, **about: Any) -> Reason:
    return Reason(code, about)
