"""Events: all input of a core, in the past tense.

Rules that this module owns:
- The shell has checked every token before it raises an event: join token, operator's token, a run's capability. The
  core checks worker sessions, since it knows when they end.
- Randomness comes in through events (`secret`, `capability`, `session`, ids); the core generates none.
- `request` is the shell's opaque handle of the query that waits for a reply. Every event that has one is answered by
  exactly one effect with that handle (`Reply`, `Refuse`, `ReadResults`, `ReadEvaluation` or `ReadFinished`), at once
  or, for long polls, later.
- `stimulus_id` names the event in every row and log line that follows from it.
"""

from __future__ import annotations

from typing import Generic, TypeVar

import msgspec

from evopolicy_common.messages.operator import CreateRun, Disclose, Evaluate, Rescore
from evopolicy_common.messages.worker import Message, Register
from evopolicy_coordinator.core.contract.records import EvaluationRow, RunRow

RequestId = int | str
M_co = TypeVar("M_co", bound=Message, covariant=True)


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """An event outside the core."""

    stimulus_id: str = ""


class Requested(Event, Generic[M_co], frozen=True, kw_only=True):
    """A request arrived: the message itself, with waits and cursors made finite."""

    request: RequestId
    message: M_co
    waited_s: float = 0.0
    """Seconds for which the request lay unread because the loop was blocked."""


class RunRequested(Requested[CreateRun], frozen=True, kw_only=True):
    """An operator requested a run; a known `key` returns the existing run."""

    row: RunRow
    """Complete except for creation time and stimulus id. The id is fresh, and valid in a Zenoh key
    (`keys.valid_name`)."""


class EvaluationRequested(Requested[Evaluate | Rescore], frozen=True, kw_only=True):
    """An operator requested cases to be played outside any run; a known `key` returns the existing evaluation."""

    row: EvaluationRow
    """Complete except for creation time and stimulus id."""


class DisclosureRequested(Requested[Disclose], frozen=True, kw_only=True):
    """An operator requested that the cases of finished runs be declared public."""

    epochs: tuple[str, ...]
    """Epochs of the runs, each once."""


class WorkerRegistered(Requested[Register], frozen=True, kw_only=True):
    """A worker started, or found its session unknown."""

    session: str
    """A fresh id made by the shell; the worker's later requests carry it."""
    machine: str = ""
    """Machine whose credentials the worker joined with; empty for the state folder's own credentials."""
    refused_environments: dict[str, str] = {}
    """Refused environment to the reason. They are already removed from the message."""
    size: int = 0
    """Size of the description of its environments, bytes."""


class LivenessLost(Event, frozen=True, kw_only=True):
    """A worker's liveliness token disappeared: a hint to check its leases, not a proof."""

    worker: str


class DescriptionAwaited(Event, frozen=True, kw_only=True):
    """An operator requested an environment that workers offer and have yet to describe."""

    env: str


AnyEvent = Requested[Message] | LivenessLost | DescriptionAwaited
