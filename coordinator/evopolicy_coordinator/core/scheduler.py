"""Brings waiting jobs and waiting workers together.

Rules that this module owns:
- Work is pulled: a worker's poll says how many leases it can take and waits until there is some. Free slots are filled
  first. Ahead of them a worker gets only short episodes, worth about `batch_s` a slot, even more of them than it asked
  for, and never so many that another idle worker goes without.
- A poll whose time is over gets no lease: while the loop stood still its worker has given it up, and would never see it.
- New work goes first to a waiting worker that has its bundle, then its environment, warm; else to the longest waiting.
- A suspect runs alone: on an idle worker, or on one that is emptied for it; nothing else goes there meanwhile.
- A waiting train job stops hidden jobs, a suspect those of the worker that is emptied for it: audits and early validation
  as often as it takes, others a bounded number of times. The hidden job goes back into the queue; its worker lets go of
  it and polls again.
"""

from __future__ import annotations

import math
from itertools import islice
from typing import TYPE_CHECKING

from evopolicy_common.messages import worker as wire

from . import precedence
from .events import Asked
from .jobs import AUDIT, EARLY_VALIDATION, HELDOUT, HIDDEN_AUDIT, REFERENCE, TRAIN, JobState
from .queue import Lane
from .turn import Turn
from .workers import LeasePoll, Worker

if TYPE_CHECKING:
    from .isolation import Family
    from .leases import Lease
    from .machine import Core

PREFETCH_BELOW_S = 1.0
"""Longer episodes are leased to free slots only: fetching them takes no time beside playing them."""

TRIES_MAX = 4
"""Parked workers that are tried for a lane in one step before the rest waits for the next."""

LOOK_AGAIN_S = 1.0
"""What waits although someone waits for it (they avoid each other) is looked at again after so long."""

LOOKS_MAX = 64
"""Parked workers whose kernels may be barred to a lane that are looked past in one step."""

VICTIMS_MAX = 256
"""Hidden leases looked at for a lane in one step."""

LEASES_MAX = 256
"""Most leases in one answer: it has to fit into a message."""

EPISODES_MAX = 2048
"""Of jobs with many episodes fewer are leased at once, but at least one."""

HELD_MAX = 16_384
"""Most leases that a worker may hold: its heartbeats name them all."""

SUSPECTS_MAX = 16
"""Suspects looked at in one step."""

FAMILIES_MAX = 8
"""Families of waiting train jobs that hidden jobs are stopped for in one step."""


class Scheduler:
    """Parks polls, hands out leases, preempts."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._emptied: dict[str, None] = {}

    def queue(self, job: JobState, turn: Turn, *, front: bool = False) -> None:
        """Let a job wait, and see at the end of the step whether someone waits for it."""
        lane = self._core.queue.push(job, front=front)
        if lane is not None:
            turn.dirty[lane] = None

    def emptied(self, worker: Worker) -> None:
        """A worker let go of a lease: its waiting poll may be answerable now."""
        self._emptied[worker.name] = None

    def hidden_leased(self, worker: Worker, turn: Turn) -> None:
        """A worker has a hidden job: train jobs that wait already (they avoided it, or the hidden job was adopted from
        its heartbeat) may stop it with nothing else happening."""
        for lane in worker.profile.busy:
            if lane.n_ready[TRAIN]:
                self._core.timers.arm_once(("lane", lane.key), turn.now + LOOK_AGAIN_S)

    # ---- polls ----

    def poll(self, worker: Worker, event: Asked[wire.LeaseRequest], turn: Turn) -> None:
        """A worker asks for leases; an older poll of it is answered with none."""
        message = event.message
        core = self._core
        self.drop_poll(worker, turn)
        if message.n < 1 or event.waited_s > message.wait_s + core.settings.late_s:
            turn.reply(event.request, wire.Leases(leases=()))
            return
        wait_s = min(max(message.wait_s - event.waited_s, 0.0), core.settings.max_wait_s)
        warm = frozenset(message.warm_bundles) | frozenset(message.warm_environments)
        n = max(1, min(message.n, 2 * worker.slots))
        worker.poll = LeasePoll(event.request, n, warm, until=turn.now + wait_s, serial=message.serial)
        if worker.first_serial is None:
            worker.first_serial = message.serial
        if not self._serve(worker, turn):
            core.timers.arm(("lease", worker.name), turn.now + wait_s)
            self._park(worker, turn)

    def _park(self, worker: Worker, turn: Turn) -> None:
        """Let a worker's poll wait where new work finds it, if it has a slot for it. Else its next free slot is what
        brings the poll up again."""
        if worker.n_live >= worker.slots or worker.reserved is not None:
            return
        if not self._core.fleet.available(worker, turn.now):
            return
        self._core.fleet.park(worker)
        for lane in worker.profile.busy:
            self._core.timers.arm_once(("lane", lane.key), turn.now + LOOK_AGAIN_S)

    def drop_poll(self, worker: Worker, turn: Turn) -> None:
        """Answer a worker's waiting poll with no leases."""
        if worker.poll is not None:
            self._answer(worker, (), turn)

    def _answer(
        self, worker: Worker, leases: tuple[wire.Lease, ...], turn: Turn, cancelled: tuple[str, ...] = ()
    ) -> None:
        poll = worker.poll
        assert poll is not None
        self._core.fleet.unpark(worker)
        self._core.timers.disarm(("lease", worker.name))
        worker.poll = None
        turn.reply(poll.request, wire.Leases(leases=leases, cancelled=cancelled))

    def _serve(self, worker: Worker, turn: Turn) -> bool:
        """Answer a worker's poll if there is anything for it."""
        leases = self._fill(worker, turn)
        if leases:
            self._answer(worker, tuple(leases), turn)
        return bool(leases)

    def _fill(self, worker: Worker, turn: Turn) -> list[wire.Lease]:
        core, poll = self._core, worker.poll
        if poll is None or not core.fleet.available(worker, turn.now):
            return []
        if turn.now > poll.until + core.settings.late_s:
            return []
        if core.queue.suspects and (suspect := self._suspect(worker, turn)) is not None:
            return [suspect]
        if worker.reserved is not None:
            return []
        free = worker.slots - worker.n_live
        leases: list[wire.Lease] = []
        limit = min(self._limit(worker, poll.n, free), LEASES_MAX, HELD_MAX - len(worker.leases))
        n_episodes = 0
        while len(leases) < limit and n_episodes < EPISODES_MAX:
            job = core.queue.take(worker, poll.warm, turn.now)
            if job is None:
                break
            leases.append(core.book.grant(job, worker, turn))
            n_episodes += job.n
        return leases

    def _limit(self, worker: Worker, n: int, free: int) -> int:
        """How many leases a poll for `n` gets at most, `free` of the worker's slots having nothing to play.

        More than the free slots can take only of short episodes, not ahead of what has less right to the slot, and no
        more than the worker's part of what waits.
        """
        settings, found = self._core.settings, self._core.queue.leading(worker)
        if found is None or found[0].lane is None:
            return 0
        at_least = min(n, max(0, free))
        flow, priority = found
        assert flow.lane is not None
        episode_s = flow.episode_s
        behind_hidden = any(worker.held[priority + 1 :])
        if episode_s is None or episode_s >= PREFETCH_BELOW_S or behind_hidden:
            return at_least
        ahead = min(settings.batch_max, 1 + int(settings.batch_s / max(episode_s, 1e-4)))
        share = math.ceil(sum(flow.lane.n_ready) * worker.slots / max(1, flow.lane.slots()))
        return max(at_least, min(worker.slots * ahead - worker.n_live, share))

    # ---- suspects ----

    def _suspect(self, worker: Worker, turn: Turn) -> wire.Lease | None:
        """The suspect that an idle worker is to play; a busy one may be reserved for one instead."""
        core, idle = self._core, not worker.leases
        if worker.reserved is not None:
            job = worker.reserved
            if not job.queued or self._barred(job, worker):
                worker.reserved = job.reserved = None
            elif not idle:
                return None
            else:
                return self._alone(job, worker, turn)
        for job in list(islice(core.queue.suspects, SUSPECTS_MAX)):
            lane = job.group.flow.lane
            if lane is None or worker.profile not in lane.profiles:
                continue
            if job.reserved is not None and not idle:
                continue
            if job.avoid == worker.name and turn.now < job.avoid_until and lane.workers() > 1:
                continue
            if job.priority >= EARLY_VALIDATION and (lane.n_ready[TRAIN] or not idle):
                continue
            if job.group.bars(worker) or self._barred(job, worker):
                continue
            if idle:
                return self._alone(job, worker, turn)
            self._reserve(job, worker, turn)
            return None
        return None

    def _barred(self, job: JobState, worker: Worker) -> bool:
        return self._core.isolation.bar(job.priority, job.group.flow.family, worker)

    def _reserve(self, job: JobState, worker: Worker, turn: Turn) -> None:
        """Begin to empty a busy worker for a suspect; a train job does not wait for what is hidden there to end."""
        job.reserved = worker.name
        worker.reserved = job
        self._core.chronicle.tell(turn.now, turn.stimulus_id, job.job_id, f"{worker.name} is emptied for it")
        if job.priority == TRAIN:
            for lease in list(worker.leases.values()):
                first = self._core.isolation.goes_first(lease)
                if lease.live and lease.job.priority != TRAIN and not first and self._may_stop(lease.job):
                    self._stop_hidden(lease, worker, f"preempted for {job.job_id}", turn)

    def unreserve(self, job: JobState) -> None:
        """No worker is emptied for a suspect any more; the one that was may get other work."""
        if job.reserved is not None:
            worker = self._core.fleet.workers[job.reserved]
            worker.reserved = job.reserved = None
            self.emptied(worker)

    def _alone(self, job: JobState, worker: Worker, turn: Turn) -> wire.Lease:
        core = self._core
        self.unreserve(job)
        core.queue.withdraw(job)
        return core.book.grant(job, worker, turn)

    # ---- the end of a step ----

    def dispatch(self, turn: Turn) -> None:
        """Hand out what this step made available."""
        core = self._core
        core.isolation.settle(turn)
        while self._emptied:
            name = next(iter(self._emptied))
            del self._emptied[name]
            worker = core.fleet.workers.get(name)
            if worker is not None and worker.poll is not None and name not in worker.profile.parked:
                self.reconsider(worker, turn)
        for job in list(islice(core.queue.suspects, SUSPECTS_MAX)):
            lane = job.group.flow.lane
            if lane is not None and job.queued:
                if job.priority == TRAIN:
                    avoided = job.avoid if turn.now < job.avoid_until and lane.workers() > 1 else None
                    self._clear(lane, job.group.flow.family, avoided, turn)
                self._try_parked(lane, turn, TRIES_MAX)
        fed = list(turn.dirty)
        turn.dirty.clear()
        for lane in fed:
            self._feed(lane, turn)
        for lane in fed:
            if lane.n_ready[TRAIN]:
                self._preempt(lane, turn)
        while turn.dirty:
            # What was stopped just now waits again: another worker may have a slot for it.
            lane = next(iter(turn.dirty))
            del turn.dirty[lane]
            self._feed(lane, turn)
        for lane in fed:
            precedence.watch(core, lane, turn)
        for name, stops in turn.stops.items():
            self._tell(name, tuple(stops), turn)

    def _tell(self, name: str, stops: tuple[str, ...], turn: Turn) -> None:
        """Tell a worker now what to stop, if any answer of ours is due to it; else its next heartbeat brings it."""
        worker = self._core.fleet.workers.get(name)
        if worker is None:
            return
        if worker.beat is not None:
            self._core.fleet.answer_beat(worker, stops, turn)
        elif worker.poll is not None:
            self._answer(worker, (), turn, stops)

    def reconsider(self, worker: Worker, turn: Turn) -> None:
        """A worker with a waiting poll may have become available."""
        fleet = self._core.fleet
        if worker.poll is None or not fleet.available(worker, turn.now):
            return
        if not self._serve(worker, turn):
            self._park(worker, turn)

    def _feed(self, lane: Lane, turn: Turn) -> None:
        """Answer parked polls while the lane has something for them."""
        tries = 0
        while any(lane.n_ready) and tries < TRIES_MAX:
            worker = self._parked(lane)
            if worker is None:
                return
            if self._serve(worker, turn):
                tries = 0
            else:
                tries += 1
                self._to_the_back(worker, turn)
        if any(lane.n_ready):
            self._core.timers.arm_once(("lane", lane.key), turn.now + LOOK_AGAIN_S)

    def _try_parked(self, lane: Lane, turn: Turn, tries: int) -> None:
        for profile in lane.profiles:
            for name in list(islice(profile.parked, tries)):
                worker = self._core.fleet.workers[name]
                if not self._serve(worker, turn):
                    self._to_the_back(worker, turn)

    def _to_the_back(self, worker: Worker, turn: Turn) -> None:
        self._core.fleet.unpark(worker)
        self._park(worker, turn)

    def _parked(self, lane: Lane) -> Worker | None:
        """The waiting worker that should get what goes next in the lane."""
        following = self._core.queue.next_bundle(lane)
        if following is None:
            return None
        workers, queue = self._core.fleet.workers, self._core.queue
        for item in following:
            for profile in lane.profiles if item is not None else ():
                for name in islice(profile.warm.get(item or "", ()), LOOKS_MAX):
                    if queue.may_serve(lane, workers[name]):
                        return workers[name]
        for profile in lane.profiles:
            for name in islice(profile.parked, LOOKS_MAX):
                if queue.may_serve(lane, workers[name]):
                    return workers[name]
        return None

    def _preempt(self, lane: Lane, turn: Turn) -> None:
        """Stop hidden jobs for the train jobs that wait in the lane.

        The last that were leased go first: they have come least far, and of a batch they wait behind the others.
        """
        core = self._core
        if any(any(profile.hidden) for profile in lane.profiles):
            # What is spared now may be stopped later with nothing else happening: a worker is avoided no longer, or one
            # that was to let go of a hidden job is lost.
            core.timers.arm_once(("lane", lane.key), turn.now + LOOK_AGAIN_S)
        wanted = lane.n_ready[TRAIN] - lane.stopping
        avoided = core.queue.avoided(lane, TRAIN, turn.now)
        for family in list(islice(lane.waiting[TRAIN], FAMILIES_MAX)):
            wanted -= self._clear(lane, family, avoided, turn)
        for priority in (HIDDEN_AUDIT, AUDIT, EARLY_VALIDATION, HELDOUT, REFERENCE):
            for profile in lane.profiles:
                hidden = profile.hidden[priority]
                for lease in list(islice(reversed(hidden), VICTIMS_MAX)):
                    job = lease.job
                    if wanted <= 0:
                        return
                    worker = core.fleet.workers[lease.worker]
                    if lease.worker == avoided or core.isolation.goes_first(lease):
                        continue
                    if not core.queue.may_train(lane, worker):
                        continue
                    if not self._may_stop(job):
                        del hidden[lease]
                        continue
                    self._stop_hidden(lease, worker, f"preempted for {lane.key[0]}", turn)
                    if worker.n_live < worker.slots:
                        # Only now a slot comes free by it: what was stopped before had still to wait for one.
                        wanted -= 1
                        lane.stopping += 1
                        lease.stopped_for = lane

    def _clear(self, lane: Lane, family: Family | None, avoided: str | None, turn: Turn) -> int:
        """Stop the related hidden jobs that keep a family's train jobs from kernels, on as many kernels as have slots for
        them: one that stays bars its whole kernel. Gives the slots that come free."""
        core, slots = self._core, 0
        wanted = lane.waiting[TRAIN].get(family, 0)
        for kernel, leases in core.isolation.to_clear(family):
            if slots >= wanted:
                break
            there = [core.fleet.workers[name] for name in kernel.workers if name != avoided]
            room = sum(worker.slots for worker in there if worker.profile in lane.profiles)
            if not room:
                continue
            # What may be stopped no more plays to its end; nothing hidden begins there meanwhile.
            lasting = any(not self._may_stop(lease.job) for lease in leases)
            for lease in leases:
                if not lasting or lease.job.priority != HELDOUT:
                    worker = core.fleet.workers[lease.worker]
                    self._stop_hidden(lease, worker, f"preempted for {lane.key[0]}", turn)
            if not lasting:
                slots += room
        return slots

    def _may_stop(self, job: JobState) -> bool:
        """Whether train jobs may stop a hidden job (once more)."""
        bounded = job.priority in (HELDOUT, REFERENCE)
        return not bounded or job.preemptions < self._core.settings.preemptions_max

    def put_off(self, lease: Lease, why: str, turn: Turn) -> None:
        """Stop a hidden job, through nobody's fault; it goes back into the queue."""
        worker = self._core.fleet.workers[lease.worker]
        self._core.book.stop(lease, turn, why)
        self._core.book.give_back(lease.job, "returned", worker, turn, ran=False)

    def _stop_hidden(self, lease: Lease, worker: Worker, why: str, turn: Turn) -> None:
        """Stop a hidden job for the sake of train jobs; it goes back into the queue."""
        lease.job.preemptions += 1
        self._core.book.stop(lease, turn, why)
        self._core.book.give_back(lease.job, "returned", worker, turn, ran=False)
