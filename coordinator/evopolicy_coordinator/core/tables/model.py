"""Plain records of open work: jobs and their groups, leases, workers, queues, kernels, runs. They contain no rules.

A method here returns what follows from its own record's fields, or keeps counts consistent; it decides nothing. All
records are in one module because they refer to each other, such as a lease to its job and a job to its lease.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple, TypeVar, get_args

from evopolicy_common.messages.environment import (
    Case,
    EnvironmentDescription,
    FailedEpisodes,
    ObservationForm,
    PolicyScope,
)
from evopolicy_common.messages.episode import (
    BlobRef,
    EpisodeOutcome,
    FailureCategory,
    Record,
    ResourceLimits,
    Tier,
)
from evopolicy_common.messages.gateway import SubmitStatus, VideoOption
from evopolicy_common.messages.status import RetriedJobs
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_common.records.aggregates import mean
from evopolicy_coordinator.core.contract.events import RequestId
from evopolicy_coordinator.core.contract.records import (
    EvaluationRow,
    PermitRow,
    RunRow,
    RunStateRow,
    SubmitRow,
)
from evopolicy_coordinator.core.structures import InvariantError
from evopolicy_coordinator.core.structures.ledger import Ledger

Table = Mapping[str, Collection[str]]
"""State to its allowed successors; a final state has none."""

RUN: Table = {
    "open": ("closed",),  # by its gateway, or by an operator's cancellation
    "closed": ("finished",),
    "finished": (),
}

SUBMIT: Table = {"open": get_args(SubmitStatus), **dict.fromkeys(get_args(SubmitStatus), ())}
"""An open submit gets any verdict, once; `open` is a status of None."""

Place = Literal["new", "queued", "leased", "backing_off", "adopting", "closed"]

JOB: Table = {
    "new": ("queued", "adopting"),  # adopting: it may have been running since before the core was loaded
    "queued": ("leased", "closed"),
    "leased": ("queued", "backing_off", "closed"),
    "backing_off": ("queued", "leased", "closed"),  # leased: adopted from its worker's heartbeat
    "adopting": ("queued", "leased", "closed"),
    "closed": (),
}


def check(table: Table, key: str, before: str, after: str) -> None:
    """Raises InvariantError when `after` may not follow `before`. `key` names the changed record in the error."""
    if after not in table[before]:
        raise InvariantError(f"{key}: {after} cannot follow {before}")


T = TypeVar("T")


# ---- jobs ----


TRAIN, REFERENCE, HIDDEN = range(3)
"""Priorities. `HIDDEN`: a policy's present or recorded actions on hidden cases, never played on a kernel with an agent
that could learn of them (`isolation`). `REFERENCE`: the random reference and other evaluations."""
N_PRIORITIES = 3
PRIORITY_NAMES = ("train", "reference", "hidden")
"""As `QueuedJobs.priority`."""
RANKS = ((TRAIN,), (REFERENCE, HIDDEN))
"""Each rank of priorities gets fair shares of what the ranks before it leave."""
HIDDEN_FIRST = ((HIDDEN,), (TRAIN,), (REFERENCE,))
"""The same on a kernel that is reserved for hidden jobs (`agents.precedence`)."""


def by_priority(make: Callable[[], T]) -> list[T]:
    return [make() for _ in range(N_PRIORITIES)]


GroupKind = Literal["train", "validation", "heldout", "random", "evaluation"]


class OutcomeDigest(NamedTuple):
    """The part of a finished episode that is kept while its group is open; equal for attempts with equal results."""

    episode_return: float
    length: int
    failure: FailureCategory | None
    trajectory: str | None


def outcome_digest(outcome: EpisodeOutcome) -> OutcomeDigest:
    return OutcomeDigest(
        outcome.episode_return,
        outcome.length,
        None if outcome.failure is None else outcome.failure.category,
        None if outcome.trajectory is None else outcome.trajectory.digest,
    )


@dataclass(slots=True, frozen=True, kw_only=True)
class Template:
    """The parameters that all jobs of a group share."""

    env: str
    bundle: str | None
    cases: tuple[Case, ...]
    case_ids: tuple[int, ...]
    occurrences: tuple[int, ...]
    secret: bytes | None
    """Key of the policy seeds; None for the random reference, whose actions follow from split and case."""
    split: str
    submit_index: int
    modulo: int
    """`episode_index` is the index modulo this."""
    scope: PolicyScope
    env_meta: dict[str, object]
    observations: ObservationForm
    record: Record
    video: VideoOption
    tier: Tier
    limits: ResourceLimits
    max_steps: int
    """As in `Job`."""
    failed_episodes: FailedEpisodes = "play-on"
    published: bool = False
    replays: tuple[BlobRef, ...] = ()
    """Recorded actions for each index, in place of a policy; empty for none."""
    indexes: tuple[int, ...] = ()
    """For each index, the index in the list that the case was taken from; empty where they are equal."""


@dataclass(slots=True, eq=False)
class EnvironmentFaults:
    """Attempts at a job that its environment has ended, in this incarnation."""

    n: int = 0
    since: float = 0.0
    on: set[str] = field(default_factory=set)
    """Machines."""


@dataclass(slots=True, eq=False)
class JobState:
    """An open job and its place."""

    job_id: str
    group: JobGroup
    first: int
    """Index of its first episode."""
    n: int
    """Number of its episodes."""
    attempts: int
    priority: int
    generation: int = 0
    """Incremented whenever the job enters or leaves the queue; queue entries with an older generation are void."""
    place: Place = "new"
    """`JOB` lists the allowed successors."""
    lease: OpenLease | None = None
    failures: int = 0
    """Infrastructure failures so far, in this incarnation."""
    failures_counted: int = 0
    """Faults after which the submit's wall-clock limit has started again."""
    last_failure: str = ""
    faults: EnvironmentFaults = field(default_factory=EnvironmentFaults)
    avoid: str | None = None
    """The worker that it last failed on: not leased to it before `avoid_until`, if its lane has another one."""
    avoid_until: float = 0.0
    alone: bool = False
    """It is a suspect: played with no other job beside it."""
    reserved: str | None = None
    """The worker that is being emptied for it, if it is a suspect."""
    since: float = 0.0
    """When its present wait began."""
    held_attempts: set[int] = field(default_factory=set)
    """Attempts that this incarnation granted or adopted: none is adopted twice."""
    begun: BlobRef | None = None
    """Actions that its policy returned before the job was given back; the next attempt plays them
    first. None for none."""
    begun_attempt: int = 0
    """The attempt that reported them."""

    @property
    def queued(self) -> bool:
        return self.place == "queued"

    def move(self, place: Place) -> None:
        """Change its place; raises InvariantError when the transition is not allowed."""
        if place not in JOB[self.place]:
            check(JOB, self.job_id, self.place, place)
        self.place = place

    def names_blob(self, digest: str) -> bool:
        """Whether its worker needs the blob: the bundle, a recording to replay, or the actions to resume from."""
        template = self.group.template
        recordings = [self.begun, *template.replays[self.first : self.first + self.n]]
        return digest == template.bundle or any(
            ref is not None and ref.digest == digest for ref in recordings
        )


@dataclass(slots=True, eq=False)
class JobGroup:
    """A list of episodes that are played, stored and concluded together."""

    id: str
    kind: GroupKind
    run: str
    """Run or evaluation that it belongs to."""
    submit_index: int
    flow: Flow
    template: Template
    stimulus_id: str
    priority: int
    created_at: float
    digests: dict[int, OutcomeDigest] = field(default_factory=dict)
    solved: dict[int, bool] = field(default_factory=dict)
    """Index to whether the episode solved the task, of finished episodes whose environment reports it."""
    jobs: dict[int, JobState] = field(default_factory=dict)
    """Open jobs, by their first index."""
    first_leased_at: float | None = None
    n_leased: int = 0
    held_since: float | None = None
    """Since when none of its episodes runs because hidden jobs keep them from its kernels; None
    while it is not held."""
    held_s: float = 0.0
    """Seconds held before `held_since`."""
    held_counted_s: float = 0.0
    """Part of the held time by which the submit's limit has been extended."""
    closed: bool = False

    def held_until_s(self, now: float) -> float:
        """Seconds for which none of its episodes ran because hidden jobs occupied its kernels."""
        return self.held_s + (0.0 if self.held_since is None else max(0.0, now - self.held_since))

    @property
    def hidden(self) -> bool:
        return self.priority == HIDDEN

    @property
    def n(self) -> int:
        return len(self.template.cases)

    @property
    def done(self) -> int:
        """Episodes that have an outcome."""
        return len(self.digests)

    def returns(self) -> tuple[float, ...]:
        """Returns in order of index; every episode must be done."""
        return tuple(self.digests[index].episode_return for index in range(self.n))

    def successes(self) -> tuple[bool, ...]:
        """Whether each episode solved the task; empty unless all report it."""
        return tuple(self.solved[index] for index in range(self.n)) if len(self.solved) == self.n else ()

    def mean_return(self) -> float:
        return mean(self.returns())

    def failed(self) -> int:
        """Episodes in which the policy failed."""
        return sum(digest.failure is not None for digest in self.digests.values())

    def first_failed(self) -> tuple[int, FailureCategory] | None:
        """Smallest index whose policy failed, and how; None if there is none."""
        failed = (
            (index, digest.failure) for index, digest in self.digests.items() if digest.failure is not None
        )
        return min(failed, default=None)

    def first_unfinished(self) -> int:
        """Smallest index without an outcome; `n` when all are done."""
        return next((index for index in range(self.n) if index not in self.digests), self.n)


@dataclass(slots=True, eq=False)
class OpenLease:
    """The right to play one attempt of a job."""

    id: str
    job: JobState
    worker: str
    attempt: int
    granted_at: float
    renewed: float
    """When its holder last named it, or was granted it."""
    named: bool = False
    """Whether its holder ever named it: if not, it may never have arrived."""
    running: bool = False
    started_at: float | None = None
    """When a heartbeat first reported it as running."""
    episodes_done: int = 0
    steps: int = 0
    progress_at: float = 0.0
    live: bool = True
    """False once the lease was cancelled or has expired, or its job is done."""
    orphan_until: float | None = None
    """Its session ended; a heartbeat may claim it until then."""
    doubtful: bool = False
    """Its holder was silent for long, or this incarnation did not grant it: a limit verdict may be caused by the
    silence, and does not count."""
    occupancy: Occupancy | None = None
    """Its place on a kernel, if it is hidden or train, until its worker releases it."""


# ---- queues ----


LaneKey = tuple[str, Tier, str]
"""Environment, sandbox tier, fingerprint class."""

ProfileKey = tuple[frozenset[tuple[str, str]], frozenset[Tier]]
"""Environments, each with its fingerprint class; sandbox tiers."""


@dataclass(slots=True, eq=False)
class Flow:
    """A run or an evaluation as a unit of fair share."""

    id: str
    env: str
    tier: Tier
    of: Literal["run", "evaluation"]
    secret: bytes
    """Of the run or evaluation: part of its leases' names."""
    seq: int = 0
    """Order of creation: breaks ties."""
    case_set: CaseSet | None = None
    """Runs and evaluations with the same hidden cases; None if it has none."""
    n_hidden: int = 0
    """Its open groups of hidden jobs."""
    kept_s: float = 0.0
    """Seconds for which its hidden jobs were kept from all kernels (`agents.precedence`)."""
    definition: str = ""
    """First digits of the digest of the environment definition that it needs; empty: any."""
    pin: str | None = None
    """Fingerprint class; None until a worker offers one."""
    description: EnvironmentDescription | None = None
    lane: Lane | None = None
    served: list[float] = field(default_factory=partial(by_priority, float))
    """Virtual time by priority: slot seconds leased, counted from the clock's value when the flow became active."""
    ready: list[deque[tuple[int, JobState]]] = field(default_factory=partial(by_priority, deque))
    n_ready: list[int] = field(default_factory=partial(by_priority, int))
    in_heap: list[bool] = field(default_factory=partial(by_priority, bool))
    n_leased: int = 0
    episode_s: float | None = None
    """Moving average of an episode's wall time; None before the first."""

    def cost_s(self, job: JobState) -> float:
        """Expected play time of a job, slot seconds; one second an episode while no time is known."""
        return (1.0 if self.episode_s is None else self.episode_s) * job.n

    def observe(self, wall_s: float) -> None:
        """Update the average with an episode that took `wall_s` seconds."""
        self.episode_s = wall_s if self.episode_s is None else 0.8 * self.episode_s + 0.2 * wall_s


@dataclass(slots=True, eq=False)
class Lane:
    """Flows that the same workers can serve."""

    key: LaneKey
    n_flows: int = 0
    heaps: list[list[tuple[float, int, Flow]]] = field(default_factory=partial(by_priority, list))
    n_ready: list[int] = field(default_factory=partial(by_priority, int))
    waiting: list[dict[CaseSet | None, int]] = field(default_factory=partial(by_priority, dict))
    """Waiting jobs, suspects included, by priority and case set."""
    reservations: dict[CaseSet, Reservation] = field(default_factory=dict)
    checked_at: float = 0.0
    profiles: dict[Profile, None] = field(default_factory=dict)

    def count(self, priority: int, flow: Flow, n: int) -> None:
        """Add `n` to the waiting jobs of a flow."""
        add(self.waiting[priority], flow.case_set, n)

    def waits_of(self, case_set: CaseSet | None, *, train_too: bool) -> bool:
        """Whether related hidden jobs wait (of any case set for None) and no related train jobs that they leave the
        kernel to; with `train_too`, whether related jobs of either kind wait."""
        if _of(self.waiting[TRAIN], case_set):
            return train_too
        return _of(self.waiting[HIDDEN], case_set)

    def slots(self) -> int:
        """Slots of the active workers that may serve it."""
        return sum(profile.slots for profile in self.profiles)

    def workers(self) -> int:
        """Number of active workers that may serve it."""
        return sum(len(profile.workers) for profile in self.profiles)

    def top(self, priority: int) -> Flow | None:
        """The flow to serve next; None when no flow waits."""
        heap = self.heaps[priority]
        while heap:
            served, seq, flow = heap[0]
            if flow.lane is not self or flow.n_ready[priority] == 0:
                heapq.heappop(heap)
                if flow.lane is self or flow.lane is None:
                    flow.in_heap[priority] = False
            elif served < flow.served[priority]:
                heapq.heapreplace(heap, (flow.served[priority], seq, flow))
            else:
                return flow
        return None


@dataclass(slots=True, eq=False)
class Profile:
    """Workers with the same capabilities: environments of the same fingerprint classes, and tiers."""

    key: ProfileKey
    fingerprint: Fingerprint
    """Of the whole worker."""
    descriptions: dict[str, EnvironmentDescription]
    fingerprints: dict[str, Fingerprint]
    """Of each environment by itself."""
    classes: dict[str, str]
    """Environment to the class that its runs are pinned to; see `Fingerprint.class_name`."""
    size: int = 0
    """Size of the descriptions, bytes."""
    lanes: dict[LaneKey, Lane] = field(default_factory=dict)
    busy: dict[Lane, None] = field(default_factory=dict)
    """Its lanes with waiting jobs."""
    workers: dict[str, None] = field(default_factory=dict)
    """Active workers only: not paused, draining or lost."""
    slots: int = 0
    """Of the active workers."""
    parked: dict[str, None] = field(default_factory=dict)
    """Workers whose lease poll waits and could be answered now, oldest first."""
    warm: dict[str, dict[str, None]] = field(default_factory=dict)
    """Warm environment or bundle digest to the workers in `parked` that have it."""

    def offers(self, flow: Flow) -> bool:
        """Whether these workers have a flow's environment, its definition, and its sandbox tier."""
        if flow.env not in self.classes or flow.tier not in self.key[1]:
            return False
        return flow.definition in ("", self.fingerprints[flow.env].definition)

    def serves(self, key: LaneKey) -> bool:
        """Whether these workers may play the jobs of a lane with that key."""
        env, tier, fingerprint_class = key
        return env in self.classes and tier in self.key[1] and fingerprint_class == self.classes[env]


def _of(there: dict[CaseSet | None, int], case_set: CaseSet | None) -> bool:
    return bool(there) and (case_set is None or not case_set.relatives.keys().isdisjoint(there))


def add(counts: dict[T, int], key: T, n: int) -> None:
    total = counts.get(key, 0) + n
    if total:
        counts[key] = total
    else:
        counts.pop(key, None)


# ---- kernels ----


CaseKey = tuple[str, int, str]
"""Environment, seed, options."""

EVERYWHERE = ""
"""The kernel of a worker or agent without a known boot id: it may be any."""


@dataclass(slots=True, eq=False)
class CaseSet:
    """All runs and evaluations that have the same hidden cases."""

    cases: frozenset[CaseKey]
    relatives: dict[CaseSet, None] = field(default_factory=dict)
    """Case sets that share a case with it, itself included."""
    users: int = 0
    lanes: dict[Lane, None] = field(default_factory=dict)
    """Lanes in which its jobs wait, or have waited."""


@dataclass(slots=True, eq=False)
class Occupancy:
    """A hidden or train lease on the kernel of its worker, as long as it may be played there."""

    id: str
    worker: str
    kernel: Kernel
    machine: str
    """As `Worker.machine`, of its worker."""
    case_set: CaseSet | None
    """None: not known, so related to all."""
    hidden: bool
    lease: OpenLease | None
    """None once the coordinator has given it up, or if it never granted it."""
    serial: int = 0
    """Number of the poll that it was granted to; 0: it had arrived before the worker's first request."""
    until: float | None = None
    """The time at which the job has certainly ended after its lease did."""

    @property
    def key(self) -> str:
        """Several workers may hold one lease id after the lease ended, so the key includes the worker."""
        return f"{self.worker} {self.id}"


Occupancies = dict[CaseSet | None, dict[str, Occupancy]]


class Ask(NamedTuple):
    row: PermitRow
    case_set: CaseSet
    kernel: Kernel


class Reservation(NamedTuple):
    """A kernel is reserved for the hidden jobs of these flows."""

    kernel: Kernel
    lane: Lane
    case_set: CaseSet
    flows: dict[Flow, None]


@dataclass(slots=True, eq=False)
class Kernel:
    """The confirmed and possible occupants of one kernel."""

    boot_id: str
    workers: dict[str, None] = field(default_factory=dict)
    permits: dict[CaseSet | None, dict[str, PermitRow]] = field(default_factory=dict)
    """By run."""
    asks: dict[CaseSet | None, dict[str, Ask]] = field(default_factory=dict)
    hidden: Occupancies = field(default_factory=dict)
    train: Occupancies = field(default_factory=dict)
    reservations: dict[CaseSet | None, dict[str, Reservation]] = field(default_factory=dict)


# ---- workers ----


OutOfService = Literal["draining", "paused"]


class LeasePoll(NamedTuple):
    request: RequestId
    n: int
    warm: frozenset[str]
    until: float
    """When it is answered even without leases."""
    serial: int = 0
    """The worker's own number of the poll."""


@dataclass(slots=True, eq=False)
class Worker:
    name: str
    session: str
    slots: int
    host: str
    profile: Profile
    last_seen: float
    kernel: Kernel
    first_serial: int | None = None
    """Number of the session's first poll."""
    machine: str = ""
    """Machine whose credentials it joined with; empty for the state folder's own credentials."""
    cpu: str = ""
    """Its processor's features."""
    installation: str = ""
    missing_tiers: dict[str, str] = field(default_factory=dict)
    """Sandbox tiers that should work there and do not, with the reasons."""
    state: Literal["active", "paused", "draining", "lost"] = "active"
    leases: dict[str, OpenLease] = field(default_factory=dict)
    """By id, oldest first; also given-up ones until the worker no longer names them."""
    held: list[int] = field(default_factory=partial(by_priority, int))
    """Live leases by priority."""
    n_live: int = 0
    poll: LeasePoll | None = None
    polled_at: float | None = None
    """When it last polled; None for never."""
    beat: RequestId | None = None
    """A heartbeat whose reply is delayed."""
    doubted_at: float | None = None
    """When its liveliness token disappeared; None while it exists, or after a later request."""
    reserved: JobState | None = None
    """The suspect that it is being emptied for."""
    alone: OpenLease | None = None
    """The suspect that it plays, with no other job beside it."""
    failures: int = 0
    """Consecutive jobs that failed through its own fault."""
    benched_until: float = 0.0
    undescribed: frozenset[str] = frozenset()
    """Environments that it offers and describes only when a run waits for them."""
    failed_environments: dict[str, str] = field(default_factory=dict)
    """Environments that it should offer and that failed there, with the reasons."""
    told_size: int = 0
    """Characters of `undescribed` and `failed_environments`."""

    def running(self) -> list[OpenLease]:
        """Leases that it plays now: as its heartbeats reported, or, before a report, the oldest, one per slot."""
        reported = [lease for lease in self.leases.values() if lease.running]
        return reported or list(self.leases.values())[: self.slots]


# ---- runs ----


RETRIES_KEPT = 16


@dataclass(slots=True, eq=False)
class Run:
    row: RunRow
    state: RunStateRow
    ledger: Ledger
    flow: Flow
    submits: list[SubmitRow] = field(default_factory=list)
    keys: dict[str, int] = field(default_factory=dict)
    """Idempotency key to submit index."""
    open: int | None = None
    """The submit in flight."""
    hidden_failures: dict[str, int] = field(default_factory=dict)
    """Group id to number of hidden episodes in which the policy failed, of finished groups."""
    hidden_returns: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Held-out and random group id to returns, of finished groups."""
    hidden_successes: dict[str, tuple[bool, ...]] = field(default_factory=dict)
    """Held-out group id to whether each episode solved the task; empty where the environment does not report it."""
    rollout_s: float = 0.0
    queue_s: float = 0.0
    retries: deque[RetriedJobs] = field(default_factory=lambda: deque(maxlen=RETRIES_KEPT))
    """The last retries after infrastructure failures, for operators."""

    @property
    def id(self) -> str:
        return self.row.run

    @property
    def case_set(self) -> CaseSet:
        assert self.flow.case_set is not None
        return self.flow.case_set


@dataclass(slots=True, eq=False)
class Evaluation:
    row: EvaluationRow
    flow: Flow
