"""Reasons of refusals: the one list of codes that the coordinator replies with and all rooms decide by."""

from __future__ import annotations

from enum import StrEnum


class Refusal(StrEnum):
    """The code of a refusal on the wire; the message beside it is for people."""

    # The client has no right to make the request.
    BAD_TOKEN = "bad_token"
    REVOKED = "revoked"
    WRONG_KEY = "wrong_key"

    # The request itself is wrong.
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

    # The request names something that does not exist.
    DAMAGED = "damaged"
    MISSING_BLOB = "missing_blob"
    MISSING_BUNDLE = "missing_bundle"
    UNKNOWN_BLOB = "unknown_blob"
    UNKNOWN_CLASS = "unknown_class"
    UNKNOWN_EVALUATION = "unknown_evaluation"
    UNKNOWN_RUN = "unknown_run"
    UNKNOWN_SUBMIT = "unknown_submit"
    UNKNOWN_WORKER = "unknown_worker"

    # The run accepts no more requests.
    RUN_CANCELLED = "run_cancelled"
    RUN_CLOSED = "run_closed"
    RUN_FINISHED = "run_finished"

    # A worker is not admitted.
    BAD_NAME = "bad_name"
    NAME_TAKEN = "name_taken"
    WRONG_PROTOCOL = "wrong_protocol"

    # Temporary.
    NO_WORKER = "no_worker"
    UNAVAILABLE = "unavailable"

    OTHER = "other"
    """A code of a newer version."""

    @classmethod
    def _missing_(cls, value: object) -> Refusal:
        return cls.OTHER


WRONG_REQUEST = frozenset({Refusal.BUDGET_INVALID, Refusal.INVALID_ENV_INSTANCE})
"""For a run's gateway: the agent gets the refusal of its submit. A code that has no rule ends the gateway's process."""

RUN_OVER = frozenset({Refusal.RUN_CANCELLED, Refusal.RUN_CLOSED, Refusal.RUN_FINISHED})
"""For a run's gateway: no further request of this run is served."""

RUN_LOST = frozenset({Refusal.BAD_TOKEN, Refusal.UNKNOWN_RUN})
"""For a run's gateway: the coordinator was started on a backup from before the run; its command opens the run again."""

NOT_NOW = frozenset({Refusal.NO_WORKER, Refusal.UNAVAILABLE})
"""Retry: no worker has described the environment yet, or the coordinator's disk is full."""

WRONG_SETTINGS = frozenset(
    {Refusal.BAD_REQUEST, Refusal.BAD_SETTINGS, Refusal.INVALID_ENV_INSTANCE, Refusal.INVALID_SETTINGS}
)
"""For an operator: an option of the command is the cause."""
