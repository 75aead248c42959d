"""Reasons of refusals and waits: codes with their arguments. The shell puts them into words
(`server.reason_texts`, which has the texts of waits)."""

from __future__ import annotations

from typing import Any, NamedTuple

from evopolicy_common.refusals import Refusal

REFUSALS: dict[str, tuple[Refusal, str]] = {
    # Runs and evaluations.
    "unknown_run": (
        Refusal.UNKNOWN_RUN,
        "unknown run {run!r}; `evopolicy status` shows those that are not finished",
    ),
    "no_unfinished_run": (Refusal.UNKNOWN_RUN, "no unfinished run {run!r}; `evopolicy status` shows them"),
    "unknown_evaluation": (Refusal.UNKNOWN_EVALUATION, "unknown evaluation {evaluation!r}"),
    "run_cancelled": (Refusal.RUN_CANCELLED, "run {run!r} was cancelled"),
    "run_finished": (Refusal.RUN_FINISHED, "run {run!r} is finished"),
    "run_closed": (Refusal.RUN_CLOSED, "run {run!r} is closed"),
    "run_takes_no_more": (Refusal.RUN_CLOSED, "run {run!r} is closed and takes no more submits"),
    "run_exists": (Refusal.BAD_SETTINGS, "run {run!r} already exists"),
    "budget_below_one": (Refusal.BAD_SETTINGS, "the budget is {budget} episodes; it must be at least 1"),
    "submit_bounds": (
        Refusal.BAD_SETTINGS,
        "a submit of {least} to {most} episodes; 1 ≤ minimum ≤ maximum is needed",
    ),
    "minimum_over_budget": (
        Refusal.BAD_SETTINGS,
        "a submit takes at least {least} episodes, the budget is {budget}",
    ),
    "no_cases": (Refusal.BAD_SETTINGS, "the {split} split has no cases"),
    "evaluation_without_cases": (Refusal.BAD_REQUEST, "an evaluation needs at least one case"),
    "epoch_revealed": (
        Refusal.BAD_SETTINGS,
        "the cases of epoch {epoch} are public, as runs on them were published: stop the coordinator, run"
        " `evopolicy-coordinator epoch new --state {state}`, and start it again, or name other cases with --data",
    ),
    "epoch_in_use": (
        Refusal.BUSY,
        "run {run!r} is not finished and plays cases of the same epoch, which publishing would reveal; wait for"
        " its end, or cancel it",
    ),
    # Submits.
    "busy": (Refusal.BUSY, "submit {submit} is still running; one runs at a time"),
    "key_used": (Refusal.KEY_CONFLICT, "key {key!r} was used for submit {submit} with another request"),
    "no_bundle": (Refusal.BAD_REQUEST, "a submit needs a bundle, or the reason why it has none"),
    "unknown_submit": (Refusal.UNKNOWN_SUBMIT, "run {run!r} has {n} submits, none of index {submit}"),
    "unknown_case": (Refusal.INVALID_ENV_INSTANCE, "env_instances names {case}; train cases are 0 to {last}"),
    "too_few": (Refusal.BUDGET_INVALID, "{n} episodes asked for; a submit takes at least {least}"),
    "too_many": (Refusal.BUDGET_INVALID, "{n} episodes asked for; a submit takes at most {most}"),
    "over_budget": (Refusal.BUDGET_INVALID, "{n} episodes asked for; {remaining} of the budget remain"),
    "no_worker_yet": (Refusal.NO_WORKER, "the run waits for {waits_for}"),
    "may_not_start": (Refusal.UNAVAILABLE, "the run's agent may not start yet; it waits for {waits_for}"),
    "too_many_places": (
        Refusal.BAD_REQUEST,
        "the agent of run {run!r} has been on {n} kernels, which is the limit; if it is to start on another,"
        " run `evopolicy runs agent-gone {run}` first",
    ),
    # Workers.
    "name_taken": (
        Refusal.NAME_TAKEN,
        "a worker of another machine has the name {worker!r}; choose another --name",
    ),
    "no_room": (
        Refusal.TOO_LARGE,
        "{n:,} workers, with {size:,} bytes of environments, may join with one token: stop some, wait an hour for lost"
        " ones to be forgotten, or give other machines a folder of their own (`evopolicy-coordinator certs issue worker"
        " NAME`)",
    ),
    "unknown_session": (
        Refusal.UNKNOWN_WORKER,
        "the session of worker {worker!r} is unknown; register again",
    ),
    "unknown_class": (
        Refusal.UNKNOWN_CLASS,
        "no worker of class {name!r} can play the run; the classes are {offered}",
    ),
}
"""By code: the status of a refusal, and its text with placeholders for the reason's arguments."""


class Reason(NamedTuple):
    """A code and its arguments by name; an argument may be another reason."""

    code: str
    about: dict[str, Any]


def because(code: str, **about: object) -> Reason:
    return Reason(code, about)


class NotDoneError(Exception):
    """A rule does not carry out its request: the request is refused with the reason."""

    def __init__(self, code: str | Reason, **about: object) -> None:
        super().__init__(code)
        self.reason = because(code, **about) if isinstance(code, str) else code
