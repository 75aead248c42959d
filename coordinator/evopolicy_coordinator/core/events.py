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

from typing import Any, Literal

import msgspec

from evopolicy_common.messages.environment import Case, EnvironmentDescription, Split
from evopolicy_common.messages.episode import BlobRef, PolicyFailure, Record, ResourceLimits, Tier
from evopolicy_common.messages.operator import PlayedAs, RunSettings
from evopolicy_common.messages.worker import Fingerprint, HeldLease, JobResult

RequestId = int | str


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened outside."""

    stimulus_id: str = ""


# ---- operators ----


class RunCreated(Event, frozen=True, kw_only=True):
    """An operator asked for a run. All numbers are resolved; a known `key` gives the run it made before."""

    request: RequestId
    run: str
    """A fresh id, valid in a Zenoh key (`keys.valid_name`)."""
    key: str
    capability: str
    secret: bytes
    """32 fresh random bytes."""
    settings: RunSettings
    budget: int
    min_episodes_per_submit: int
    max_episodes_per_submit: int
    train: tuple[Case, ...]
    validation: tuple[Case, ...]
    heldout: tuple[Case, ...]
    split_hashes: dict[str, str]
    split_secret: bool
    allowed_imports: tuple[str, ...] = ()
    denied_imports: tuple[str, ...] = ()


class RunWaited(Event, frozen=True, kw_only=True):
    """An operator waits for a run to finish (long poll)."""

    request: RequestId
    run: str
    wait_s: float


class RunCancelled(Event, frozen=True, kw_only=True):
    """An operator ended a run."""

    request: RequestId
    run: str


class AgentGone(Event, frozen=True, kw_only=True):
    """An operator vouches that a run's agent is not alive any more."""

    request: RequestId
    run: str


class RunRepinned(Event, frozen=True, kw_only=True):
    """An operator lets a run go on with the workers of another fingerprint class, for the reason given."""

    request: RequestId
    run: str
    fingerprint_class: str
    reason: str


class EvaluationRequested(Event, frozen=True, kw_only=True):
    """An operator asked for cases to be played outside any run. A known `key` gives the evaluation it made before."""

    request: RequestId
    evaluation: str
    key: str
    env: str
    bundle: str | None
    split: Split
    case_ids: tuple[int, ...]
    cases: tuple[Case, ...]
    """In the order of `case_ids`."""
    secret: bytes
    record: Record
    tier: Tier
    limits: ResourceLimits = ResourceLimits()
    replays: tuple[BlobRef, ...] = ()
    """Recorded actions for each case, in place of a policy; empty for none."""
    as_in: PlayedAs | None = None


class EvaluationPolled(Event, frozen=True, kw_only=True):
    """An operator asked for outcomes of an evaluation (long poll)."""

    request: RequestId
    evaluation: str
    cursor: int
    wait_s: float


class WorkerStateSet(Event, frozen=True, kw_only=True):
    """An operator drained or paused a worker, or took it back."""

    request: RequestId
    worker: str
    state: Literal["active", "paused", "draining"]


# ---- gateways ----


class RunOpened(Event, frozen=True, kw_only=True):
    """A run's gateway started and asks what the run is."""

    request: RequestId
    run: str
    asks_permit: bool = False
    """It asks for a permit before its agent starts; else its agent may be anywhere already."""


class PermitRequested(Event, frozen=True, kw_only=True):
    """A gateway asked that its agent may be alive on a kernel (long poll)."""

    request: RequestId
    run: str
    boot_id: str
    machine_id: str = ""
    host: str = ""
    wait_s: float = 0.0


class StateRequested(Event, frozen=True, kw_only=True):
    """A gateway asked how its run stands."""

    request: RequestId
    run: str


class SubmitRequested(Event, frozen=True, kw_only=True):
    """A gateway asked for an evaluation. The shell has seen to it that the bundle's blob is stored."""

    request: RequestId
    run: str
    key: str
    env_instances: tuple[int, ...]
    bundle: str | None
    bundle_error: PolicyFailure | None = None


class ResultsRequested(Event, frozen=True, kw_only=True):
    """A gateway asked for a submit's outcomes from a cursor on (long poll)."""

    request: RequestId
    run: str
    submit_index: int
    cursor: int
    wait_s: float


class RunClosed(Event, frozen=True, kw_only=True):
    """A gateway said that its agent is gone: no more submits, finalisation may begin."""

    request: RequestId
    run: str
    reason: str
    agent: dict[str, Any] = {}


# ---- workers ----


class WorkerRegistered(Event, frozen=True, kw_only=True):
    """A worker started, or found its session unknown."""

    request: RequestId
    worker: str
    session: str
    """A fresh id made by the shell; what the worker's later requests carry."""
    slots: int
    tiers: tuple[Tier, ...]
    environments: tuple[EnvironmentDescription, ...]
    fingerprint: Fingerprint
    host: str = ""
    machine: str = ""
    """Whose credentials it joined with; empty for those that the state folder hands out."""
    boot_id: str = ""
    machine_id: str = ""


class LeaseRequested(Event, frozen=True, kw_only=True):
    """A worker asked for work (long poll)."""

    request: RequestId
    worker: str
    session: str
    n: int
    wait_s: float
    waited_s: float = 0.0
    """How long it lay unread: the loop stood still."""
    warm_bundles: tuple[str, ...] = ()
    warm_environments: tuple[str, ...] = ()
    serial: int = 0
    """See `messages.worker.LeaseRequest`."""


class HeartbeatReceived(Event, frozen=True, kw_only=True):
    """A worker told which leases it holds."""

    request: RequestId
    worker: str
    session: str
    held: tuple[HeldLease, ...]
    wait_s: float = 0.0
    """How long the answer may be held back; it comes at once when there is a lease to stop."""
    settled: int = 0
    """See `messages.worker.Heartbeat`."""


class ResultsHandedIn(Event, frozen=True, kw_only=True):
    """A worker handed in what came of its leases."""

    request: RequestId
    worker: str
    session: str
    results: tuple[JobResult, ...]


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
    """What the player handed in is no recording; else the coordinator's own store is to blame."""


class AuditCompared(Event, frozen=True, kw_only=True):
    """A `CompareAudit` was carried out."""

    run: str
    audit: str
    replay: int
    """Which replay was compared, from 1."""
    with_player: str | None
    """Where it parts from what the player handed in; None when they are the same."""
    with_first: str | None = None
    """Where it parts from the first replay; None when they are the same, or it is the first."""
    error: str = ""
    """Why they could not be compared, through no worker's fault."""


AuditEvent = AuditPrepared | AuditCompared


# ---- transport ----


class RequestAbandoned(Event, frozen=True, kw_only=True):
    """The asker of a long poll is gone: nothing need be answered. Optional: polls end by themselves."""

    request: RequestId


AnyEvent = (
    RunCreated
    | RunWaited
    | RunCancelled
    | RunRepinned
    | AgentGone
    | EvaluationRequested
    | EvaluationPolled
    | WorkerStateSet
    | RunOpened
    | PermitRequested
    | StateRequested
    | SubmitRequested
    | ResultsRequested
    | RunClosed
    | WorkerRegistered
    | LeaseRequested
    | HeartbeatReceived
    | ResultsHandedIn
    | LivenessLost
    | AuditEvent
    | RequestAbandoned
)
