"""What has happened: everything that a core is told, in the past tense.

Rules that this module owns:
- The shell has checked every token before it raises an event: join token, operator's token, a run's capability.
  Worker sessions are checked by the core, which knows when they end.
- Randomness comes in through events (`secret`, `capability`, `session`, ids); the core makes none of its own.
- `request` is the shell's opaque handle of the query that waits for an answer. Every event that has one is answered by
  exactly one effect with that handle (`Reply`, `ReadResults`, `ReadEvaluation` or `ReadFinished`): at once or, for long
  polls, later.
- `stimulus_id` names the event in every effect and log line that follows from it.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import msgspec

from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.operator import CreateRun, Disclose, Evaluate
from evopolicy_common.messages.worker import Message, Register
from evopolicy_coordinator.core.records import EvaluationRow, RunRow

RequestId = int | str
M_co = TypeVar("M_co", bound=Message, covariant=True)


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened outside."""

    stimulus_id: str = ""


class Asked(Event, Generic[M_co], frozen=True, kw_only=True):
    """Somebody asked something: the message itself, with waits and cursors made finite."""

    request: RequestId
    message: M_co
    waited_s: float = 0.0
    """How long it lay unread: the loop stood still."""


class RunCreated(Asked[CreateRun], frozen=True, kw_only=True):
    """An operator asked for a run; a known `key` gives the run it made before."""

    row: RunRow
    """All but when, in which event, and what of it is audited. The id is fresh, and valid in a Zenoh key (`keys.valid_name`)."""


class EvaluationRequested(Asked[Evaluate], frozen=True, kw_only=True):
    """An operator asked for cases to be played outside any run. A known `key` gives the evaluation it made before."""

    row: EvaluationRow
    """All but when and in which event."""


class DisclosureAsked(Asked[Disclose], frozen=True, kw_only=True):
    """An operator wants the cases of finished runs declared public."""

    epochs: tuple[str, ...]
    """Of the runs, each once."""


class WorkerRegistered(Asked[Register], frozen=True, kw_only=True):
    """A worker started, or found its session unknown."""

    session: str
    """A fresh id made by the shell; what the worker's later requests carry."""
    machine: str = ""
    """Whose credentials it joined with; empty for those that the state folder hands out."""
    refused_environments: dict[str, str] = {}
    """Why what it announced of them is not listened to; they are not in the message any more."""


class LivenessLost(Event, frozen=True, kw_only=True):
    """A worker's liveliness token went: a hint to look at its leases, no proof."""

    worker: str


# ---- audits ----


class AuditPrepared(Event, frozen=True, kw_only=True):
    """A `PrepareAudit` was carried out."""

    run: str
    audit: str
    actions: BlobRef | None
    """By its digest; None when there are none to be had."""
    error: str = ""
    """Why there are none."""
    at_fault: bool = False
    """What the player reported is no recording; else the coordinator's own store is to blame."""


class AuditCompared(Event, frozen=True, kw_only=True):
    """A `CompareAudit` was carried out."""

    run: str
    audit: str
    replay: int
    """Which replay was compared, from 1."""
    with_player: str | None
    """Where it parts from what the player reported; None when they are the same."""
    with_first: str | None = None
    """Where it parts from the first replay; None when they are the same, or it is the first."""
    error: str = ""
    """Why they could not be compared, through no worker's fault."""


AuditEvent = AuditPrepared | AuditCompared

AnyEvent = Asked[Any] | LivenessLost | AuditEvent
