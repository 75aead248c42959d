"""Keeps hidden episodes and agents on different kernels, as a kernel's counters tell one what the other does.

Rules that this module owns:
- A kernel is a boot id; an unknown one counts as every kernel. Runs and evaluations are related when they share a hidden
  case, with `strict` all are.
- A permit is an agent's right to be alive on a kernel. It ends with its run's closing, `CANCELLED_S` after its cancelling,
  by an operator's word, or with another boot id of its machine; never by silence.
- A hidden job is leased on a known kernel only, and only while no related run has a permit there or asks for one, and no
  related train job is leased there; neither is granted while a related hidden job is there.
- A lease is on its kernel until its worker has let go of it: told so by a heartbeat that was sent after the lease had
  arrived or was lost, or by handing in. One whose worker fell silent stays for `CoreSettings.silent_bar_s`, within which
  the worker has stopped it by itself. After a start each worker that was known counts as playing anything.
- A permit that is asked for stops related hidden jobs, which are not blamed. When hidden jobs of closed runs or an
  operator's have been kept waiting for `CoreSettings.hidden_wait_s`, it is the other way round on one kernel, until they
  are done: no new related permits, and once no related permit is left there no related train jobs. Whoever has a permit
  there goes on, as it must be able to end.
- Nothing here is told to a gateway but that it waits for hidden cases.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

import msgspec

from evopolicy_common.messages import gateway
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.operator import ELSEWHERE, HiddenIsolation
from evopolicy_common.messages.worker import HeldLease
from evopolicy_common.wire.refusals import Refusal

from .jobs import EARLY_VALIDATION, HIDDEN, TRAIN, JobGroup, JobState
from .records import KernelRow, PermitRow, RunRow, RunStateRow
from .turn import Turn

if TYPE_CHECKING:
    from .leases import Lease
    from .machine import Core
    from .queue import Lane
    from .runs import Run
    from .settings import CoreSettings
    from .workers import Worker

T = TypeVar("T")

EVERYWHERE = ""
"""The kernel of whoever does not say: it may be any."""

CANCELLED_S = 30.0
"""After a run was cancelled its agent has so long to be ended."""

ASK_AGAIN_S = 10.0
"""A request for a permit that was answered with none is kept for so long, until it is sent again."""

SCORING = "hidden cases of another run are being scored"


CaseKey = tuple[str, int, str]


@dataclass(slots=True, eq=False)
class Family:
    """All runs and evaluations that have the same hidden cases."""

    cases: frozenset[CaseKey]
    relatives: dict[Family, None] = field(default_factory=dict)
    """Those that share a case with it, itself included."""
    users: int = 0
    hidden_on: dict[Kernel, int] = field(default_factory=dict)
    """Kernels to how many of its hidden jobs are there."""
    lanes: dict[Lane, None] = field(default_factory=dict)
    """Where its jobs wait, or have waited."""


class Families:
    """Finds relatives. A family is known while a run, an evaluation, a permit or a lease is of it."""

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._known: dict[frozenset[CaseKey], Family] = {}
        self._of_case: dict[CaseKey, dict[Family, None]] = {}

    def join(self, env: str, cases: Iterable[Case]) -> Family:
        """The family with these hidden cases, used once more."""
        keys: frozenset[CaseKey] = frozenset()
        if not self._strict:
            keys = frozenset(
                (env, case.seed, json.dumps(case.options or None, sort_keys=True)) for case in cases
            )
        family = self._known.get(keys)
        if family is None:
            family = self._known[keys] = Family(keys)
            family.relatives[family] = None
            for key in keys:
                there = self._of_case.setdefault(key, {})
                for other in there:
                    other.relatives[family] = None
                    family.relatives[other] = None
                there[family] = None
        family.users += 1
        return family

    def known(self) -> Iterable[Family]:
        """All that are in use."""
        return self._known.values()

    def leave(self, family: Family | None) -> None:
        """One use of a family is over."""
        if family is None:
            return
        family.users -= 1
        if family.users:
            return
        del self._known[family.cases]
        for other in family.relatives:
            if other is not family:
                del other.relatives[family]
        for key in family.cases:
            del self._of_case[key][family]
            if not self._of_case[key]:
                del self._of_case[key]


@dataclass(slots=True, eq=False)
class Stay:
    """A hidden or train lease on the kernel of its worker, as long as it may be played there."""

    id: str
    worker: str
    kernel: Kernel
    machine_id: str
    family: Family | None
    """None: not known, so related to all."""
    hidden: bool
    lease: Lease | None
    """None once the coordinator has given it up, or never granted it."""
    serial: int = 0
    """Number of the poll that it was granted to; 0: it had arrived before its worker was first heard."""
    until: float | None = None
    """When it has surely ended, once its lease was given up."""

    @property
    def key(self) -> str:
        """One lease may be in the hands of several workers, when it was given up."""
        return f"{self.worker} {self.id}"


Stays = dict[Family | None, dict[str, Stay]]


@dataclass(slots=True, eq=False)
class Ask:
    """A permit that is asked for."""

    row: PermitRow
    family: Family
    kernel: Kernel


@dataclass(slots=True, eq=False)
class Reversal:
    """Hidden jobs of a family go first on a kernel."""

    kernel: Kernel
    lane: Lane
    family: Family


@dataclass(slots=True, eq=False)
class Kernel:
    """What is, or may be, on one kernel."""

    boot_id: str
    workers: dict[str, None] = field(default_factory=dict)
    permits: dict[Family | None, dict[str, PermitRow]] = field(default_factory=dict)
    """By run."""
    asks: dict[Family | None, dict[str, Ask]] = field(default_factory=dict)
    hidden: Stays = field(default_factory=dict)
    train: Stays = field(default_factory=dict)
    reversals: dict[Family | None, dict[str, Reversal]] = field(default_factory=dict)


def related(index: dict[Family | None, dict[str, T]], family: Family | None) -> dict[str, T] | None:
    """What `index` holds of one of the family's relatives; None for nothing."""
    if not index:
        return None
    if family is None:
        return next(iter(index.values()))
    for each in family.relatives:
        there = index.get(each)
        if there is not None:
            return there
    return index.get(None)


def all_related(index: dict[Family | None, dict[str, T]], family: Family | None) -> list[T]:
    """All that `index` holds of the family's relatives."""
    if not index:
        return []
    families = index if family is None else (*family.relatives, None)
    return [each for member in families for each in index.get(member, {}).values()]


def _put(index: dict[Family | None, dict[str, T]], family: Family | None, name: str, what: T) -> None:
    index.setdefault(family, {})[name] = what


def _take(index: dict[Family | None, dict[str, T]], family: Family | None, name: str) -> T | None:
    there = index.get(family)
    taken = None if there is None else there.pop(name, None)
    if there is not None and not there:
        del index[family]
    return taken


def hidden_evaluation(split: str, bundle: str | None, *, replays: bool) -> bool:
    """Whether an evaluation is hidden work: what a policy does, or did, on hidden cases. Random actions tell nothing."""
    return split in HIDDEN_SPLITS and (bundle is not None or replays)


HIDDEN_SPLITS = ("validation", "heldout")


class Isolation:
    """Who is on which kernel, and who may be."""

    def __init__(self, core: Core) -> None:
        self._core = core
        settings: CoreSettings = core.settings
        self.on = settings.hidden_isolation != "off"
        self.families = Families(strict=settings.hidden_isolation == "strict")
        self.kernels: dict[str, Kernel] = {}
        self.everywhere = self.kernel(EVERYWHERE)
        self.lingering: dict[str, dict[str, Stay]] = {}
        """By worker: stays without a lease."""
        self._held: dict[str, dict[Kernel, tuple[PermitRow, Family]]] = {}
        """By run."""
        self._known: dict[str, KernelRow] = {}
        """By worker: as stored."""
        self._asks: dict[tuple[str, str], Ask] = {}
        """By run and boot id."""
        self._boots: dict[str, dict[str, None]] = {}
        """By machine: the boot ids under which something of it is known."""
        self._grantable = False
        """A permit that is asked for may have become possible in this step."""

    def kernel(self, boot_id: str) -> Kernel:
        """What is known of a kernel."""
        found = self.kernels.get(boot_id)
        if found is None:
            found = self.kernels[boot_id] = Kernel(boot_id)
        return found

    def tidy(self, kernel: Kernel) -> None:
        """Forget a kernel on which nothing is."""
        parts = (
            kernel.workers,
            kernel.permits,
            kernel.asks,
            kernel.hidden,
            kernel.train,
            kernel.reversals,
        )
        if kernel is not self.everywhere and not any(parts):
            self.kernels.pop(kernel.boot_id, None)

    # ---- what is barred ----

    def concerns(self, priority: int, worker: Worker) -> bool:
        """Whether `bar` may hold for any family."""
        if priority == TRAIN:
            kernel = worker.kernel
            there = kernel.hidden or kernel.reversals or self.everywhere.hidden
            return self.on and (bool(there) or kernel is self.everywhere)
        return self.on and priority in HIDDEN

    def bar(self, priority: int, family: Family | None, worker: Worker) -> bool:
        """Whether a job of that priority and family must not be leased to a worker now."""
        if not self.on:
            return False
        if priority == TRAIN:
            return self.train_bar(family, worker.kernel)
        if priority not in HIDDEN:
            return False
        return self.hidden_bar(family, worker.kernel) is not None or self._train_waits(
            priority, family, worker
        )

    def _train_waits(self, priority: int, family: Family | None, worker: Worker) -> bool:
        """Whether related train jobs wait for workers like this one: hidden jobs do not get in their way."""
        assert family is not None
        if priority != EARLY_VALIDATION and related(worker.kernel.reversals, family):
            return False
        busy = worker.profile.busy
        return any(
            lane in busy and each in lane.waiting[TRAIN] for each in family.relatives for lane in each.lanes
        )

    def train_bar(self, family: Family | None, kernel: Kernel) -> bool:
        """Whether hidden jobs keep train jobs of a family from a kernel."""
        if kernel is self.everywhere:
            return any(
                related(each.hidden, family) or self._reversed(each, family) for each in self.kernels.values()
            )
        if related(kernel.hidden, family) or related(self.everywhere.hidden, family):
            return True
        return bool(kernel.reversals) and self._reversed(kernel, family)

    def _reversed(self, kernel: Kernel, family: Family | None) -> bool:
        """Whether the order is reversed there and train jobs of a family are held back for it."""
        return related(kernel.reversals, family) is not None and not self._permits(kernel, family)

    def _permits(self, kernel: Kernel, family: Family | None) -> dict[str, PermitRow] | None:
        return related(kernel.permits, family) or related(self.everywhere.permits, family)

    def hidden_bar(self, family: Family | None, kernel: Kernel) -> str | None:
        """Why hidden jobs of a family must not be leased on a kernel: `kernel`, `agent`, `asked`, `train`; None: they may."""
        if kernel is self.everywhere:
            return "kernel"
        if self._permits(kernel, family):
            return "agent"
        reversed_there = related(kernel.reversals, family)
        if not reversed_there and (related(kernel.asks, family) or related(self.everywhere.asks, family)):
            return "asked"
        if related(kernel.train, family) or related(self.everywhere.train, family):
            return "train"
        return None

    def permit_bar(self, family: Family, kernel: Kernel) -> str:
        """What a permit waits for, in words for its gateway; empty when it may be granted."""
        if not self.on:
            return ""
        there = self.kernels.values() if kernel is self.everywhere else (kernel, self.everywhere)
        if any(related(each.reversals, family) for each in there):
            return SCORING
        stays = [stay for each in there for stay in all_related(each.hidden, family)]
        if not stays:
            return ""
        if any(stay.lease is not None for stay in stays):
            return "hidden cases on this machine to be put off"
        return "workers of this machine to report that they play no hidden cases"

    def adoptable(self, job: JobState, worker: Worker) -> bool:
        """Whether what a worker says to hold since before the core was loaded may go on."""
        family, here = job.group.flow.family, (worker.kernel, self.everywhere)
        if not self.on or not (job.group.hidden or job.priority == TRAIN):
            return True
        if job.priority == TRAIN:
            there = [stay for each in here for stay in all_related(each.hidden, family)]
        elif self.hidden_bar(family, worker.kernel) in ("kernel", "agent", "asked"):
            return False
        else:
            there = [stay for each in here for stay in all_related(each.train, family)]
        # What this very worker may have played besides it tells now.
        return all(stay.lease is None and stay.worker == worker.name for stay in there)

    # ---- stays ----

    def leased(self, lease: Lease, worker: Worker, serial: int, turn: Turn) -> None:
        """A worker was given a lease, or goes on with one."""
        before = self.lingering.get(worker.name, {}).get(lease.id)
        if before is not None:
            self._forget(before, turn)
        group = lease.job.group
        if not (group.hidden or group.kind == "train"):
            return
        stay = Stay(
            lease.id,
            worker.name,
            worker.kernel,
            worker.machine_id,
            group.flow.family,
            group.hidden,
            lease,
            serial,
        )
        lease.stay = stay
        self._enter(stay)

    def _enter(self, stay: Stay) -> None:
        family = stay.family
        if family is not None:
            family.users += 1
            if stay.hidden:
                family.hidden_on[stay.kernel] = family.hidden_on.get(stay.kernel, 0) + 1
        _put(stay.kernel.hidden if stay.hidden else stay.kernel.train, stay.family, stay.key, stay)

    def left(self, lease: Lease, worker: Worker, turn: Turn, *, sure: bool) -> None:
        """A lease is a worker's no more: surely, or by our word alone."""
        stay, lease.stay = lease.stay, None
        if stay is None:
            return
        stay.lease = None
        if sure:
            self._gone(stay, turn)
            return
        stay.until = max(worker.last_seen, lease.granted_at) + self._core.settings.silent_bar_s
        self.lingering.setdefault(stay.worker, {})[stay.id] = stay
        self._core.timers.arm_once(("linger", stay.worker), stay.until)

    def _gone(self, stay: Stay, turn: Turn) -> None:
        """A stay has ended: what it barred may go on."""
        index = stay.kernel.hidden if stay.hidden else stay.kernel.train
        family = stay.family
        _take(index, family, stay.key)
        if stay.hidden and family is not None:
            left = family.hidden_on[stay.kernel] - 1
            if left:
                family.hidden_on[stay.kernel] = left
            else:
                del family.hidden_on[stay.kernel]
        if not related(index, family):
            self.freed(family, turn, train_too=stay.hidden)
        self.tidy(stay.kernel)
        self.families.leave(family)

    def freed(self, family: Family | None, turn: Turn, *, train_too: bool = True) -> None:
        """Something of a family is barred no more, somewhere: hidden jobs, or train jobs and permits too."""
        self._grantable = self._grantable or train_too
        lanes: Iterable[Lane] = self._core.queue.lanes.values()
        if family is not None:
            lanes = [lane for each in family.relatives for lane in each.lanes]
        for lane in lanes:
            if lane not in turn.dirty and lane.waits_of(family, train_too=train_too):
                turn.dirty[lane] = None

    def _forget(self, stay: Stay, turn: Turn) -> None:
        there = self.lingering[stay.worker]
        del there[stay.id]
        if not there:
            del self.lingering[stay.worker]
        self._gone(stay, turn)

    def heard(self, worker: Worker, named: set[str], settled: int, turn: Turn) -> None:
        """A heartbeat: of what was given up, a worker has let go of what it does not name."""
        for stay in list(self.lingering.get(worker.name, {}).values()):
            if stay.id in named:
                stay.until = turn.now + self._core.settings.silent_bar_s
            elif self.surely(worker, stay, settled):
                self._forget(stay, turn)

    def surely(self, worker: Worker, stay: Stay | None, settled: int) -> bool:
        """Whether a heartbeat that does not name a lease shows that its worker does not hold it and never will."""
        if stay is None or settled == 0:
            return True
        serial = stay.serial
        if serial == 0:
            # Whatever it held before it was first heard arrived before its first poll of this session was sent.
            return worker.first_serial is not None and settled >= worker.first_serial - 1
        return settled >= serial

    def unknown(self, worker: Worker, item: HeldLease, turn: Turn) -> None:
        """A worker holds a lease that is not its any more: it may play it until it has stopped."""
        known = item.attempt > self._core.first_attempt or item.lease_id in self.lingering.get(
            worker.name, {}
        )
        if known or not self.on:
            return
        job = self._core.jobs.get(item.job_id)
        group_id = item.job_id.rpartition("/")[0]
        train = group_id.endswith("/train")
        if job is not None:
            if not (job.group.hidden or job.group.kind == "train"):
                return
            train, family = job.group.kind == "train", job.group.flow.family
        else:
            run = self._core.runs.get(item.job_id.partition("/")[0])
            family = None if run is None else run.flow.family
        self._linger(
            Stay(item.lease_id, worker.name, worker.kernel, worker.machine_id, family, not train, None), turn
        )

    def _linger(self, stay: Stay, turn: Turn) -> None:
        stay.until = turn.now + self._core.settings.silent_bar_s
        self._enter(stay)
        self.lingering.setdefault(stay.worker, {})[stay.id] = stay
        self._core.timers.arm_once(("linger", stay.worker), stay.until)

    def expire(self, name: str, turn: Turn) -> None:
        """A worker's deadline for what it has not told of."""
        for stay in list(self.lingering.get(name, {}).values()):
            assert stay.until is not None
            if turn.now >= stay.until:
                self._forget(stay, turn)
        if name in self.lingering:
            until = min(stay.until or turn.now for stay in self.lingering[name].values())
            self._core.timers.arm(("linger", name), until)

    # ---- workers ----

    def joined(self, worker: Worker, turn: Turn) -> None:
        """A worker registered on its kernel."""
        worker.kernel.workers[worker.name] = None
        row = KernelRow(worker=worker.name, boot_id=worker.kernel.boot_id, machine_id=worker.machine_id)
        if self._known.get(worker.name) != row:
            self._known[worker.name] = row
            turn.persist(row)
        self.booted(worker.machine_id, worker.kernel.boot_id, turn)
        for stay in list(self.lingering.get(worker.name, {}).values()):
            # The same process, or one in its place: what an earlier one played has ended with it.
            if stay.kernel is not worker.kernel and stay.machine_id == worker.machine_id != "":
                self._forget(stay, turn)

    def forgotten(self, worker: Worker) -> None:
        """A worker is not on its kernel any more."""
        if self._core.fleet.workers.get(worker.name) is not worker:
            worker.kernel.workers.pop(worker.name, None)
            self.tidy(worker.kernel)

    def booted(self, machine_id: str, boot_id: str, turn: Turn) -> None:
        """A machine has this boot id now: whatever was on it under another one has ended."""
        if not machine_id or not boot_id:
            return
        before, self._boots[machine_id] = self._boots.get(machine_id, {}), {boot_id: None}
        for old in before:
            kernel = self.kernels.get(old)
            if kernel is None or old == boot_id:
                continue
            for row in all_related(kernel.permits, None):
                if row.machine_id == machine_id:
                    self._end(kernel, row, turn, "its machine was started anew")
            for stay in (*all_related(kernel.hidden, None), *all_related(kernel.train, None)):
                if stay.machine_id == machine_id and stay.lease is None:
                    self._forget(stay, turn)

    # ---- permits ----

    def place(self, run: Run, boot_id: str) -> str | None:
        """The kernel that a run's agent is on when its gateway says `boot_id`; None: on none of the cluster."""
        said = run.row.settings.agent_host
        return None if said == ELSEWHERE else (said or boot_id)

    def held(self, run: str) -> list[tuple[Kernel, PermitRow]]:
        """A run's permits."""
        return [(kernel, row) for kernel, (row, _) in self._held.get(run, {}).items()]

    def ask(self, run: Run, row: PermitRow, turn: Turn) -> str:
        """Ask for a permit, again or for the first time; gives what it waits for, empty when it is granted."""
        kernel, family = self.kernel(row.boot_id), run.family
        if run.id in kernel.permits.get(family, ()):
            return ""
        if run.id not in kernel.asks.get(family, ()):
            family.users += 1
            ask = self._asks[run.id, kernel.boot_id] = Ask(row, family, kernel)
            _put(kernel.asks, family, run.id, ask)
        self._preempt(family, kernel, turn)
        return self._grant(run.id, kernel, family, turn)

    def _preempt(self, family: Family, kernel: Kernel, turn: Turn) -> None:
        """Stop related hidden jobs for a permit, unless it is their turn."""
        if not self.on:
            return
        there = list(self.kernels.values()) if kernel is self.everywhere else [kernel]
        if any(related(each.reversals, family) for each in there):
            return
        for each in there:
            for stay in all_related(each.hidden, family):
                if stay.lease is not None and stay.lease.live:
                    self._core.scheduler.put_off(stay.lease, "an agent is to start there", turn)

    def _grant(self, run: str, kernel: Kernel, family: Family, turn: Turn) -> str:
        waits_for = self.permit_bar(family, kernel)
        if waits_for:
            return waits_for
        ask = self._withdraw(run, kernel, family)
        assert ask is not None
        row = msgspec.structs.replace(ask.row, granted_at=turn.now)
        self.restore(row, family)
        turn.persist(row)
        turn.log("info", "permit_granted", run=run, host=row.host, boot_id=row.boot_id)
        for poll in self._core.polls.take_all(poll_target(run, row.boot_id)):
            turn.reply(poll.request, gateway.Permit(granted=True))
        return ""

    def restore(self, row: PermitRow, family: Family) -> None:
        """A permit is there."""
        family.users += 1
        kernel = self.kernel(row.boot_id)
        _put(kernel.permits, family, row.run, row)
        self._held.setdefault(row.run, {})[kernel] = row, family

    def _withdraw(self, run: str, kernel: Kernel, family: Family) -> Ask | None:
        """A permit is asked for no more."""
        ask = _take(kernel.asks, family, run)
        self._asks.pop((run, kernel.boot_id), None)
        if ask is not None:
            self._core.timers.disarm(("ask", (run, kernel.boot_id)))
            self.families.leave(family)
        return ask

    def forget_ask(self, run: str, boot_id: str, turn: Turn) -> None:
        """A permit was not asked for again."""
        ask = self._asks.get((run, boot_id))
        if ask is not None:
            self.freed(ask.family, turn, train_too=False)
            self._withdraw(run, ask.kernel, ask.family)
            self.tidy(ask.kernel)

    def settle(self, turn: Turn) -> None:
        """At the end of a step: grant what has become possible."""
        if not self._grantable:
            return
        self._grantable = False
        for ask in list(self._asks.values()):
            self._preempt(ask.family, ask.kernel, turn)
            self._grant(ask.row.run, ask.kernel, ask.family, turn)

    def end(self, run: str, turn: Turn, why: str) -> None:
        """A run's agent is gone, wherever it was."""
        self._core.timers.disarm(("cancelled", run))
        for kernel, row in self.held(run):
            self._end(kernel, row, turn, why)

    def drop_asks(self, run: str, refusal: Refusal, text: str, turn: Turn) -> None:
        """Nothing more is granted to a run."""
        for name, boot_id in [key for key in self._asks if key[0] == run]:
            self.forget_ask(name, boot_id, turn)
            for poll in self._core.polls.take_all(poll_target(name, boot_id)):
                turn.refuse(poll.request, refusal, text)

    def _end(self, kernel: Kernel, row: PermitRow, turn: Turn, why: str) -> None:
        there = self._held[row.run]
        _, family = there.pop(kernel)
        if not there:
            del self._held[row.run]
        _take(kernel.permits, family, row.run)
        turn.persist(msgspec.structs.replace(row, ended_at=turn.now))
        turn.log("info", "permit_ended", run=row.run, host=row.host, boot_id=row.boot_id, why=why)
        self.freed(family, turn)
        self.tidy(kernel)
        self.families.leave(family)

    def cancelled(self, run: str, turn: Turn, at: float | None = None) -> None:
        """A run was cancelled: its agent is being ended."""
        if self.held(run):
            self._core.timers.arm(("cancelled", run), (turn.now if at is None else at) + CANCELLED_S)

    # ---- loading ----

    def load(
        self,
        permits: Iterable[PermitRow],
        kernels: Iterable[KernelRow],
        runs: dict[str, RunRow],
        states: dict[str, RunStateRow],
        turn: Turn,
    ) -> None:
        """Take in what is stored, before anything is played."""
        for row in permits:
            run = runs.get(row.run)
            if run is None or row.ended_at is not None:
                continue
            family = self.families.join(run.settings.env, (*run.validation, *run.heldout))
            self.restore(row, family)
            self.families.leave(family)
            state = states.get(row.run)
            self._boots.setdefault(row.machine_id, {})[row.boot_id] = None
            if state is not None and state.phase == "finished":
                at = turn.now if state.closed_at is None else min(state.closed_at, turn.now)
                self._core.timers.arm_once(("cancelled", row.run), at + CANCELLED_S)
        for known in kernels:
            self._known[known.worker] = known
            kernel = self.kernel(known.boot_id)
            self._boots.setdefault(known.machine_id, {})[known.boot_id] = None
            for hidden in (True, False):
                if hidden and not known.boot_id:
                    continue
                name = f"{known.worker} before, {'hidden' if hidden else 'train'}"
                self._linger(Stay(name, known.worker, kernel, known.machine_id, None, hidden, None), turn)

    # ---- what is told ----

    def agents(self, run: str) -> str:
        """Where a run's agent may be alive, in words; empty for nowhere."""
        return ", ".join(sorted(_where(row) for _, row in self.held(run)))

    def bar_of_worker(self, worker: Worker) -> str:
        """Why a worker plays no hidden episodes now; empty when it may."""
        kernel = worker.kernel
        if not self.on:
            return ""
        if kernel is self.everywhere:
            return NO_BOOT_ID
        rows = [
            row
            for each in (kernel, self.everywhere)
            for there in each.permits.values()
            for row in there.values()
        ]
        return f"the agent of {rows[0].run} may be alive there" if rows else ""

    def obstacle(self, group: JobGroup) -> str:
        """What keeps an open group from all workers that could play it, in words; empty when nothing of this does.

        Of a train group only that hidden cases do."""
        lane, family = group.flow.lane, group.flow.family
        if lane is None or not self.on or not (group.hidden or group.kind == "train"):
            return ""
        kernels = self.serving(lane)
        if not kernels:
            return ""
        if group.kind == "train":
            return SCORING if all(self.train_bar(family, kernel) for kernel in kernels) else ""
        why = [self.hidden_bar(family, kernel) for kernel in kernels]
        if not all(why):
            return ""
        for kernel in kernels:
            permits = self._permits(kernel, family)
            if permits is not None:
                row = next(iter(permits.values()))
                return (
                    f"the agent of {row.run} to end, which may be alive {_at(row)}; if it is not, resume that run, or say"
                    f" `evopolicy runs agent-gone {row.run}`"
                )
        if "asked" in why:
            return "an agent that is about to start there"
        if "train" in why:
            return "train episodes of runs with the same hidden cases to end"
        return f"a worker that tells its kernel's boot id: {NO_BOOT_ID}"

    def to_clear(self, family: Family | None) -> list[tuple[Kernel, list[Lease]]]:
        """The kernels that related hidden jobs keep a family's train jobs from, with what is to be stopped there; those
        with least to stop first. Nothing is to be stopped where it was already, but for what has not been let go of."""
        found = []
        kernels = (
            {} if family is None else {kernel: None for each in family.relatives for kernel in each.hidden_on}
        )
        for kernel in kernels:
            stays = all_related(kernel.hidden, family)
            if stays and not self._reversed(kernel, family):
                found.append(
                    (kernel, [stay.lease for stay in stays if stay.lease is not None and stay.lease.live])
                )
        return sorted(found, key=lambda each: len(each[1]))

    def goes_first(self, lease: Lease) -> bool:
        """Whether a hidden lease is on a kernel that is turned over to it."""
        stay = lease.stay
        return (
            stay is not None
            and lease.job.priority != EARLY_VALIDATION
            and related(stay.kernel.reversals, stay.family) is not None
        )

    def serving(self, lane: Lane) -> dict[Kernel, None]:
        """The kernels of the active workers that may serve a lane."""
        workers = self._core.fleet.workers
        return {workers[name].kernel: None for profile in lane.profiles for name in profile.workers}


NO_BOOT_ID = (
    "the worker does not tell its kernel's boot id, so an agent may be on the same one; install the coordinator's version of"
    " evopolicy there"
)


def _where(row: PermitRow) -> str:
    return row.host or row.boot_id or "everywhere"


def _at(row: PermitRow) -> str:
    return f"on {_where(row)}" if row.host or row.boot_id else "on any machine"


def poll_target(run: str, boot_id: str) -> str:
    """What who waits for a permit waits for."""
    return f"permit {run} {boot_id}"


def implied(core: Core, run: Run, turn: Turn) -> str:
    """The permit of an agent whose gateway asks for none, so it may be anywhere; gives what it waits for, empty when the
    run has one."""
    kernel = core.isolation.place(run, EVERYWHERE)
    if kernel is None or core.isolation.held(run.id):
        return ""
    waits_for = core.isolation.ask(run, PermitRow(run=run.id, boot_id=kernel), turn)
    if waits_for:
        core.timers.arm(("ask", (run.id, kernel)), turn.now + ASK_AGAIN_S)
    return waits_for


def stamp(core: Core, row: RunRow) -> HiddenIsolation:
    """What a new run is stamped with."""
    if core.settings.hidden_isolation == "off":
        return "shared"
    return "waived" if row.settings.agent_host == ELSEWHERE else "exclusive"
