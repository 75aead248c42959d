"""Why a request is refused: the one list of words that the coordinator answers with and that all rooms decide by."""

from __future__ import annotations

from enum import StrEnum


class Refusal(StrEnum):
    """A refusal's word on the wire; the text beside it is for people."""

    # Whose the request is.
    BAD_TOKEN = "bad_token"
    REVOKED = "revoked"
    WRONG_KEY = "wrong_key"

    # What is wrong with the request itself.
    BAD_MESSAGE = "bad_message"
    BAD_REQUEST = "bad_request"
    BAD_BLOB = "bad_blob"
    BAD_SETTINGS = "bad_settings"
    INVALID_SETTINGS = "invalid_settings"
    BUDGET_INVALID = "budget_invalid"
    INVALID_ENV_INSTANCE = "invalid_env_instance"
    BUSY = "busy"
    KEY_CONFLICT = "key_conflict"
    TOO_LARGE = "too_large"

    # What it names is not there.
    DAMAGED = "damaged"
    MISSING_BLOB = "missing_blob"
    MISSING_BUNDLE = "missing_bundle"
    UNKNOWN_BLOB = "unknown_blob"
    UNKNOWN_CLASS = "unknown_class"
    UNKNOWN_EVALUATION = "unknown_evaluation"
    UNKNOWN_RUN = "unknown_run"
    UNKNOWN_SUBMIT = "unknown_submit"
    UNKNOWN_WORKER = "unknown_worker"

    # The run takes no more.
    RUN_CANCELLED = "run_cancelled"
    RUN_CLOSED = "run_closed"
    RUN_FINISHED = "run_finished"

    # A worker is not let in.
    BAD_NAME = "bad_name"
    NAME_TAKEN = "name_taken"
    QUARANTINED = "quarantined"
    WRONG_PROTOCOL = "wrong_protocol"

    # Not now.
    NO_WORKER = "no_worker"
    UNAVAILABLE = "unavailable"

    OTHER = "other"
    """A word of a newer version."""

    @classmethod
    def _missing_(cls, value: object) -> Refusal:
        return cls.OTHER


RUN_OVER = frozenset(
    {
        Refusal.BAD_TOKEN,
        Refusal.RUN_CANCELLED,
        Refusal.RUN_CLOSED,
        Refusal.RUN_FINISHED,
        Refusal.UNKNOWN_RUN,
    }
)
"""To a run's gateway: nothing more of this run is served."""

NOT_NOW = frozenset({Refusal.NO_WORKER, Refusal.UNAVAILABLE})
"""Ask again: no worker has described the environment yet, or the coordinator's disk is full."""

WRONG_SETTINGS = frozenset(
    {
        Refusal.BAD_REQUEST,
        Refusal.BAD_SETTINGS,
        Refusal.INVALID_ENV_INSTANCE,
        Refusal.INVALID_SETTINGS,
    }
)
"""To an operator: an option of the command is why."""
