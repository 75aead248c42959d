"""A simulated worker: it registers, polls, sends heartbeats, plays and reports; it can crash, freeze, be slow, and fail
jobs.

The result of a job depends on the job alone, as with a real worker; only its faults are random. The actions that the
policy of a hidden episode has returned are named by their attempt, as if the clock had decided them, and returned with
the job when it is stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from sim_oracle import failure_of, return_of

from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, EpisodeSpec, Job, PolicyFailure
from evopolicy_common.refusals import Refusal

if TYPE_CHECKING:
    from sim_scenario import Simulation
    from sim_truth import Machine

POLL_S = 5.0
BEAT_S = 2.0
SILENCE_S = 15.0
"""Leases with `stop_in_silence` are stopped when no heartbeat was answered for this long."""
FROZEN_LIMIT_S = 18.0
"""An episode during which the worker was frozen for this long ends with a false verdict about a time limit."""


class Asker:
    """A client of the coordinator that retries every request until it is answered; can crash and freeze."""

    def __init__(self, simulation: Simulation, name: str) -> None:
        self.simulation, self.world, self.name = simulation, simulation.world, name
        self.life = 0
        self.frozen_until = 0.0

    def ask(
        self,
        kind: type[wire.Message],
        fields: dict[str, Any],
        then: Callable[[Any], None],
        wait_s: float = 0.0,
    ) -> None:
        """Send a request, and retry it after a timeout; `then` is called once, by a reply to the latest attempt."""
        life = self.life
        current = [0]
        """Number of the latest attempt; -1 once it was answered."""

        def answer(serial: int, message: Any) -> None:
            if life != self.life or serial != current[0]:
                return
            if self.world.now < self.frozen_until:
                self.world.after(self.frozen_until - self.world.now, answer, serial, message)
                return
            current[0] = -1
            then(message)

        def send(serial: int) -> None:
            if life != self.life or current[0] != serial - 1:
                return
            if self.world.now < self.frozen_until:
                self.world.after(self.frozen_until - self.world.now, send, serial)
                return
            current[0] = serial
            coordinator = self.simulation.coordinator
            self.world.send(self.name, coordinator.receive, self.name, kind, fields, partial(answer, serial))
            self.world.after(wait_s + 3.0 + self.world.chance.random(), send, serial + 1)

        send(1)

    def later(self, delay_s: float, call: Callable[..., None], *args: Any) -> None:
        """As `World.after`, but cancelled by a crash, and postponed while the client is frozen."""
        life = self.life

        def due() -> None:
            if life != self.life:
                return
            if self.world.now < self.frozen_until:
                self.world.after(self.frozen_until - self.world.now, due)
                return
            call(*args)

        self.world.after(delay_s, due)

    def freeze(self, seconds: float) -> None:
        """Nothing happens here for `seconds`. A frozen client is not frozen again: the rule about silent workers bounds
        a single standstill, after which the worker looks at its clock."""
        if self.world.now < self.frozen_until:
            return
        self.frozen_until = self.world.now + seconds
        self.world.note(f"{self.name} stands still for {seconds:.1f} s")


class SimWorker(Asker):
    """One worker supervisor with its slots."""

    def __init__(
        self,
        simulation: Simulation,
        name: str,
        slots: int,
        envs: tuple[str, ...],
        version: str,
        machine: Machine,
        *,
        tells_kernel: bool,
        mute: bool = False,
    ) -> None:
        super().__init__(simulation, name)
        self.mute = mute
        """Whether it never polls."""
        self.slots, self.envs, self.version = slots, envs, version
        self.machine = machine
        self.tells_kernel = tells_kernel
        self.boot_id = machine.boot_id
        """Of the kernel that this process runs on."""
        self.serial = 0
        faults = self.world.faults
        self._reset()
        self.beat_wait_s = self.world.chance.choice((0.0, 1.5))
        self.slowness = 4.0 if self.world.chance.random() < faults.slow_worker else 1.0
        self.later(self.world.chance.random(), self._register)

    def _reset(self) -> None:
        self.session = ""
        self.queue: dict[str, wire.Lease] = {}
        self.running: dict[str, wire.Lease] = {}
        self.outbox: list[wire.JobResult] = []
        self.stopped: set[str] = set()
        self.polling = self.handing = False
        self.outstanding: set[int] = set()
        """Numbers of polls that are not answered yet."""
        self.answered_at = self.world.now
        self.boot_id = self.machine.boot_id
        self.simulation.truth.worker_dies(self.name)

    @property
    def settled(self) -> int:
        """All polls up to this number are finished."""
        return min(self.outstanding) - 1 if self.outstanding else self.serial

    def crash(self) -> None:
        self.world.note(f"{self.name} dies holding {list(self.running)}")
        self.life += 1
        life = self.life
        self.simulation.truth.worker_dies(self.name)

        def back() -> None:
            if life == self.life:
                self._register()

        self.world.after(1.0 + self.world.chance.random() * 25.0, back)

    # ---- talk ----

    def _register(self) -> None:
        self._reset()
        self._introduce(first=True)

    def _introduce(self, *, first: bool = False) -> None:
        session = f"{self.name}-{self.world.chance.randrange(1 << 30)}"
        fields = {
            "worker": self.name,
            "session": session,
            "slots": self.slots,
            **describe(self.envs, self.version),
            "boot_id": self.boot_id if self.tells_kernel else "",
            "host": self.machine.name,
            "machine": self.machine.name,
        }

        def registered(message: Any) -> None:
            if isinstance(message, wire.Refused) and message.status == Refusal.NAME_TAKEN:
                self.later(3.0, lambda: self._introduce(first=first))  # it tries again
                return
            self.session = message.session
            if first:
                self._beat()
                self._look_at_silence()
            self._poll()
            self._report_results()

        self.ask(wire.Register, fields, registered)

    def _lost_session(self, message: Any) -> bool:
        if isinstance(message, wire.Refused):
            self.polling = self.handing = False
            if self.session:
                self.session = ""
                self._introduce()
            return True
        return False

    def _beat(self) -> None:
        """Send a heartbeat, whether or not the last one was answered."""
        self.later(BEAT_S, self._beat)
        if not self.session:
            return
        held = [
            wire.HeldLease(
                lease_id=lease.lease_id, job_id=lease.job.job_id, attempt=lease.attempt, running=running
            )
            for running, leases in ((True, self.running), (False, self.queue))
            for lease in leases.values()
        ]
        held += [
            wire.HeldLease(lease_id=each.lease_id, job_id=each.job_id, attempt=each.attempt, running=False)
            for each in self.outbox
        ]
        life, sent_at = self.life, self.world.now

        def answered(message: Any) -> None:
            if life == self.life and isinstance(message, wire.HeartbeatReply):
                if self.world.now < self.frozen_until:
                    self.world.after(self.frozen_until - self.world.now, answered, message)
                    return
                self.answered_at = max(self.answered_at, sent_at)
                for lease_id in message.cancelled:
                    self._stop(lease_id)

        fields = {
            "worker": self.name,
            "session": self.session,
            "held": tuple(held),
            "settled": self.settled,
            "wait_s": self.beat_wait_s,
        }
        self.world.send(
            self.name, self.simulation.coordinator.receive, self.name, wire.Heartbeat, fields, answered
        )

    def _look_at_silence(self) -> None:
        self.later(0.5, self._look_at_silence)
        if self.world.now - self.answered_at > SILENCE_S:
            for lease in (*self.queue.values(), *self.running.values()):
                if lease.stop_in_silence:
                    self._stop(lease.lease_id)

    def _stop(self, lease_id: str) -> None:
        lease = self.queue.pop(lease_id, None) or self.running.pop(lease_id, None)
        was_running = (self.name, lease_id) in self.simulation.truth.plays
        self.simulation.truth.play_ends(self.name, lease_id)
        if lease is not None:
            self._put(lease, "returned", begun=begun_of(lease) if was_running else None)
            self._start()

    def _poll(self) -> None:
        wanted = self.slots - len(self.running) - len(self.queue)
        if self.polling or wanted <= 0 or not self.session or self.mute:
            return
        self.polling = True
        self.serial += 1
        serial = self.serial
        self.outstanding.add(serial)
        fields = {
            "worker": self.name,
            "session": self.session,
            "n": wanted,
            "wait_s": POLL_S,
            "serial": serial,
        }

        def answered(message: Any) -> None:
            self.outstanding.discard(serial)
            current = fields["session"] == self.session
            if current:
                self.polling = False
            if isinstance(message, wire.Refused) and not current:
                return
            if self._lost_session(message):
                return
            for lease_id in message.cancelled:
                self._stop(lease_id)
            for lease in message.leases:
                self.queue[lease.lease_id] = lease
            self._start()
            if current:
                self._poll()

        self.ask(wire.LeaseRequest, fields, answered, POLL_S)

    def _put(
        self,
        lease: wire.Lease,
        kind: wire.ResultKind,
        episodes: tuple[EpisodeOutcome, ...] = (),
        begun: BlobRef | None = None,
    ) -> None:
        self.outbox.append(
            wire.JobResult(
                lease_id=lease.lease_id,
                job_id=lease.job.job_id,
                attempt=lease.attempt,
                kind=kind,
                episodes=episodes,
                begun=begun,
            )
        )
        self._report_results()

    def _report_results(self) -> None:
        if self.handing or not self.outbox or not self.session:
            return
        self.handing = True
        batch = tuple(self.outbox)
        fields = {"worker": self.name, "session": self.session, "results": batch}

        def answered(message: Any) -> None:
            self.handing = False
            if self._lost_session(message):
                return
            self.outbox = [each for each in self.outbox if each not in batch]
            self._report_results()
            self._poll()

        self.ask(wire.ReportResults, fields, answered)

    # ---- play ----

    def _start(self) -> None:
        while self.queue and len(self.running) < self.slots:
            lease = self.queue.pop(next(iter(self.queue)))
            self.running[lease.lease_id] = lease
            seconds = sum(self.simulation.seconds_of(lease.job, spec) for spec in lease.job.episodes)
            self.simulation.checkers.playing(self.name, lease)
            self.simulation.truth.play_starts(self.name, lease, self.boot_id)
            self.later(seconds * self.slowness, self._played, lease, self.world.now)

    def _played(self, lease: wire.Lease, started: float) -> None:
        if self.running.pop(lease.lease_id, None) is None:
            return
        self.simulation.truth.play_ends(self.name, lease.lease_id)
        job, chance = lease.job, self.world.chance
        stormy = self.world.now < self.world.calm_at
        frozen_s = (
            self.world.now
            - started
            - self.slowness * sum(self.simulation.seconds_of(job, spec) for spec in job.episodes)
        )
        if stormy and chance.random() < self.world.faults.worker_trouble:
            self._put(lease, "failed")
        else:
            episodes = tuple(_outcome(job, spec, frozen_s) for spec in job.episodes)
            self._put(lease, "done", episodes)
        self._start()
        self._poll()


def describe(envs: tuple[str, ...], version: str) -> dict[str, Any]:
    """The part of a registration that tells what a worker can play."""
    descriptions = tuple(
        EnvironmentDescription(
            env=env, env_version="1", obs_space={}, action_space={}, max_episode_steps=9, task_text=""
        )
        for env in envs
    )
    fingerprint = wire.Fingerprint(code_version=version, python="3", packages={}, cpu="")
    return {"tiers": ("bwrap",), "environments": descriptions, "fingerprint": fingerprint}


def begun_of(lease: wire.Lease) -> BlobRef | None:
    """The actions that its policy has returned once it is played: those of an earlier attempt, or its own."""
    job = lease.job
    if job.bundle is None or job.record == "full":
        return None
    return job.begun or BlobRef(digest=lease.lease_id, size=1)


def _outcome(job: Job, spec: EpisodeSpec, frozen_s: float) -> EpisodeOutcome:
    category = failure_of(job.bundle, spec.index)
    failure = None if category is None else PolicyFailure(category=category, step_index=0, message="")
    value = return_of(spec.case.seed, job.bundle, spec.policy_seed, spec.episode_index, job.env_meta)
    if frozen_s > FROZEN_LIMIT_S:
        failure = PolicyFailure(category="act_timeout", step_index=0, message="", limit=1.0, used=frozen_s)
        value = -99.0
    return _episode(spec.index, value, failure)


def _episode(index: int, value: float, failure: PolicyFailure | None) -> EpisodeOutcome:
    return EpisodeOutcome(
        index=index,
        episode_return=value,
        length=1,
        terminated=True,
        truncated=False,
        failure=failure,
        trajectory=BlobRef(digest=repr(value), size=1),
        wall_s=1.0,
    )
