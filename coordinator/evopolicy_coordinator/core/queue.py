"""Jobs that wait: in lanes by what a worker must be able to do, by priority, and by fair share between runs.

Rules that this module owns:
- A lane is (environment, sandbox tier, fingerprint class); a flow (a run, or an evaluation) is in one lane, or in none
  until it is pinned to a class.
- A lower priority number goes first, whatever the shares say.
- Between flows of one priority the one that got the least play time goes first (start-time fair queueing: each priority
  has a virtual clock; a flow that was idle starts at the clock, so idleness earns nothing). A worker that has the
  environment or the bundle warm may bend this by a bounded amount.
- Within a flow jobs go in order; what goes back after a mishap goes to the front.
- A job is not given to a worker it avoids, as long as its lane has another; never to one that its group bars.
- No operation looks at all jobs, all flows or all workers: flows are in heaps, removed entries are void by ticket.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.worker import Fingerprint

from .jobs import HIDDEN, HIDDEN_FIRST, N_PRIORITIES, RANKS, TRAIN, JobState

if TYPE_CHECKING:
    from .isolation import Family, Isolation, Reversal
    from .leases import Lease
    from .workers import Worker

T = TypeVar("T")

LaneKey = tuple[str, Tier, str]
"""Environment, sandbox tier, fingerprint class."""

SKIPS_MAX = 16
"""So many jobs of a flow that avoid the asking worker are looked past; more, and it waits."""

PASSES_MAX = 4
"""So many flows with nothing but such jobs are looked past."""

BARRED_MAX = 64
"""So many flows, or families of a lane, that the asking worker's kernel is barred to are looked past."""


_RANK = tuple(next(n for n, rank in enumerate(RANKS) if each in rank) for each in range(N_PRIORITIES))


@dataclass(slots=True, eq=False)
class Flow:
    """A run or an evaluation, as something that gets its share."""

    id: str
    env: str
    tier: Tier
    seq: int
    """Order of creation: breaks ties."""
    family: Family | None = None
    """Those that share its hidden cases; None where it has none."""
    closed: bool = False
    """No agent is at work for it: its hidden jobs wait for agents so long and no longer (`precedence`)."""
    pin: str | None = None
    """Fingerprint class; None until there is a worker for it."""
    description: EnvironmentDescription | None = None
    lane: Lane | None = None
    served: list[float] = field(default_factory=lambda: [0.0] * N_PRIORITIES)
    """Virtual time by priority: slot seconds handed out, counted from the clock it started at."""
    ready: tuple[deque[tuple[int, JobState]], ...] = field(
        default_factory=lambda: tuple(deque() for _ in range(N_PRIORITIES))
    )
    n_ready: list[int] = field(default_factory=lambda: [0] * N_PRIORITIES)
    in_heap: list[bool] = field(default_factory=lambda: [False] * N_PRIORITIES)
    n_leased: int = 0
    episode_s: float | None = None
    """Moving average of an episode's wall time; None before the first."""

    def cost_s(self, job: JobState) -> float:
        """What a job is expected to take, seconds of a slot; one second while nothing is known."""
        return (1.0 if self.episode_s is None else self.episode_s) * job.n

    def observe(self, wall_s: float) -> None:
        """Learn from an episode that took `wall_s` seconds."""
        self.episode_s = wall_s if self.episode_s is None else 0.8 * self.episode_s + 0.2 * wall_s


@dataclass(slots=True, eq=False)
class Lane:
    """Flows that the same workers can serve."""

    key: LaneKey
    heaps: tuple[list[tuple[float, int, Flow]], ...] = field(
        default_factory=lambda: tuple([] for _ in range(N_PRIORITIES))
    )
    n_ready: list[int] = field(default_factory=lambda: [0] * N_PRIORITIES)
    waiting: tuple[dict[Family | None, int], ...] = field(
        default_factory=lambda: tuple({} for _ in range(N_PRIORITIES))
    )
    """Jobs that wait, suspects too, by priority and family."""
    backlog: dict[Family, int] = field(default_factory=dict)
    """Hidden ones of them that are of closed flows."""
    kept_s: dict[Family, float] = field(default_factory=dict)
    """How long such jobs were kept from all kernels, since there were last none."""
    done_looks: dict[Family, int] = field(default_factory=dict)
    reversals: dict[Family, Reversal] = field(default_factory=dict)
    looked_at: float = 0.0
    profiles: dict[Profile, None] = field(default_factory=dict)
    stopping: int = 0
    """Hidden jobs that were stopped for this lane's sake and whose workers have not let go of them yet."""

    def count(self, priority: int, flow: Flow, n: int) -> None:
        """So many more jobs of a flow wait."""
        _add(self.waiting[priority], flow.family, n)
        if flow.closed and priority in HIDDEN and flow.family is not None:
            _add(self.backlog, flow.family, n)

    def waits_of(self, family: Family | None, *, train_too: bool) -> bool:
        """Whether hidden jobs wait of the family's relatives, or of any for None, and no train jobs that they leave the
        kernel to; with `train_too` whether any of both do."""
        if _of(self.waiting[TRAIN], family):
            return train_too
        return any(_of(self.waiting[priority], family) for priority in HIDDEN)

    def slots(self) -> int:
        """Slots of the workers that may serve it."""
        return sum(profile.slots for profile in self.profiles)

    def workers(self) -> int:
        """How many active workers may serve it."""
        return sum(len(profile.workers) for profile in self.profiles)

    def top(self, priority: int) -> Flow | None:
        """The flow to serve first; None when none waits."""
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
    """Workers that can do the same: environments, tiers and fingerprint class."""

    key: tuple[frozenset[str], frozenset[Tier], str]
    fingerprint: Fingerprint
    descriptions: dict[str, EnvironmentDescription]
    lanes: dict[LaneKey, Lane] = field(default_factory=dict)
    busy: dict[Lane, None] = field(default_factory=dict)
    """Its lanes in which something waits."""
    workers: dict[str, None] = field(default_factory=dict)
    """Those that are active: not lost, not draining."""
    slots: int = 0
    """Of the active ones."""
    parked: dict[str, None] = field(default_factory=dict)
    """Workers whose lease poll waits and could be answered now, oldest first."""
    warm: dict[str, dict[str, None]] = field(default_factory=dict)
    """Warm environment or bundle digest to those of `parked` that have it."""
    hidden: tuple[dict[Lease, None], ...] = field(
        default_factory=lambda: tuple({} for _ in range(N_PRIORITIES))
    )
    """Live leases of its workers that may be preempted, by priority, oldest first."""

    @property
    def fingerprint_class(self) -> str:
        """What runs are pinned to; see `Fingerprint`."""
        return self.key[2]

    def serves(self, key: LaneKey) -> bool:
        """Whether these workers may play what waits in a lane of that key."""
        env, tier, fingerprint_class = key
        return env in self.key[0] and tier in self.key[1] and fingerprint_class == self.key[2]


class Queue:
    """All lanes, the flows in them and the profiles that serve them."""

    def __init__(self, warm_bonus_s: float, isolation: Isolation) -> None:
        self._isolation = isolation
        self.lanes: dict[LaneKey, Lane] = {}
        self.profiles: dict[tuple[frozenset[str], frozenset[Tier], str], Profile] = {}
        self.suspects: dict[JobState, None] = {}
        """Waiting jobs that are to run alone; few."""
        self._clock = [0.0] * len(RANKS)
        self._warm_bonus_s = warm_bonus_s

    # ---- shape ----

    def add_profile(self, profile: Profile) -> None:
        """Let workers of a new profile serve the lanes that they can."""
        self.profiles[profile.key] = profile
        for lane in self.lanes.values():
            self._join(profile, lane)

    def place(self, flow: Flow, pin: str) -> Lane:
        """Put a flow into the lane of class `pin`, with whatever of it waits."""
        old = flow.lane
        suspects = [job.priority for job in self.suspects if job.group.flow is flow]
        if old is not None:
            for priority in range(N_PRIORITIES):
                old.n_ready[priority] -= flow.n_ready[priority]
                old.count(priority, flow, -flow.n_ready[priority] - suspects.count(priority))
            self._settle(old)
        key = (flow.env, flow.tier, pin)
        lane = self.lanes.get(key)
        if lane is None:
            lane = self.lanes[key] = Lane(key)
            for profile in self.profiles.values():
                self._join(profile, lane)
        flow.pin, flow.lane = pin, lane
        if flow.family is not None:
            flow.family.lanes[lane] = None
        for priority in range(N_PRIORITIES):
            flow.in_heap[priority] = False
            lane.count(priority, flow, flow.n_ready[priority] + suspects.count(priority))
            if flow.n_ready[priority]:
                lane.n_ready[priority] += flow.n_ready[priority]
                self._enter(flow, lane, priority)
        self._settle(lane)
        return lane

    def close(self, flow: Flow) -> None:
        """A flow's agent is gone."""
        waiting = {
            priority: flow.n_ready[priority]
            + sum(job.group.flow is flow and job.priority == priority for job in self.suspects)
            for priority in HIDDEN
        }
        flow.closed = True
        if flow.lane is not None and flow.family is not None:
            _add(flow.lane.backlog, flow.family, sum(waiting.values()))

    def drop(self, flow: Flow) -> None:
        """Forget a flow that has nothing waiting any more."""
        flow.lane = None

    def _join(self, profile: Profile, lane: Lane) -> None:
        if profile.serves(lane.key):
            profile.lanes[lane.key] = lane
            lane.profiles[profile] = None
            if any(lane.n_ready):
                profile.busy[lane] = None

    def _enter(self, flow: Flow, lane: Lane, priority: int) -> None:
        if not flow.in_heap[priority]:
            flow.in_heap[priority] = True
            heapq.heappush(lane.heaps[priority], (flow.served[priority], flow.seq, flow))

    def _settle(self, lane: Lane) -> None:
        """Let the profiles know whether anything waits in the lane."""
        if any(lane.n_ready):
            for profile in lane.profiles:
                profile.busy[lane] = None
        else:
            for profile in lane.profiles:
                profile.busy.pop(lane, None)

    # ---- jobs ----

    def push(self, job: JobState, *, front: bool = False) -> Lane | None:
        """Let a job wait; gives its lane, None while its flow is not pinned."""
        flow, priority = job.group.flow, job.priority
        job.ticket += 1
        job.queued = True
        if flow.lane is not None:
            flow.lane.count(priority, flow, 1)
        if job.alone:
            self.suspects[job] = None
            return flow.lane
        ready = flow.ready[priority]
        (ready.appendleft if front else ready.append)((job.ticket, job))
        if flow.n_ready[priority] == 0:
            flow.served[priority] = max(flow.served[priority], self._clock[_RANK[priority]])
        flow.n_ready[priority] += 1
        lane = flow.lane
        if lane is not None:
            lane.n_ready[priority] += 1
            self._enter(flow, lane, priority)
            if lane.n_ready[priority] == 1:
                self._settle(lane)
        return lane

    def withdraw(self, job: JobState) -> None:
        """Take a waiting job out, wherever it stands."""
        if not job.queued:
            return
        flow, priority = job.group.flow, job.priority
        job.queued = False
        job.ticket += 1
        if flow.lane is not None:
            flow.lane.count(priority, flow, -1)
        if job.alone:
            self.suspects.pop(job, None)
            return
        flow.n_ready[priority] -= 1
        if flow.n_ready[priority] == 0:
            flow.ready[priority].clear()
        lane = flow.lane
        if lane is not None:
            lane.n_ready[priority] -= 1
            if lane.n_ready[priority] == 0:
                self._settle(lane)

    def take(self, worker: Worker, warm: Collection[str], now: float) -> JobState | None:
        """The job that `worker` gets next, taken out of the queue; None when nothing here is for it."""
        for rank in _ranks(worker):
            passed: list[tuple[Flow, int]] = []
            barred = 0
            job: JobState | None = None
            while job is None and len(passed) - barred < PASSES_MAX and barred < BARRED_MAX:
                found = self._best(worker, rank, warm)
                if found is None or found[0].lane is None:
                    break
                flow, priority = found
                lane = found[0].lane
                if self._isolation.bar(priority, flow.family, worker):
                    barred += 1
                else:
                    job = self._first(flow, priority, worker, now, sole=lane.workers() <= 1)
                if job is None:
                    heapq.heappop(lane.heaps[priority])
                    flow.in_heap[priority] = False
                    passed.append(found)
            for flow, priority in passed:
                if flow.lane is not None:
                    self._enter(flow, flow.lane, priority)
            if job is not None:
                self._serve(job)
                return job
        return None

    def leading(self, worker: Worker) -> tuple[Flow, int] | None:
        """The flow that goes first of what the worker may be leased, and at which priority; None when nothing waits."""
        for rank in _ranks(worker):
            found = self._best(worker, rank, ())
            if found is not None:
                return found
        return None

    def may_serve(self, lane: Lane, worker: Worker) -> bool:
        """Whether anything that waits in the lane may be leased on the worker's kernel."""
        return any(
            lane.n_ready[priority] and self._open(lane, priority, worker) for priority in range(N_PRIORITIES)
        )

    def may_train(self, lane: Lane, worker: Worker) -> bool:
        """Whether train jobs that wait in the lane may be leased to the worker."""
        return self._open(lane, TRAIN, worker)

    def _open(self, lane: Lane, priority: int, worker: Worker) -> bool:
        """Whether some family that waits in the lane may be leased on the worker's kernel."""
        there, isolation = lane.waiting[priority], self._isolation
        if not there:
            return False
        if len(there) > BARRED_MAX or not isolation.concerns(priority, worker):
            return True
        return any(not isolation.bar(priority, family, worker) for family in there)

    def _serve(self, job: JobState) -> None:
        flow, priority = job.group.flow, job.priority
        self.withdraw(job)
        self._clock[_RANK[priority]] = max(self._clock[_RANK[priority]], flow.served[priority])
        flow.served[priority] += flow.cost_s(job)

    def _best(self, worker: Worker, rank: tuple[int, ...], warm: Collection[str]) -> tuple[Flow, int] | None:
        best: tuple[Flow, int] | None = None
        best_score = 0.0
        concerned = [priority for priority in rank if self._isolation.concerns(priority, worker)]
        for lane in worker.profile.busy:
            for priority in rank:
                heap = lane.heaps[priority]
                if not heap or not lane.n_ready[priority]:
                    continue
                if priority in concerned and not self._open(lane, priority, worker):
                    continue
                score, _, flow = heap[0]
                if flow.lane is not lane or not flow.n_ready[priority] or score != flow.served[priority]:
                    found = lane.top(priority)
                    if found is None:
                        continue
                    flow, score = found, found.served[priority]
                if warm and (flow.env in warm or (_next(flow, priority).group.template.bundle or "") in warm):
                    score -= self._warm_bonus_s
                if best is None or score < best_score or (score == best_score and flow.seq < best[0].seq):
                    best, best_score = (flow, priority), score
        return best

    @staticmethod
    def _first(flow: Flow, priority: int, worker: Worker, now: float, *, sole: bool) -> JobState | None:
        """The flow's first job that may go to `worker` and does not avoid it; void entries on the way are dropped."""
        ready = flow.ready[priority]
        skipped: list[tuple[int, JobState]] = []
        found: JobState | None = None
        while ready and len(skipped) < SKIPS_MAX:
            ticket, job = ready[0]
            if job.ticket != ticket:
                ready.popleft()
            elif (job.avoid == worker.name and now < job.avoid_until and not sole) or job.group.bars(worker):
                skipped.append(ready.popleft())
            else:
                found = job
                break
        ready.extendleft(reversed(skipped))
        return found

    def head(self, lane: Lane, priority: int) -> JobState | None:
        """What goes first in the lane at one priority, whoever asks; None when nothing waits."""
        flow = lane.top(priority) if lane.n_ready[priority] else None
        if flow is None:
            return None
        return _next(flow, priority)

    def avoided(self, lane: Lane, priority: int, now: float) -> str | None:
        """The worker that the lane's next job is kept from."""
        job = self.head(lane, priority)
        return job.avoid if job is not None and now < job.avoid_until and lane.workers() > 1 else None

    def next_bundle(self, lane: Lane) -> tuple[str | None, str] | None:
        """Bundle and environment of what goes next in the lane; None when nothing waits."""
        for priority in range(N_PRIORITIES):
            job = self.head(lane, priority)
            if job is not None:
                return job.group.template.bundle, job.group.template.env
        return None


def _ranks(worker: Worker) -> tuple[tuple[int, ...], ...]:
    return HIDDEN_FIRST if worker.kernel.reversals else RANKS


def _of(there: dict[Family | None, int], family: Family | None) -> bool:
    return bool(there) and (family is None or not family.relatives.keys().isdisjoint(there))


def _add(counts: dict[T, int], key: T, n: int) -> None:
    left = counts.get(key, 0) + n
    if left:
        counts[key] = left
    else:
        counts.pop(key, None)


def _next(flow: Flow, priority: int) -> JobState:
    """The first of a flow's ready jobs; there must be one. Void entries ahead of it are dropped."""
    ready = flow.ready[priority]
    while ready[0][1].ticket != ready[0][0]:
        ready.popleft()
    return ready[0][1]
