"""What is to be done: everything that a core asks of its shell, in the imperative and in order.

Rules that this module owns:
- Effects are carried out in the order given, across events too. No effect is carried out before every `Persist` ahead of
  it is durable: a reply may tell of what it rests on. Several `Persist`s in a row, of one event or many, may share one
  transaction.
- A `Persist` that fails did not happen: the shell drops the core and every effect not yet carried out, loads a new core
  from the store, and lets the askers ask again.
- A `Reply` to an asker that is gone is dropped silently.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from evopolicy_common.messages.worker import Message
from evopolicy_common.wire.refusals import Refusal

from .events import RequestId
from .reasons import Reason
from .records import Row


class Persist(msgspec.Struct, frozen=True, kw_only=True):
    """Write the rows, in one transaction, durably (fsync), before anything that follows."""

    rows: tuple[Row, ...]
    stimulus_id: str = ""


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """Answer the query `request` with `message`."""

    request: RequestId
    message: Message
    waits_for: Reason | None = None
    """What the message says in words that somebody waits for; None for nothing."""
    stimulus_id: str = ""


class Refuse(msgspec.Struct, frozen=True, kw_only=True):
    """Answer the query `request` with `Refused`: the status, and the reason in words."""

    request: RequestId
    status: Refusal
    reason: Reason
    stimulus_id: str = ""


class ReadResults(msgspec.Struct, frozen=True, kw_only=True):
    """Answer `request` with a `ResultsPage` made from the store.

    When the row's status is set by the time it is read, `upto` is the row's `released`, whatever the effect says: the submit
    may have ended since. The page holds the outcomes of `train_group(run, submit_index)` with `cursor <= seq < upto`, in
    that order, as many as fit; its cursor is one past the last `seq` it holds. It has `done = submit_done(row)` only when
    it reaches `upto`.
    """

    request: RequestId
    run: str
    submit_index: int
    cursor: int
    upto: int | None
    """None for a run that is finished: then the row's `released`. `Refused("unknown_submit")` when there is no row."""
    waits_for: Reason | None = None
    held_s: float = 0.0
    stimulus_id: str = ""


class ReadEvaluation(msgspec.Struct, frozen=True, kw_only=True):
    """Answer `request` with an `EvaluationPage` of the outcomes of `evaluation_group(evaluation)` with
    `cursor <= seq < upto`, as many as fit; `finished` is told only on the page that reaches `upto`."""

    request: RequestId
    evaluation: str
    cursor: int
    upto: int
    total: int
    finished: bool
    waits_for: Reason | None = None
    stimulus_id: str = ""


class ReadFinished(msgspec.Struct, frozen=True, kw_only=True):
    """Answer `request` with `RunProgress(phase="finished", …)` holding the run's `FinishedRow.result`."""

    request: RequestId
    run: str
    stimulus_id: str = ""


class PrepareAudit(msgspec.Struct, frozen=True, kw_only=True):
    """Store the actions of the recording that outcome `index` of `group` names as a blob of its own, with nothing of what
    came of them, and raise `AuditPrepared`. In the background: nothing waits for it."""

    run: str
    audit: str
    group: str
    index: int
    stimulus_id: str = ""


class CompareAudit(msgspec.Struct, frozen=True, kw_only=True):
    """Compare the last of the outcomes at index 0 of `replays` with outcome `index` of `group`, and with the replay before
    it, bit for bit; raise `AuditCompared`. In the background."""

    run: str
    audit: str
    group: str
    index: int
    replays: tuple[str, ...]
    """Groups of one outcome each, one or two of them."""
    stimulus_id: str = ""


class Log(msgspec.Struct, frozen=True, kw_only=True):
    """Write a log line."""

    level: Literal["debug", "info", "warning", "error"]
    event: str
    fields: dict[str, Any]
    stimulus_id: str = ""


ReadEffect = ReadResults | ReadEvaluation | ReadFinished

AuditEffect = PrepareAudit | CompareAudit
"""Answered by an event, in time."""

Effect = Persist | Reply | Refuse | ReadEffect | AuditEffect | Log
