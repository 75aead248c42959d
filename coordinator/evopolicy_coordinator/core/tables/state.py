"""All state of a core: tables of open work and indices into them, without rules. `machine.load` fills it;
the rules change it."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.gateway import RunState
from evopolicy_coordinator.core.contract.records import (
    BegunRow,
    JournalRow,
    KernelRow,
    OutcomeHead,
    PermitRow,
)
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.structures import pop_entry
from evopolicy_coordinator.core.structures.timers import Polls, Timers
from evopolicy_coordinator.core.tables.model import (
    EVERYWHERE,
    RANKS,
    Ask,
    CaseKey,
    CaseSet,
    Evaluation,
    Flow,
    JobGroup,
    JobState,
    Kernel,
    Lane,
    LaneKey,
    Occupancy,
    OutOfService,
    Profile,
    ProfileKey,
    Run,
    Worker,
)

ATTEMPTS_PER_INCARNATION = 1_000_000
_RATE_S = 60


@dataclass(slots=True)
class Loading:
    """State that exists only while a core is loaded."""

    heads: dict[str, list[OutcomeHead]] = field(default_factory=dict)
    """Stored outcomes of each group."""
    begun: dict[tuple[str, int], BegunRow] = field(default_factory=dict)
    """Actions that unfinished jobs resume from, by group and first index."""
    reloaded: list[JobGroup] = field(default_factory=list)
    """Groups that may be complete already."""


class State:
    def __init__(self, settings: CoreSettings, incarnation: int, now: float) -> None:
        self.settings = settings
        self.incarnation = incarnation
        self.first_attempt = (incarnation - 1) * ATTEMPTS_PER_INCARNATION
        """Attempts up to this number were granted by earlier incarnations."""
        self.timers = Timers()
        self.polls = Polls(self.timers, settings.max_wait_s)
        self.rate = Rate()
        self.loading: Loading | None = None
        self.hold_until = now + settings.lease_ttl_s
        """No lease expires before this time."""
        self.stalled_at = now
        """When the loop last resumed after it was blocked for long, or started."""

        # Runs and evaluations.
        self.runs: dict[str, Run] = {}
        """The unfinished ones."""
        self.run_keys: dict[str, str] = {}
        self.capabilities: dict[str, str] = {}
        """Of all runs, finished ones too."""
        self.finished: dict[str, RunState] = {}
        """The state that a gateway of a finished run is still sent."""
        self.evaluations: dict[str, Evaluation] = {}
        self.evaluation_keys: dict[str, str] = {}
        self.ended_evaluations: dict[str, int] = {}
        """Number of stored outcomes of each finished evaluation."""

        # The journal.
        self.journal: JournalRow | None = None
        """Its last entry; None while it is empty."""
        self.revealed: set[str] = set()
        """Epochs that are no longer secret."""

        # Groups and jobs.
        self.groups: dict[str, JobGroup] = {}
        self.jobs: dict[str, JobState] = {}
        self.adopting: dict[JobState, None] = {}
        """Jobs that may have been running since before the core was loaded."""
        self.held: dict[JobGroup, None] = {}
        """Submits that hidden jobs keep from all workers."""

        # Queues, and the profiles that serve them.
        self.lanes: dict[LaneKey, Lane] = {}
        self.profiles: dict[ProfileKey, Profile] = {}
        self.unpinned: dict[str, Flow] = {}
        self.n_flows = 0
        self.suspects: dict[JobState, None] = {}
        """Waiting jobs that are to run alone; few."""
        self.clock = [0.0] * len(RANKS)
        """Virtual time of each rank, slot seconds."""

        # Workers and leases.
        self.workers: dict[str, Worker] = {}
        self.machines: dict[str, dict[str, Worker]] = {}
        """Workers by the machine whose credentials they joined with."""
        self.awaited: dict[str, None] = {}
        """Undescribed environments that an operator requested."""
        self.sessions: dict[str, str] = {}
        self.out_of_service: dict[str, OutOfService] = {}
        """Names that an operator drained or paused; kept over restarts."""
        self.n_live = 0
        self.freed: dict[str, None] = {}
        """Workers that released a lease, or are no longer emptied: their waiting poll may be answerable now."""

        # Occupants of kernels.
        self.isolates = settings.hidden_isolation != "off"
        self.case_sets = CaseSets(strict=settings.hidden_isolation == "strict")
        self.everywhere = Kernel(EVERYWHERE)
        self.kernels: dict[str, Kernel] = {EVERYWHERE: self.everywhere}
        self.lingering: dict[str, dict[str, Occupancy]] = {}
        """Worker to its occupancies without a lease."""
        self.permits: dict[str, dict[Kernel, tuple[PermitRow, CaseSet]]] = {}
        """By run."""
        self.asks: dict[tuple[str, str], Ask] = {}
        """By run and boot id."""
        self.known_kernels: dict[str, KernelRow] = {}
        """By worker: as stored."""
        self.grantable = False
        """Whether a requested permit may have become possible in this step."""


class Rate:
    """Episodes done, in total and over the last minute: one count per second."""

    def __init__(self) -> None:
        self.total = 0
        self._seconds: deque[list[int]] = deque(maxlen=_RATE_S)

    def count(self, n: int, now: float) -> None:
        """Add `n` episodes, done at `now` (Unix seconds)."""
        self.total += n
        second = int(now)
        if self._seconds and self._seconds[-1][0] == second:
            self._seconds[-1][1] += n
        else:
            self._seconds.append([second, n])

    def per_s(self, now: float) -> float:
        """Episodes per second over the last minute."""
        return sum(n for second, n in self._seconds if second > now - _RATE_S) / _RATE_S


class CaseSets:
    """Finds related case sets: runs and evaluations that share a hidden case are related; with `strict` all are.

    A case set is known while a run, an evaluation, a permit or a lease belongs to it.
    """

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._known: dict[frozenset[CaseKey], CaseSet] = {}
        self._of_case: dict[CaseKey, dict[CaseSet, None]] = {}

    def join(self, env: str, cases: Iterable[Case]) -> CaseSet:
        """Returns the case set with these hidden cases and adds one to its users."""
        keys: frozenset[CaseKey] = frozenset()
        if not self._strict:
            keys = frozenset(
                (env, case.seed, json.dumps(case.options or None, sort_keys=True)) for case in cases
            )
        case_set = self._known.get(keys)
        if case_set is None:
            case_set = self._known[keys] = CaseSet(keys)
            case_set.relatives[case_set] = None
            for key in keys:
                there = self._of_case.setdefault(key, {})
                for other in there:
                    other.relatives[case_set] = None
                    case_set.relatives[other] = None
                there[case_set] = None
        case_set.users += 1
        return case_set

    def leave(self, case_set: CaseSet | None) -> None:
        """Remove one user of a case set; the last one removes the case set."""
        if case_set is None:
            return
        case_set.users -= 1
        if case_set.users:
            return
        del self._known[case_set.cases]
        for other in case_set.relatives:
            if other is not case_set:
                del other.relatives[case_set]
        for key in case_set.cases:
            pop_entry(self._of_case, key, case_set)
