"""Jobs and the groups they come in: a submit's train episodes, a checkpoint's hidden ones, an evaluation's.

Rules that this module owns:
- A group is a list of episodes with indexes 0 … n − 1, cut into jobs; each index gets exactly one outcome.
- Outcomes are numbered in order of arrival (`seq`), without gaps.
- A job's content follows from its group and its position alone, so it need not be stored, and every attempt of it is the
  same job.
- Of a finished episode only its mark is kept, and only while the group is open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from evopolicy_common.messages.environment import Case, EnvironmentDescription, ObservationForm, PolicyScope
from evopolicy_common.messages.episode import (
    BlobRef,
    EpisodeOutcome,
    EpisodeSpec,
    FailureCategory,
    Job,
    Record,
    ResourceLimits,
    Tier,
)
from evopolicy_common.messages.gateway import VideoOption

from .records import OutcomeHead
from .seeds import policy_seed, reference_seed

if TYPE_CHECKING:
    from .leases import Lease
    from .queue import Flow
    from .workers import Worker

TRAIN, REFERENCE, HELDOUT, EARLY_VALIDATION, AUDIT, HIDDEN_AUDIT = range(6)
"""Priorities. Validation of a closed run and evaluations on hidden cases are `HELDOUT`'s, the random reference and other
evaluations `REFERENCE`'s, audits of what `HIDDEN` has `HIDDEN_AUDIT`'s."""
N_PRIORITIES = 6
RANKS = ((TRAIN,), (REFERENCE, HELDOUT), (EARLY_VALIDATION,), (AUDIT, HIDDEN_AUDIT))
"""Priorities that get fair shares of what those before them leave."""
HIDDEN_FIRST = ((HELDOUT,), (HIDDEN_AUDIT,), (TRAIN,), (REFERENCE,), (EARLY_VALIDATION,), (AUDIT,))
"""The same on a kernel that is turned over to hidden jobs (`precedence`)."""
HIDDEN = frozenset((HELDOUT, EARLY_VALIDATION, HIDDEN_AUDIT))
"""What a policy does, or did, on hidden cases: never on a kernel with an agent who could learn of it (`isolation`)."""

GroupKind = Literal["train", "validation", "heldout", "random", "evaluation", "audit"]


class Mark(NamedTuple):
    """What is kept of a finished episode while its group is open; equal for attempts that went the same way."""

    episode_return: float
    length: int
    failure: FailureCategory | None
    trajectory: str | None


def mark_of(outcome: EpisodeOutcome) -> Mark:
    """The mark of an outcome."""
    return Mark(
        outcome.episode_return,
        outcome.length,
        None if outcome.failure is None else outcome.failure.category,
        None if outcome.trajectory is None else outcome.trajectory.digest,
    )


@dataclass(slots=True, frozen=True, kw_only=True)
class Template:
    """What all jobs of a group have in common."""

    env: str
    bundle: str | None
    cases: tuple[Case, ...]
    """One for each index."""
    case_ids: tuple[int, ...]
    occurrences: tuple[int, ...]
    secret: bytes | None
    """What policy seeds are derived from; None for the random reference, whose actions follow from split and case."""
    split: str
    submit_index: int
    modulo: int
    """`episode_index` is the index modulo this."""
    per_job: int
    """Episodes in a job: 1, or with policy scope `submit` as many as share one Policy."""
    scope: PolicyScope
    env_meta: dict[str, Any]
    observations: ObservationForm
    record: Record
    video: VideoOption
    tier: Tier
    limits: ResourceLimits
    max_steps: int
    """As in `Job`."""
    replays: tuple[BlobRef, ...] = ()
    """Recorded actions for each index, in place of a policy; empty for none."""
    indexes: tuple[int, ...] = ()
    """For each index the one that it had in the list it was taken from; empty where it is the same."""


@dataclass(slots=True, eq=False)
class JobState:
    """An open job: where it stands."""

    job_id: str
    group: JobGroup
    first: int
    """Index of its first episode."""
    n: int
    """Episodes in it."""
    attempts: int
    """Number of the last attempt."""
    priority: int
    ticket: int = 0
    """Grows whenever it enters or leaves the queue: older queue entries are void."""
    queued: bool = False
    lease: Lease | None = None
    failures: int = 0
    """Infrastructure failures so far, in this incarnation."""
    last_failure: str = ""
    """What the last of them was and where, for an operator."""
    avoid: str | None = None
    """The worker that it last failed on: not given to it before `avoid_until`, while there is another."""
    avoid_until: float = 0.0
    alone: bool = False
    """It is a suspect: played with nothing beside it."""
    reserved: str | None = None
    """The worker that is being emptied for it (of a suspect)."""
    preemptions: int = 0
    since: float = 0.0
    """When it last began to wait."""
    held_attempts: set[int] = field(default_factory=set)
    """Attempts that this incarnation granted or adopted: none is adopted twice."""

    def names_blob(self, digest: str) -> bool:
        """Whether its worker needs the blob: the bundle, or a recording that it plays."""
        template = self.group.template
        recordings = template.replays[self.first : self.first + self.n]
        return digest == template.bundle or any(ref.digest == digest for ref in recordings)


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
    marks: dict[int, Mark] = field(default_factory=dict)
    jobs: dict[int, JobState] = field(default_factory=dict)
    """Open jobs, by their first index."""
    first_leased_at: float | None = None
    n_leased: int = 0
    held_since: float | None = None
    """Since when none of its episodes runs because hidden ones have its kernels; None while that is not so."""
    held_s: float = 0.0
    """How long that was before."""
    held_counted_s: float = 0.0
    """How much of it the submit's limit has been put off by."""
    closed: bool = False
    not_on: frozenset[str] = frozenset()
    """Workers that never get it."""
    not_of: frozenset[str] = frozenset()
    """Machines whose workers never get it."""
    numerics: str | None = None
    """What a worker's numbers must depend on (`Worker.numerics`); None for any."""

    def held(self, now: float) -> float:
        """Seconds for which none of its episodes ran because hidden ones had its kernels."""
        return self.held_s + (0.0 if self.held_since is None else max(0.0, now - self.held_since))

    @property
    def hidden(self) -> bool:
        """Whether it is hidden work."""
        return self.priority in HIDDEN

    def bars(self, worker: Worker) -> bool:
        """Whether a worker must not play it."""
        if worker.name in self.not_on or worker.machine in self.not_of:
            return True
        return self.numerics not in (None, worker.numerics)

    @property
    def n(self) -> int:
        """Episodes in all."""
        return len(self.template.cases)

    @property
    def done(self) -> int:
        """Episodes that have their outcome."""
        return len(self.marks)

    def returns(self) -> tuple[float, ...]:
        """Returns in order of index; every episode must be done."""
        return tuple(self.marks[index].episode_return for index in range(self.n))

    def mean_return(self) -> float:
        """Mean of the returns, summed exactly, so that order of arrival cannot show."""
        return math.fsum(self.returns()) / self.n

    def failed(self) -> int:
        """Episodes whose policy failed."""
        return sum(mark.failure is not None for mark in self.marks.values())

    def first_unfinished(self) -> int:
        """Smallest index without an outcome; `n` when all are done."""
        return next((index for index in range(self.n) if index not in self.marks), self.n)


def open_jobs(group: JobGroup, heads: list[OutcomeHead], attempts: int, now: float) -> list[JobState]:
    """Fill in `group.marks` from the stored heads and `group.jobs` with what is left to play, in order.

    A job of several episodes is stored whole or not at all.
    """
    for head in sorted(heads, key=lambda head: head.seq):
        group.marks[head.index] = Mark(head.episode_return, head.length, head.failure, head.trajectory)
    per_job = group.template.per_job
    for first in range(0, group.n, per_job):
        if first in group.marks:
            continue
        group.jobs[first] = JobState(
            job_id=f"{group.id}/{first}",
            group=group,
            first=first,
            n=min(per_job, group.n - first),
            attempts=attempts,
            priority=group.priority,
            since=now,
        )
    return list(group.jobs.values())


def _seed(template: Template, index: int) -> bytes:
    occurrence = template.occurrences[index]
    if template.secret is None:
        return reference_seed(template.split, template.cases[index], occurrence)
    case_id = template.case_ids[index]
    return policy_seed(template.secret, template.submit_index, template.split, case_id, occurrence)


def build(job: JobState, description: EnvironmentDescription) -> Job:
    """The job as a worker gets it."""
    template = job.group.template
    video = template.video == "all" or (template.video == "first" and job.first == 0)
    episodes = tuple(
        EpisodeSpec(
            index=index,
            episode_index=(template.indexes[index] if template.indexes else index) % template.modulo,
            case=template.cases[index],
            policy_seed=_seed(template, index),
            replay=template.replays[index] if template.replays else None,
        )
        for index in range(job.first, job.first + job.n)
    )
    return Job(
        job_id=job.job_id,
        env=template.env,
        bundle=template.bundle,
        episodes=episodes,
        policy_scope=template.scope,
        policy_every=template.modulo if template.scope == "submit" else 0,
        env_meta={
            **template.env_meta,
            "max_episode_steps": template.max_steps or description.max_episode_steps,
            "obs_storage": description.obs_storage,
        },
        observations=template.observations,
        record=template.record,
        video=video,
        video_episodes=1 if template.video == "first" else 0,
        tier=template.tier,
        limits=template.limits,
        max_steps=template.max_steps,
    )
