"""Effects: all that a core requests of its shell, as commands in order.

Rules that this module owns:
- Effects are carried out in the order given, across events too. No effect is carried out before every `Persist` ahead
  of it is durable, since a reply may report what the rows hold. Several consecutive `Persist`s, of one event or many,
  may share one transaction.
- A `Persist` that fails did not happen: the shell discards the core and every effect not yet carried out, loads a new
  core from the store, and lets the clients retry.
- A `Reply` to a client that has disconnected is dropped silently.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.worker import Message
from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.core.contract.events import RequestId
from evopolicy_coordinator.core.contract.reasons import REFUSALS, Reason
from evopolicy_coordinator.core.contract.records import Row


class Persist(msgspec.Struct, frozen=True, kw_only=True):
    """Write the rows in one transaction, durably (fsync), before carrying out the effects after it."""

    rows: tuple[Row, ...]


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """Answer the query `request` with `message`."""

    request: RequestId
    message: Message
    waits_for: Reason | None = None
    """The wait that the message describes in words; None for none."""


class Refuse(msgspec.Struct, frozen=True, kw_only=True):
    """Answer the query `request` with `Refused`: the status, and the reason in words."""

    request: RequestId
    reason: Reason

    @property
    def status(self) -> Refusal:
        return REFUSALS[self.reason.code][0]


class ReadResults(msgspec.Struct, frozen=True, kw_only=True):
    """Answer `request` with a `ResultsPage` read from the store.

    If the row's status is set when it is read, `upto` is the row's `released`, whatever the effect says: the submit may
    have ended in the meantime. The page holds the outcomes of `submit_group(run, submit_index,
    "train")` with `cursor <= seq <
    upto`, in that order, as many as fit; its cursor is one past its last `seq`. It has `done = submit_done(row)` only
    when it reaches `upto`.
    """

    request: RequestId
    run: str
    submit_index: int
    cursor: int
    upto: int | None
    """None for a finished run: then the row's `released`. `Refused("unknown_submit")` when the row is missing."""
    waits_for: Reason | None = None
    held_s: float = 0.0


class ReadEvaluation(msgspec.Struct, frozen=True, kw_only=True):
    """Answer `request` with an `EvaluationPage` of the outcomes of `evaluation_group(evaluation)` with `cursor <= seq <
    upto`, as many as fit. Only the page that reaches `upto` reports `finished`."""

    request: RequestId
    evaluation: str
    cursor: int
    upto: int
    total: int
    finished: bool
    waits_for: Reason | None = None


class ReadFinished(msgspec.Struct, frozen=True, kw_only=True):
    """Answer `request` with `RunProgress(phase="finished", …)` holding the run's `RunFinished`."""

    request: RequestId
    run: str


class Log(msgspec.Struct, frozen=True, kw_only=True):
    level: Literal["debug", "info", "warning", "error"]
    event: str
    fields: dict[str, object]
    stimulus_id: str = ""


ReadEffect = ReadResults | ReadEvaluation | ReadFinished

Effect = Persist | Reply | Refuse | ReadEffect | Log
