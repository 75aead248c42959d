"""The status of a cluster, as operators get it: workers, unfinished runs, waiting jobs, the disk."""

from __future__ import annotations

from typing import Literal

import msgspec
from msgspec.structs import replace

from evopolicy_common.messages.bounds import Int, Many, Named, Number, Text, Word
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.worker import Message


class FromOperator(Message, frozen=True, kw_only=True):
    """A request of an operator."""

    token: Word = ""
    """The operators' token, which `OperatorClient` fills in."""


class StatusRequest(FromOperator, frozen=True, kw_only=True, tag="status"):
    """Requests the cluster's status."""

    max_age_s: Number = 0.0
    """A reply that the coordinator made at most this many seconds ago will do: any number of watchers cost one."""


class WorkerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One worker that is connected, or recently was."""

    worker: Word
    host: Word
    slots: Int
    state: Literal["active", "paused", "draining", "lost"]
    tiers: Many[Tier]
    environments: Many[Text]
    fingerprint: Text
    """Short class of the whole worker's fingerprint: workers with equal classes may share any run."""
    versions: Named[Text]
    """The components of the class: `evopolicy-worker`, `python`, the environments' packages, `cpu`."""
    held: Int
    running: Int
    last_seen_s: Number
    """Seconds since its last heartbeat."""
    refused: Named[Text] = {}
    """Run id to the reason why this worker gets no work of that run."""
    boot_id: Word = ""
    hidden_bar: Text = ""
    """Why it plays no hidden episodes now; empty when it may."""
    classes: Named[Word] = {}
    """Environment to its fingerprint class on this worker: only workers of one class share a run of it."""
    playing: Named[Int] = {}
    """Episode jobs that it plays now, by run or evaluation."""
    installation: Word = ""
    """Its Python installation, as in `versions.installations` of `run.json`."""
    missing_tiers: Named[Text] = {}
    """Sandbox tiers that should work there and do not, with the reasons."""
    failed_environments: Named[Text] = {}
    """Environments that it should offer and that could not be described or failed their try-out, with the reasons."""
    like: Word = ""
    """In a message: the worker that has the fields `_SHARED` in place of this one."""


_SHARED = ("tiers", "environments", "fingerprint", "versions", "refused", "classes")
"""Fields that workers of one installation share: most of a status, if there are thousands."""
_LEFT_OUT = {"tiers": (), "environments": (), "fingerprint": "", "versions": {}, "refused": {}, "classes": {}}


class RetriedJobs(msgspec.Struct, frozen=True, kw_only=True):
    """Jobs of a run that are played again after an infrastructure failure."""

    at: Number
    """Unix time, seconds."""
    worker: Word
    failure: Word
    """`worker_lost`, `failed`, `overdue`, or `unlisted` (the lease never arrived)."""
    jobs: Int = 1


ABANDONED_S = 3600.0
"""A gateway that is connected asks for its run every few seconds."""


class RunStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One unfinished run."""

    run: Word
    entry: Word
    env: Word
    phase: Text
    budget: Int
    remaining_budget: Int
    n_submits: Int
    queued: Int
    running: Int
    done: Int
    """Finished episode jobs, train and hidden together."""
    waits_for: Text = ""
    agent_host: Word = ""
    """Place of its agent: a host's name, a boot id, or `everywhere`; empty: nowhere."""
    exp_id: Word = ""
    repeat: Int = 0
    best_mean: Number | None = None
    """Highest visible mean return of its ok submits so far."""
    created_at: Number = 0.0
    """Unix time, seconds."""
    retries: Many[RetriedJobs] = ()
    """The last ones since the coordinator started, oldest first."""
    silent_s: Number = 0.0
    """Seconds for which an open run has had no gateway, as far as this coordinator has seen."""
    origin: Word = ""
    """The run that it plays again or starts from; empty: none."""

    @property
    def abandoned(self) -> bool:
        """Whether nobody seems to play it."""
        return self.silent_s > ABANDONED_S


class QueuedJobs(msgspec.Struct, frozen=True, kw_only=True):
    """The unfinished jobs of one priority and environment."""

    priority: Word
    """`train`, `reference` or `hidden`."""
    env: Word
    runs: Int
    """Number of runs and evaluations."""
    waiting: Int
    leased: Int
    waits_for: Named[Int] = {}
    """Reason why none of a group's jobs is leased, to the number of such groups."""


class DiskUse(msgspec.Struct, frozen=True, kw_only=True):
    """The coordinator's disk, bytes."""

    database: Int
    """The database files of the state folder."""
    free: Int
    total: Int


class StatusReply(Message, frozen=True, kw_only=True, tag="status_reply"):
    """The reply to `StatusRequest`."""

    cluster: Word
    version: Word
    uptime_s: Number
    episodes_done: Int
    episodes_per_s: Number
    """Over the last minute."""
    workers: Many[WorkerStatus]
    runs: Many[RunStatus]
    stalls: Many[Text] = ()
    """Items that have waited too long, with the reasons."""
    queue: Many[QueuedJobs] = ()
    """Highest priority first."""
    disk: DiskUse | None = None
    """None until it is known."""
    cost_s: Number = 0.0
    """CPU seconds that the coordinator spent on its previous status reply; 0.0 before the first."""
    trouble: Text = ""
    """Why the coordinator accepts no changes; the rest is as of then. Empty: it accepts them."""
    host: Word = ""
    """The machine of the coordinator; of several on one database, the leader's."""
    store_latency_s: Number | None = None
    """How long the database took to confirm the lead; None where the rows are in a file."""
    standbys: Many[Word] = ()
    """The machines whose coordinators wait for the lead."""


def folded(reply: StatusReply) -> StatusReply:
    """The reply as it is sent, in which alike workers name the first of them. `unfolded` is the reverse."""
    firsts: dict[tuple[object, ...], WorkerStatus] = {}
    workers = []
    for worker in reply.workers:
        first = firsts.setdefault((worker.fingerprint, worker.tiers, worker.environments), worker)
        alike = first is not worker and all(getattr(first, each) == getattr(worker, each) for each in _SHARED)
        workers.append(replace(worker, like=first.worker, **_LEFT_OUT) if alike else worker)
    return replace(reply, workers=tuple(workers))


def unfolded(reply: StatusReply) -> StatusReply:
    known = {worker.worker: {each: getattr(worker, each) for each in _SHARED} for worker in reply.workers}
    workers = tuple(
        replace(worker, like="", **known[worker.like]) if worker.like in known else worker
        for worker in reply.workers
    )
    return replace(reply, workers=workers)
