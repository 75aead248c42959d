"""The fleet: who registered, what each can do, whether it is there.

Rules that this module owns:
- A worker is named; its session ends when it registers again. Leases of an ended session are orphans: a heartbeat of the
  new one may claim them for a short while, then they are lost like a lost worker's.
- Workers of one profile (environments, tiers, fingerprint class) are interchangeable but for what they have warm.
- A worker that is paused, draining, lost, quarantined, benched or taken by a suspect gets no more work. One that is
  draining is told to end once what it plays is done; one that is paused stays, and is as before when it is taken back.
- A worker whose jobs keep failing through its own fault is benched for a growing time.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Literal

import msgspec

from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.worker import Fingerprint

from .events import RequestId, WorkerRegistered
from .isolation import Kernel
from .jobs import N_PRIORITIES, JobState
from .leases import Lease
from .queue import Flow, Profile, Queue
from .settings import CoreSettings
from .timers import Timers
from .turn import Turn

OutOfService = Literal["draining", "paused"]

BENCH_AFTER = 3
"""Failures in a row, with nothing played in between, after which a worker is benched."""


def fingerprint_class(fingerprint: Fingerprint, *, cpu: bool) -> str:
    """12 hex digits, equal for workers whose results may stand in one run.

    Covers the code's version, Python's and every environment package's, and with `cpu` the CPU's features.
    """
    parts = [fingerprint.code_version, fingerprint.python, sorted(fingerprint.packages.items())]
    if cpu:
        parts.append(fingerprint.cpu)
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()[:12]


@dataclass(slots=True, eq=False)
class LeasePoll:
    """A worker's long poll for leases."""

    request: RequestId
    n: int
    warm: frozenset[str]
    until: float
    """When it is answered with what there is."""
    serial: int = 0
    """The worker's own number of it."""


@dataclass(slots=True, eq=False)
class Worker:
    """One worker as the core knows it."""

    name: str
    session: str
    slots: int
    host: str
    profile: Profile
    last_seen: float
    kernel: Kernel
    machine_id: str = ""
    first_serial: int | None = None
    """Number of the session's first poll."""
    machine: str = ""
    """Whose credentials it joined with; empty for those that the state folder hands out."""
    numerics: str = ""
    """What its numbers depend on: equal for workers that come to the same bits, the processor's features included."""
    state: Literal["active", "paused", "draining", "lost", "quarantined"] = "active"
    leases: dict[str, Lease] = field(default_factory=dict)
    """By id, oldest first; given-up ones too, until the worker no longer names them."""
    held: list[int] = field(default_factory=lambda: [0] * N_PRIORITIES)
    """Live leases by priority."""
    n_live: int = 0
    """Live leases in all."""
    poll: LeasePoll | None = None
    beat: RequestId | None = None
    """A heartbeat whose answer is held back."""
    doubted_at: float | None = None
    """When its liveliness token went; None while it is there, or since it was heard from."""
    reserved: JobState | None = None
    """The suspect it is being emptied for."""
    alone: Lease | None = None
    """The suspect it plays, with nothing beside it."""
    failures: int = 0
    """Jobs in a row that failed through its own fault."""
    benched_until: float = 0.0

    def running(self) -> list[Lease]:
        """Leases it plays now: as it said, or the oldest, one a slot, as long as it has not said."""
        told = [lease for lease in self.leases.values() if lease.running]
        return told or list(self.leases.values())[: self.slots]


class Fleet:
    """All workers, by name."""

    def __init__(self, settings: CoreSettings, queue: Queue, timers: Timers) -> None:
        self._settings = settings
        self._queue = queue
        self._timers = timers
        self.workers: dict[str, Worker] = {}
        self.out_of_service: dict[str, OutOfService] = {}
        """Names that an operator drained or paused; kept over restarts."""
        self.quarantined: dict[str, str] = {}
        """Names that an audit found to forge, and why; until an operator takes them back."""
        self.quarantined_machines: dict[str, str] = {}
        """Machines of those names, to the name."""
        self.sessions: dict[str, str] = {}
        """Present sessions to the workers whose they are."""

    def of_session(self, name: str, session: str, now: float) -> Worker | None:
        """The worker if the session is its present one; it has been heard from then."""
        worker = self.workers.get(name)
        if worker is None or worker.session != session:
            return None
        worker.last_seen = now
        worker.doubted_at = None
        if worker.state == "lost":
            self._count_in(worker)
        return worker

    def register(self, event: WorkerRegistered, kernel: Kernel, turn: Turn) -> Worker:
        """Take a worker in, or take it in again under a new session."""
        message = event.message
        profile = self._profile(event)
        old = self.workers.get(message.worker)
        worker = Worker(
            name=message.worker,
            session=event.session,
            slots=max(1, message.slots),
            host=message.host,
            profile=profile,
            last_seen=turn.now,
            kernel=kernel,
            machine_id=message.machine_id,
            machine=event.machine,
            numerics=fingerprint_class(message.fingerprint, cpu=True),
            state="lost",
        )
        if old is not None:
            self.count_out(old)
            worker.leases, worker.held, worker.n_live = old.leases, old.held, old.n_live
            worker.alone = old.alone
            worker.failures, worker.benched_until = old.failures, old.benched_until
            for lease in worker.leases.values():
                lease.orphan_until = turn.now + self._settings.adoption_s
            self.sessions.pop(old.session, None)
        self.workers[message.worker] = worker
        self.sessions[worker.session] = worker.name
        self._count_in(worker)
        if worker.benched_until > turn.now:
            self._timers.arm(("bench", worker.name), worker.benched_until)
        self._timers.arm(("worker", worker.name), turn.now + self._settings.adoption_s)
        return worker

    def _profile(self, event: WorkerRegistered) -> Profile:
        message = event.message
        name = fingerprint_class(message.fingerprint, cpu=self._settings.fingerprint_cpu)
        key = (
            frozenset(description.env for description in message.environments),
            frozenset[Tier](message.tiers),
            name,
        )
        profile = self._queue.profiles.get(key)
        if profile is None:
            descriptions = {description.env: description for description in message.environments}
            profile = Profile(key, message.fingerprint, descriptions)
            self._queue.add_profile(profile)
        return profile

    def _count_in(self, worker: Worker) -> None:
        worker.state = self.out_of_service.get(worker.name, "active")
        if worker.state == "active":
            worker.profile.workers[worker.name] = None
            worker.profile.slots += worker.slots

    def count_out(self, worker: Worker, state: Literal[OutOfService, "lost", "quarantined"] = "lost") -> None:
        """No more work for it."""
        if worker.state == "active":
            del worker.profile.workers[worker.name]
            worker.profile.slots -= worker.slots
        worker.state = state
        self.unpark(worker)
        if worker.reserved is not None:
            worker.reserved.reserved = None
            worker.reserved = None

    def set_state(
        self,
        name: str,
        state: Literal["active", OutOfService, "quarantined"],
        reason: str = "",
        machine: str = "",
    ) -> None:
        """An operator's word, or an audit's; holds for a worker that is not there yet, too."""
        self.out_of_service.pop(name, None)
        if self.quarantined.pop(name, None) is not None:
            machines = self.quarantined_machines
            self.quarantined_machines = {each: of for each, of in machines.items() if of != name}
        if state == "draining" or state == "paused":
            self.out_of_service[name] = state
        elif state == "quarantined":
            self.quarantined[name] = reason
            if machine:
                self.quarantined_machines[machine] = name
        worker = self.workers.get(name)
        if worker is None or worker.state in ("lost", state):
            return
        if state == "active":
            self._count_in(worker)
        else:
            self.count_out(worker, state)

    def forget(self, worker: Worker) -> None:
        """A worker that was lost long ago is known no more."""
        del self.workers[worker.name]
        self.sessions.pop(worker.session, None)

    def answer_beat(self, worker: Worker, stop: tuple[str, ...], turn: Turn) -> None:
        """Answer the heartbeat that a worker has waiting."""
        request, worker.beat = worker.beat, None
        self._timers.disarm(("beat", worker.name))
        assert request is not None
        drain = self.out_of_service.get(worker.name) == "draining"
        turn.reply(request, wire.HeartbeatReply(cancelled=stop, drain=drain))

    # ---- availability ----

    def available(self, worker: Worker, now: float) -> bool:
        """Whether it may be given more."""
        return worker.state == "active" and worker.alone is None and worker.benched_until <= now

    def park(self, worker: Worker) -> None:
        """Its poll waits and could be answered now."""
        profile = worker.profile
        if worker.poll is None or worker.name in profile.parked:
            return
        profile.parked[worker.name] = None
        for item in worker.poll.warm:
            profile.warm.setdefault(item, {})[worker.name] = None

    def unpark(self, worker: Worker) -> None:
        """Its poll waits no more, or cannot be answered now."""
        profile = worker.profile
        if worker.name not in profile.parked:
            return
        assert worker.poll is not None
        del profile.parked[worker.name]
        for item in worker.poll.warm:
            there = profile.warm[item]
            there.pop(worker.name, None)
            if not there:
                del profile.warm[item]

    def failed(self, worker: Worker, turn: Turn) -> None:
        """One more job failed through its own fault."""
        worker.failures += 1
        if worker.failures >= BENCH_AFTER:
            settings = self._settings
            pause_s = min(settings.retry_max_s, settings.retry_base_s * 2.0 ** min(worker.failures, 30))
            worker.benched_until = turn.now + pause_s
            self.unpark(worker)
            self._timers.arm(("bench", worker.name), worker.benched_until)
            turn.log(
                "warning", "worker_benched", worker=worker.name, failures=worker.failures, pause_s=pause_s
            )

    # ---- pins ----

    def offer(self, flow: Flow) -> Profile | None:
        """Of the profiles that can serve an unpinned flow the one with most slots; None when there is none."""
        able = [
            profile
            for profile in self._queue.profiles.values()
            if profile.workers and flow.env in profile.key[0] and flow.tier in profile.key[1]
        ]
        slots: dict[str, int] = {}
        for profile in able:
            slots[profile.fingerprint_class] = slots.get(profile.fingerprint_class, 0) + profile.slots
        return max(able, key=lambda profile: slots[profile.fingerprint_class], default=None)
