"""Leases: who plays which job, for how long, and what becomes of it.

Rules that this module owns:
- A job has at most one lease that counts. Every lease has the job's next attempt number; attempts that were given up are
  fenced off: what goes wrong in them is nothing to the job any more, and their holders are told to stop. (An outcome is
  taken from any attempt, as `handin` says: it is the same whoever plays it.)
- A lease lives by heartbeats that name it. One that no heartbeat names for a time to live is given up; one that its
  worker never came to know of, too. While the loop's own lateness is in doubt nothing expires.
- A lease that this incarnation has not heard of is adopted from its holder's heartbeat when its job waits.
- Giving up a job's lease puts the job back as `retry` decides; only jobs that ran are blamed.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from evopolicy_common.messages import worker as wire

from . import precedence
from .jobs import TRAIN, JobState, build
from .retry import Mishap, decide

if TYPE_CHECKING:
    from .isolation import Stay
    from .machine import Core
    from .queue import Lane
    from .turn import Turn
    from .workers import Worker

ATTEMPTS_PER_INCARNATION = 1_000_000

MISSING_BEATS = 3
"""A lease that its worker has not named for so many heartbeats since it was granted never arrived."""

FORGET_S = 3600.0
"""A lost worker is listed for so long."""


@dataclass(slots=True, eq=False)
class Lease:
    """The right to play one attempt of a job."""

    id: str
    job: JobState
    worker: str
    attempt: int
    granted_at: float
    renewed: float
    """When its holder last named it, or was given it."""
    named: bool = False
    """Whether its holder ever named it: if not, it may never have arrived."""
    running: bool = False
    started_at: float | None = None
    """When it was first said to run."""
    episodes_done: int = 0
    steps: int = 0
    progress_at: float = 0.0
    live: bool = True
    """False once it was given up: preempted, cancelled, expired, or its job is done."""
    orphan_until: float | None = None
    """Its session ended; a heartbeat may claim it until then."""
    doubtful: bool = False
    """Its holder was silent for long, or this incarnation did not grant it: a verdict about a limit may be the
    silence's fault, and does not count."""
    hidden_in: dict[Lease, None] | None = None
    """Where it is listed as one that may be preempted."""
    stopped_for: Lane | None = None
    """Whose train jobs it was preempted for."""
    stay: Stay | None = None
    """Where it is, if it is hidden or train: as long as it is its worker's."""


def lease_id(secret: bytes, job_id: str, attempt: int, worker: str) -> str:
    """Names a lease by what it is of: equal in every incarnation.

    Only who knows the run's secret can make it: it proves to a later incarnation, which has no list of what earlier ones
    granted, that this worker was given this attempt.
    """
    proof = hmac.digest(secret, f"lease|{job_id}|{attempt}|{worker}".encode(), hashlib.sha256)
    return f"{job_id}#{attempt}#{proof[:12].hex()}"


class LeaseBook:
    """Grants, renews and gives up leases. Works on the core's jobs, queue and fleet."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self.n_live = 0

    def granted(self, name: str, job_id: str, attempt: int, worker: Worker) -> bool:
        """Whether a lease of that name was granted to the worker, by this incarnation or an earlier one."""
        group = self._core.groups.get(job_id.rpartition("/")[0])
        if group is None:
            return False
        return hmac.compare_digest(
            name.encode(), lease_id(self._core.secret_of(group), job_id, attempt, worker.name).encode()
        )

    # ---- getting ----

    def grant(self, job: JobState, worker: Worker, turn: Turn) -> wire.Lease:
        """Lease a job that has just left the queue."""
        job.attempts += 1
        serial = 0 if worker.poll is None else worker.poll.serial
        lease = self._enter(job, worker, job.attempts, turn, serial=serial)
        job.held_attempts.add(lease.attempt)
        group = job.group
        description = group.flow.description or worker.profile.descriptions[group.template.env]
        self._core.chronicle.tell(turn.now, turn.stimulus_id, lease.id, f"granted to {worker.name}")
        return wire.Lease(
            lease_id=lease.id,
            attempt=lease.attempt,
            stimulus_id=group.stimulus_id,
            job=build(job, description),
            stop_in_silence=group.hidden and self._core.isolation.on,
        )

    def _enter(self, job: JobState, worker: Worker, attempt: int, turn: Turn, *, serial: int) -> Lease:
        now = turn.now
        name = lease_id(self._core.secret_of(job.group), job.job_id, attempt, worker.name)
        lease = Lease(name, job, worker.name, attempt, granted_at=now, renewed=now, progress_at=now)
        job.lease = lease
        worker.leases[name] = lease
        worker.n_live += 1
        worker.held[job.priority] += 1
        group = job.group
        group.n_leased += 1
        group.flow.n_leased += 1
        self.n_live += 1
        self._core.isolation.leased(lease, worker, serial, turn)
        precedence.let_go(self._core, group, now)
        self.list_hidden(lease, worker, turn)
        if group.first_leased_at is None:
            group.first_leased_at = now
            self._core.group_started(group, turn)
        if job.alone:
            worker.alone = lease
        self._core.timers.arm_once(("worker", worker.name), now + self._core.settings.lease_ttl_s)
        return lease

    def list_hidden(self, lease: Lease, worker: Worker, turn: Turn) -> None:
        """List a live lease among those that train jobs may preempt, by its job's priority."""
        if lease.hidden_in is not None:
            lease.hidden_in.pop(lease, None)
            lease.hidden_in = None
        if lease.job.priority != TRAIN:
            lease.hidden_in = worker.profile.hidden[lease.job.priority]
            lease.hidden_in[lease] = None
            self._core.scheduler.hidden_leased(worker, turn)

    # ---- hearing ----

    def hear(
        self, worker: Worker, held: Iterable[wire.HeldLease], turn: Turn, *, settled: int
    ) -> tuple[str, ...]:
        """A heartbeat: renew what it names, adopt what is unknown and waits; gives what the worker is to stop."""
        now = turn.now
        stop: list[str] = []
        named: set[str] = set()
        for item in held:
            named.add(item.lease_id)
            lease = worker.leases.get(item.lease_id) or self._adopt(worker, item, turn)
            if lease is None or not lease.live:
                stop.append(item.lease_id)
                if lease is None:
                    self._core.isolation.unknown(worker, item, turn)
                continue
            lease.doubtful = lease.doubtful or now - lease.renewed > self._core.settings.silence_s
            lease.renewed = now
            lease.named = True
            lease.orphan_until = None
            lease.running = item.running
            if item.running and lease.started_at is None:
                lease.started_at = now
            if (item.episodes_done, item.steps) != (lease.episodes_done, lease.steps):
                lease.episodes_done, lease.steps, lease.progress_at = item.episodes_done, item.steps, now
        missing_since = now - MISSING_BEATS * self._core.settings.heartbeat_s
        for lease in [each for each in worker.leases.values() if each.id not in named]:
            if not lease.live:
                sure = self._core.isolation.surely(worker, lease.stay, settled)
                self._leave(worker, lease, turn, sure=sure)
            elif not lease.named and lease.granted_at < missing_since and now >= self._core.hold_until:
                sure = self._core.isolation.surely(worker, lease.stay, settled)
                self.release(worker, lease, turn, "it never arrived", sure=sure)
                self.give_back(lease.job, "unlisted", worker, turn, ran=False)
        self._core.isolation.heard(worker, named, settled, turn)
        return tuple(stop)

    def _adopt(self, worker: Worker, item: wire.HeldLease, turn: Turn) -> Lease | None:
        """The lease of an earlier incarnation that a worker still holds; None when it is not to go on."""
        core = self._core
        job = core.jobs.get(item.job_id)
        if (
            job is None
            or job.lease is not None
            or item.attempt in job.held_attempts
            or not self.granted(item.lease_id, item.job_id, item.attempt, worker)
            or job.group.bars(worker)
            or not core.isolation.adoptable(job, worker)
        ):
            return None
        core.scheduler.unreserve(job)
        core.queue.withdraw(job)
        core.timers.disarm(("job", job.job_id))
        core.adopting.pop(job, None)
        job.held_attempts.add(item.attempt)
        core.chronicle.tell(turn.now, turn.stimulus_id, item.lease_id, f"adopted from {worker.name}")
        lease = self._enter(job, worker, item.attempt, turn, serial=0)
        lease.doubtful = True
        return lease

    # ---- giving up ----

    def end(self, lease: Lease, turn: Turn, why: str) -> None:
        """The lease counts no more; its worker is told to stop at its next heartbeat, or at once if one waits."""
        if not lease.live:
            return
        lease.live = False
        job = lease.job
        job.lease = None
        job.group.n_leased -= 1
        job.group.flow.n_leased -= 1
        self.n_live -= 1
        worker = self._core.fleet.workers[lease.worker]
        worker.n_live -= 1
        worker.held[job.priority] -= 1
        if lease.hidden_in is not None:
            lease.hidden_in.pop(lease, None)
        self._core.chronicle.tell(turn.now, turn.stimulus_id, lease.id, why)

    def stop(self, lease: Lease, turn: Turn, why: str) -> None:
        """End a lease that its worker holds on to; it is told at the end of this step if it waits for any answer."""
        self.end(lease, turn, why)
        turn.stops.setdefault(lease.worker, []).append(lease.id)

    def release(self, worker: Worker, lease: Lease, turn: Turn, why: str, *, sure: bool = False) -> None:
        """End a lease that its worker has let go of: surely, as it said, or as far as we know."""
        self.end(lease, turn, why)
        self._leave(worker, lease, turn, sure=sure)

    def _leave(self, worker: Worker, lease: Lease, turn: Turn, *, sure: bool) -> None:
        worker.leases.pop(lease.id, None)
        self._core.isolation.left(lease, worker, turn, sure=sure)
        if lease.stopped_for is not None:
            lease.stopped_for.stopping -= 1
            lease.stopped_for = None
        if worker.alone is lease:
            worker.alone = None
        self._core.scheduler.emptied(worker)

    def give_back(
        self, job: JobState, mishap: Mishap, worker: Worker, turn: Turn, *, ran: bool, error: str = ""
    ) -> None:
        """Put a job whose lease has ended back into the queue, as `retry` decides."""
        core = self._core
        retry = decide(core.settings, mishap, failures=job.failures + 1, ran=ran)
        job.since = turn.now
        if retry.counted:
            job.failures += 1
            job.last_failure = f"{mishap} on {worker.name}" + (f": {error[:200]}" if error else "")
            core.counted_retry(job, turn)
            turn.log(
                "warning",
                "job_retried",
                job=job.job_id,
                worker=worker.name,
                mishap=mishap,
                failures=job.failures,
                delay_s=retry.delay_s,
                alone=retry.alone,
                error=error[:2000],
            )
        core.chronicle.tell(turn.now, turn.stimulus_id, job.job_id, f"{mishap} on {worker.name}: {retry}")
        job.alone = job.alone or retry.alone
        if retry.avoid:
            job.avoid, job.avoid_until = worker.name, turn.now + retry.delay_s + core.settings.avoid_s
        if retry.delay_s > 0.0:
            core.timers.arm(("job", job.job_id), turn.now + retry.delay_s)
        else:
            core.scheduler.queue(job, turn, front=True)

    def look(self, worker: Worker, turn: Turn) -> None:
        """A worker's deadline: give up what expired, declare it lost when it was silent, and set the next deadline."""
        core, settings, now = self._core, self._core.settings, turn.now
        if now < core.hold_until:
            core.timers.arm(("worker", worker.name), core.hold_until)
            return
        silent_at = worker.last_seen + settings.lease_ttl_s
        if worker.doubted_at is not None:
            silent_at = min(silent_at, worker.doubted_at + settings.liveness_grace_s)
        if worker.state != "lost" and now >= silent_at:
            self.lose(worker, turn)
            return
        running = {lease.id for lease in worker.running()}
        deadlines = [] if worker.state == "lost" else [silent_at]
        for lease in list(worker.leases.values()):
            due = lease.renewed + settings.lease_ttl_s if lease.orphan_until is None else lease.orphan_until
            overdue = (lease.started_at or lease.granted_at) + self._longest_s(lease.job)
            if now >= overdue and lease.live:
                self.stop(lease, turn, "overdue")
                self.give_back(lease.job, "overdue", worker, turn, ran=True)
            elif now >= due:
                live, orphan = lease.live, lease.orphan_until is not None
                self.release(worker, lease, turn, "no heartbeat names it")
                if live:
                    mishap: Mishap = "worker_lost" if orphan else "unlisted"
                    self.give_back(lease.job, mishap, worker, turn, ran=orphan and lease.id in running)
            else:
                deadlines.append(min(due, overdue) if lease.live else due)
        if deadlines:
            core.timers.arm(("worker", worker.name), min(deadlines))

    def _longest_s(self, job: JobState) -> float:
        """Longest that a job may be held, seconds: our own bound over the policy's limits, with its wait in a batch."""
        limits = job.group.template.limits
        each = limits.episode_wall_s + limits.init_wall_s + self._core.settings.job_deadline_s
        return job.n * each

    def lose(self, worker: Worker, turn: Turn) -> None:
        """A worker went silent: all it holds goes back, what it was playing under suspicion."""
        core = self._core
        running = {lease.id for lease in worker.running()}
        core.fleet.count_out(worker)
        turn.log("warning", "worker_lost", worker=worker.name, held=len(worker.leases), running=len(running))
        core.scheduler.drop_poll(worker, turn)
        if worker.beat is not None:
            core.fleet.answer_beat(worker, (), turn)
        for lease in list(worker.leases.values()):
            live = lease.live
            self.release(worker, lease, turn, "worker lost")
            if live:
                self.give_back(lease.job, "worker_lost", worker, turn, ran=lease.id in running)
        core.timers.arm(("forget", worker.name), turn.now + FORGET_S)

    def take_away(self, name: str, turn: Turn) -> None:
        """A worker is trusted no more: all it holds goes back, under no suspicion, and its polls end."""
        core = self._core
        worker = core.fleet.workers.get(name)
        if worker is None:
            return
        core.scheduler.drop_poll(worker, turn)
        if worker.beat is not None:
            core.fleet.answer_beat(worker, tuple(worker.leases), turn)
        for lease in list(worker.leases.values()):
            live = lease.live
            self.release(worker, lease, turn, "its worker is quarantined")
            if live:
                self.give_back(lease.job, "returned", worker, turn, ran=False)
