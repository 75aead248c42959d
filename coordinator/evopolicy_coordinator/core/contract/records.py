"""Stored records: the rows that `Persist` writes, and the snapshot that a core is loaded from.

Rules that this module owns:
- A row is written whole (insert or replace) under its key; a `Persist` is one transaction, all of its rows or none.
- Queues, leases, sessions and long polls are not stored: they are soft, and come back from the workers' heartbeats and
  the clients' retries. Jobs are not stored either: they follow from runs, submits and outcomes.
- The result of a finished job is in its `OutcomeRow` and nowhere else; a core keeps only heads, of open groups only.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from evopolicy_common.messages.environment import Case, EnvironmentDescription, Split
from evopolicy_common.messages.episode import (
    BlobRef,
    EpisodeOutcome,
    FailureCategory,
    PolicyFailure,
    Record,
    ResourceLimits,
    Tier,
)
from evopolicy_common.messages.gateway import SubmitAccepted, SubmitDone, SubmitStatus
from evopolicy_common.messages.operator import Committed, PlayedAs, RunFinished
from evopolicy_common.messages.run_settings import HiddenIsolation
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_common.records.journal import Opening

Phase = Literal["open", "closed", "finished"]


class RunRow(Opening, frozen=True, kw_only=True, tag="run"):
    """A run as it was created, with what its opening commits to; never changed. Key: `run`."""

    key: str
    """The operator's idempotency key; unique."""
    capability: str
    """Token of the run's gateway."""
    secret: bytes
    """32 random bytes that policy seeds are derived from; never leaves the coordinator."""
    split_hashes: dict[str, str]
    salt: bytes
    """32 random bytes; of the commitment."""
    created_at: float = 0.0
    """Unix time, seconds (so are all `*_at`)."""
    stimulus_id: str = ""
    related: tuple[Case, ...] = ()
    """Hidden cases of the runs that it starts from, as far as they are not its own."""


class RunStateRow(msgspec.Struct, frozen=True, kw_only=True, tag="run_state"):
    """The changing part of a run. Key: `run`."""

    run: str
    committed: Committed
    phase: Phase = "open"
    fingerprint_class: str | None = None
    """The class of workers that the run is pinned to; None until a worker offers its environment."""
    description: EnvironmentDescription | None = None
    """From the worker that it was first pinned by."""
    fingerprint: Fingerprint | None = None
    """That worker's."""
    overrides: tuple[str, ...] = ()
    """An operator's changes of the pin, in words, oldest first."""
    installations: tuple[str, ...] = ()
    """Of the workers that have played its episodes, in the order of their first ones."""
    closed_at: float | None = None
    close_reason: str = ""
    agent: dict[str, Any] = {}
    infrastructure_retries: int = 0
    nondeterministic_results: int = 0
    isolation: HiddenIsolation = "unknown"
    """Isolation that has held so far."""
    remaining_budget: int = 0
    """Once finished: train episodes that were not spent."""
    n_submits: int = 0
    """Once finished: number of accepted submits."""


class SubmitRow(msgspec.Struct, frozen=True, kw_only=True, tag="submit"):
    """An accepted submit. Key: `run`, `submit_index`; `run`, `key` is unique too."""

    run: str
    submit_index: int
    key: str
    env_instances: tuple[int, ...]
    bundle: str | None
    first_global_episode: int
    remaining_budget: int
    """After this submit."""
    accepted_at: float
    stimulus_id: str = ""
    status: SubmitStatus | None = None
    """None while it is open."""
    failure: PolicyFailure | None = None
    completed_at: float | None = None
    first_leased_at: float | None = None
    released: int = 0
    """Outcomes with `seq` below this may be shown to the gateway; final once `status` is set."""
    n_kept: int = 0
    mean_return: float | None = None
    """Visible mean return; None unless ok."""
    val_mean: float | None = None
    """Hidden validation mean; None until every validation case is done."""
    ineligible: bool = False
    """With `failed_episodes` = "end-submit", its policy failed in validation: it cannot be selected."""
    held_s: float = 0.0
    """Seconds for which none of its episodes ran because hidden jobs occupied the machines."""
    tree: str = ""
    """Digest of the workspace, as the gateway named it."""
    refunded: bool = False
    """The run was cancelled while this submit was open: it is not charged."""


class OutcomeRow(msgspec.Struct, frozen=True, kw_only=True, tag="outcome"):
    """The outcome of one episode. Key: `group`, `index`."""

    group: str
    """The list of cases that the episode belongs to; see `submit_group` and its siblings."""
    index: int
    """Position in that list: the request index of a train episode."""
    seq: int
    """Order of arrival in its group, from 0 without gaps."""
    outcome: EpisodeOutcome
    job_id: str
    attempt: int
    worker: str
    fingerprint_class: str
    at: float


class BegunRow(msgspec.Struct, frozen=True, kw_only=True, tag="begun"):
    """The actions that the policy of a job returned in an attempt that was given back; the next attempt plays them
    first. Key: `group`, `first`."""

    group: str
    first: int
    """Index of the job's first episode."""
    attempt: int
    begun: BlobRef | None
    """None once the job is done."""


class EvaluationRow(msgspec.Struct, frozen=True, kw_only=True, tag="evaluation"):
    """Cases to play outside any run. Key: `evaluation`; `key` is unique."""

    evaluation: str
    key: str
    env: str
    bundle: str | None
    split: Split
    case_ids: tuple[int, ...]
    """Ids in the split, as requested; `cases` in the same order."""
    cases: tuple[Case, ...]
    secret: bytes
    record: Record
    tier: Tier
    limits: ResourceLimits
    created_at: float = 0.0
    stimulus_id: str = ""
    fingerprint_class: str | None = None
    finished: bool = False
    error: str = ""
    """Why it ended early; empty when it ran to its end."""
    replays: tuple[BlobRef, ...] = ()
    as_in: PlayedAs | None = None
    max_steps: int = 0
    definition: str = ""
    related: tuple[Case, ...] = ()
    """Hidden cases that it does not play, but counts as sharing: those of the run whose checkpoint is re-scored."""


class WorkerRow(msgspec.Struct, frozen=True, kw_only=True, tag="worker"):
    """The state of a worker, set by an operator. Key: `worker`."""

    worker: str
    state: Literal["active", "paused", "draining"]


class PermitRow(msgspec.Struct, frozen=True, kw_only=True, tag="permit"):
    """A run's agent may be alive on a kernel. Key: `run`, `boot_id`."""

    run: str
    boot_id: str
    """Of the kernel; empty: it may be any."""
    host: str = ""
    """Its host name, for people."""
    granted_at: float = 0.0
    ended_at: float | None = None


class KernelRow(msgspec.Struct, frozen=True, kw_only=True, tag="kernel"):
    """The kernel of a worker when it last registered: after a restart it may still play there. Key: `worker`."""

    worker: str
    boot_id: str
    machine: str = ""
    """As `Worker.machine`."""


class JournalRow(msgspec.Struct, frozen=True, kw_only=True, tag="journal"):
    """An entry of the journal; never changed. Key: `seq`."""

    seq: int
    """From 0 without gaps."""
    head: str
    """Of the journal up to this entry; see `records.journal`."""
    entry: bytes
    reveals: str = ""
    """The epoch that is no longer secret from here on; empty for none."""


class DocumentRow(msgspec.Struct, frozen=True, kw_only=True, tag="document"):
    """A document whose hash is in an entry of the journal, as it was hashed. Key: `run`, `kind`."""

    run: str
    kind: Literal["opening", "result"]
    data: bytes


Row = (
    RunRow
    | RunStateRow
    | SubmitRow
    | OutcomeRow
    | BegunRow
    | EvaluationRow
    | RunFinished
    | WorkerRow
    | PermitRow
    | KernelRow
    | JournalRow
    | DocumentRow
)


class OutcomeHead(msgspec.Struct, frozen=True, kw_only=True):
    """The part of an outcome that a core needs while its group is open."""

    group: str
    index: int
    seq: int
    episode_return: float
    length: int
    failure: FailureCategory | None = None
    trajectory: str | None = None
    """Digest of the trajectory; None when there is none."""
    worker: str = ""
    """The player."""
    success: bool | None = None
    """As `EpisodeOutcome.success`."""


def head_of(row: OutcomeRow) -> OutcomeHead:
    """The part of `row` that a snapshot holds."""
    outcome = row.outcome
    return OutcomeHead(
        group=row.group,
        index=row.index,
        seq=row.seq,
        episode_return=outcome.episode_return,
        length=outcome.length,
        worker=row.worker,
        success=outcome.success,
        failure=None if outcome.failure is None else outcome.failure.category,
        trajectory=None if outcome.trajectory is None else outcome.trajectory.digest,
    )


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """All that a core is loaded from, read in one transaction.

    `runs` and `states` are complete (finished runs too: their keys and capabilities stay known). `submits`,
    `outcomes` and `begun` are needed only for runs whose phase is not `finished`, and the last two also for evaluations
    that are not finished; more does no harm. Order does not matter.
    """

    incarnation: int
    """How often a core was loaded from this store, this time included: incremented durably *before* loading."""
    runs: tuple[RunRow, ...] = ()
    states: tuple[RunStateRow, ...] = ()
    submits: tuple[SubmitRow, ...] = ()
    outcomes: tuple[OutcomeHead, ...] = ()
    begun: tuple[BegunRow, ...] = ()
    evaluations: tuple[EvaluationRow, ...] = ()
    workers: tuple[WorkerRow, ...] = ()
    permits: tuple[PermitRow, ...] = ()
    """Those that have not ended, of finished runs too."""
    kernels: tuple[KernelRow, ...] = ()
    journal: JournalRow | None = None
    """The last entry; None for an empty journal."""
    revealed: tuple[str, ...] = ()
    """Epochs that are no longer secret."""


def latest_time(snapshot: Snapshot) -> float:
    """The latest Unix time, seconds, in the runs, submits and evaluations of the snapshot; 0.0 for none."""
    times = [run.created_at for run in snapshot.runs] + [each.created_at for each in snapshot.evaluations]
    times += [row.closed_at or 0.0 for row in snapshot.states]
    for row in snapshot.submits:
        times += (row.accepted_at, row.first_leased_at or 0.0, row.completed_at or 0.0)
    return max(times, default=0.0)


def submit_accepted(row: SubmitRow) -> SubmitAccepted:
    """The acceptance of a submit, as its gateway receives it."""
    return SubmitAccepted(
        submit_index=row.submit_index,
        first_global_episode=row.first_global_episode,
        remaining_budget=row.remaining_budget,
    )


def submit_done(row: SubmitRow) -> SubmitDone | None:
    """The end of a submit as its gateway receives it; None while it is open."""
    if row.status is None or row.completed_at is None:
        return None
    n = len(row.env_instances)
    return SubmitDone(
        status=row.status,
        n_episodes=0 if row.refunded else n,
        env_instances=row.env_instances,
        first_global_episode=row.first_global_episode,
        remaining_budget=row.remaining_budget + (n if row.refunded else 0),
        started_at=row.accepted_at,
        completed_at=row.completed_at,
        failure=row.failure,
        n_kept=row.n_kept,
    )


def submit_group(run: str, submit_index: int, split: Split) -> str:
    """Group id of the episodes of a submit's bundle on a split; `ReadResults` reads outcomes with this
    `OutcomeRow.group`."""
    return f"{run}/s{submit_index}/{split}"


def random_group(run: str) -> str:
    """Group id of the random reference's episodes."""
    return f"{run}/random"


def evaluation_group(evaluation: str) -> str:
    """Group id of an evaluation's episodes; `ReadEvaluation` reads outcomes with this `OutcomeRow.group`."""
    return f"evaluation/{evaluation}"
