"""The fleet: registered workers, their capabilities, and their availability.

Rules that this module owns:
- A worker has a name; its session ends when it registers again. Leases of an ended session are orphans: a heartbeat of
  the new session may claim them for a short while, then they are lost like a lost worker's.
- Workers of one profile (environments with their fingerprint classes, tiers) are interchangeable except for their warm
  environments and bundles.
- A worker that is paused, draining, lost, benched or reserved for a suspect gets no more work. A draining
  worker is requested to end after its present jobs; a paused one stays, and works as before once it is set active.
- A worker whose jobs keep failing through its own fault is benched: it gets no leases for a growing time.
"""

from __future__ import annotations

from typing import Literal

from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import Tier
from evopolicy_coordinator.core.contract.events import DescriptionAwaited, WorkerRegistered
from evopolicy_coordinator.core.leasing import queue
from evopolicy_coordinator.core.structures import pop_entry
from evopolicy_coordinator.core.tables.model import Flow, JobState, Kernel, OutOfService, Profile, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep

BENCH_AFTER = 3
"""Consecutive failures after which a worker is benched."""
MAX_WORKERS = 4096
"""Workers that join with the same token, lost ones too until they are forgotten."""
MAX_DESCRIBED_BYTES = 256 << 20
"""Size of what they tell of their environments; workers that tell the same share it."""


def of_session(state: State, name: str, session: str, now: float) -> Worker | None:
    """Returns the worker if `session` is its current one, and records the contact; None otherwise."""
    worker = state.workers.get(name)
    if worker is None or worker.session != session:
        return None
    worker.last_seen = now
    worker.doubted_at = None
    if worker.state == "lost":
        count_in(state, worker)
    return worker


def has_room(state: State, event: WorkerRegistered) -> bool:
    """Whether another worker may join with the token of this one."""
    there = state.machines.get(event.machine, {})
    others = [each for name, each in there.items() if name != event.message.worker]
    size = event.size + _told_size(event.message)
    size += sum(profile.size for profile in {each.profile for each in others})
    size += sum(each.told_size for each in others)
    return len(others) < MAX_WORKERS and size <= MAX_DESCRIBED_BYTES


def _told_size(message: wire.Register) -> int:
    failed = message.failed_environments
    return sum(map(len, (*message.undescribed, *failed, *failed.values())))


def register(state: State, event: WorkerRegistered, kernel: Kernel, step: CoreStep) -> Worker:
    """Add a worker, or replace it under a new session."""
    message = event.message
    profile = _profile(state, event)
    old = state.workers.get(message.worker)
    worker = Worker(
        name=message.worker,
        session=event.session,
        slots=max(1, message.slots),
        host=message.host,
        profile=profile,
        last_seen=step.now,
        kernel=kernel,
        machine=event.machine,
        cpu=message.fingerprint.cpu,
        installation=message.installation,
        missing_tiers=dict(message.missing_tiers),
        state="lost",
        undescribed=frozenset(message.undescribed),
        failed_environments=dict(message.failed_environments),
        told_size=_told_size(message),
    )
    if old is not None:
        count_out(old)
        worker.leases, worker.held, worker.n_live = old.leases, old.held, old.n_live
        worker.alone = old.alone
        worker.failures, worker.benched_until = old.failures, old.benched_until
        for lease in worker.leases.values():
            lease.orphan_until = step.now + state.settings.adoption_s
        state.sessions.pop(old.session, None)
        pop_entry(state.machines, old.machine, old.name)
    for env in (*(each.env for each in message.environments), *message.failed_environments):
        state.awaited.pop(env, None)
    state.workers[message.worker] = worker
    state.machines.setdefault(worker.machine, {})[worker.name] = worker
    state.sessions[worker.session] = worker.name
    count_in(state, worker)
    if old is not None and old.profile is not profile:
        _drop_unused(state, old.profile)
    if worker.benched_until > step.now:
        state.timers.arm(("bench", worker.name), worker.benched_until)
    state.timers.arm(("worker", worker.name), step.now + state.settings.adoption_s)
    return worker


def _profile(state: State, event: WorkerRegistered) -> Profile:
    message = event.message
    descriptions = {description.env: description for description in message.environments}
    fingerprints = {env: message.fingerprint.of(each) for env, each in descriptions.items()}
    cpu = state.settings.fingerprint_cpu
    classes = {env: each.class_name(cpu=cpu) for env, each in fingerprints.items()}
    key = frozenset(classes.items()), frozenset[Tier](message.tiers)
    profile = state.profiles.get(key)
    if profile is None:
        profile = Profile(key, message.fingerprint, descriptions, fingerprints, classes, event.size)
        queue.add_profile(state, profile)
    return profile


def _drop_unused(state: State, profile: Profile) -> None:
    """Forget a profile if no worker has it. A worker may come with another one each time."""
    if all(worker.profile is not profile for worker in state.workers.values()):
        queue.drop_profile(state, profile)


def count_in(state: State, worker: Worker) -> None:
    """Make a worker active, unless an operator drained or paused it."""
    worker.state = state.out_of_service.get(worker.name, "active")
    if worker.state == "active":
        worker.profile.workers[worker.name] = None
        worker.profile.slots += worker.slots


def count_out(worker: Worker, state: Literal[OutOfService, "lost"] = "lost") -> None:
    """Take a worker out of service: it gets no more work."""
    if worker.state == "active":
        del worker.profile.workers[worker.name]
        worker.profile.slots -= worker.slots
    worker.state = state
    unpark(worker)
    if worker.reserved is not None:
        worker.reserved.reserved = None
        worker.reserved = None


def set_state(state: State, name: str, to: Literal["active", OutOfService]) -> None:
    """Apply a state set by an operator; also for a worker that is not connected."""
    state.out_of_service.pop(name, None)
    if to != "active":
        state.out_of_service[name] = to
    worker = state.workers.get(name)
    if worker is None or worker.state in ("lost", to):
        return
    if to == "active":
        count_in(state, worker)
    else:
        count_out(worker, to)


def forget(state: State, worker: Worker) -> None:
    """Remove a worker that was lost long ago."""
    del state.workers[worker.name]
    state.sessions.pop(worker.session, None)
    pop_entry(state.machines, worker.machine, worker.name)
    _drop_unused(state, worker.profile)


def answer_beat(state: State, worker: Worker, stop: tuple[str, ...], step: CoreStep) -> None:
    """Answer a worker's delayed heartbeat, if there is one."""
    request, worker.beat = worker.beat, None
    if request is None:
        return
    state.timers.disarm(("beat", worker.name))
    drain = state.out_of_service.get(worker.name) == "draining"
    step.reply(request, wire.HeartbeatReply(cancelled=stop, drain=drain, describe=_wanted(state, worker)))


def _wanted(state: State, worker: Worker) -> tuple[str, ...]:
    """Environments that runs, evaluations or operators wait for, and that the worker has yet to describe."""
    if not worker.undescribed:
        return ()
    waiting = [*state.awaited, *(flow.env for flow in state.unpinned.values())]
    # Pinned before a restart of its workers, which describe anew what their caches have lost.
    waiting += [lane.key[0] for lane in state.lanes.values() if lane.n_flows and not lane.workers()]
    return tuple(sorted(worker.undescribed.intersection(waiting)))


def await_description(state: State, event: DescriptionAwaited, step: CoreStep) -> None:
    """Have the environment described by the workers that offer it, with their next heartbeats."""
    if any(event.env in worker.undescribed for worker in state.workers.values()):
        state.awaited[event.env] = None


def drop_poll(state: State, worker: Worker, step: CoreStep) -> None:
    """Answer a worker's waiting poll with no leases."""
    if worker.poll is not None:
        answer_poll(state, worker, (), step)


def answer_poll(
    state: State,
    worker: Worker,
    leases: tuple[wire.Lease, ...],
    step: CoreStep,
    cancelled: tuple[str, ...] = (),
) -> None:
    poll = worker.poll
    assert poll is not None
    unpark(worker)
    state.timers.disarm(("lease", worker.name))
    worker.poll = None
    step.reply(poll.request, wire.Leases(leases=leases, cancelled=cancelled))


def poll_ended(state: State, name: str, step: CoreStep) -> None:
    """A lease poll has timed out."""
    worker = state.workers.get(name)
    if worker is not None:
        drop_poll(state, worker, step)


def beat_ended(state: State, name: str, step: CoreStep) -> None:
    """A heartbeat's delay is over."""
    worker = state.workers.get(name)
    if worker is not None:
        answer_beat(state, worker, (), step)


# ---- availability ----


def available(worker: Worker, now: float) -> bool:
    """Whether a worker may be granted more leases."""
    return worker.state == "active" and worker.alone is None and worker.benched_until <= now


def park(worker: Worker) -> None:
    """List a worker whose poll waits and could be answered now."""
    profile = worker.profile
    if worker.poll is None or worker.name in profile.parked:
        return
    profile.parked[worker.name] = None
    for item in worker.poll.warm:
        profile.warm.setdefault(item, {})[worker.name] = None


def unpark(worker: Worker) -> None:
    """Unlist a worker whose poll no longer waits or cannot be answered now."""
    profile = worker.profile
    if worker.name not in profile.parked:
        return
    assert worker.poll is not None
    del profile.parked[worker.name]
    for item in worker.poll.warm:
        pop_entry(profile.warm, item, worker.name)


def failed(state: State, worker: Worker, step: CoreStep) -> None:
    """Count one more failure through the worker's own fault; bench it after `BENCH_AFTER` in a row."""
    worker.failures += 1
    if worker.failures >= BENCH_AFTER:
        settings = state.settings
        pause_s = min(settings.retry_max_s, settings.retry_base_s * 2.0 ** min(worker.failures, 30))
        worker.benched_until = step.now + pause_s
        unpark(worker)
        state.timers.arm(("bench", worker.name), worker.benched_until)
        step.log("warning", "worker_benched", worker=worker.name, failures=worker.failures, pause_s=pause_s)


def unreserve(state: State, job: JobState) -> None:
    """Stop emptying a worker for a suspect; the worker may get other work."""
    if job.reserved is not None:
        worker = state.workers[job.reserved]
        worker.reserved = job.reserved = None
        state.freed[worker.name] = None


# ---- pins ----


def offer(state: State, flow: Flow) -> Profile | None:
    """Among the profiles that can serve an unpinned flow, one of the class with the most slots; None
    when no profile can."""
    able = [profile for profile in state.profiles.values() if profile.workers and profile.offers(flow)]
    slots: dict[str, int] = {}
    for profile in able:
        name = profile.classes[flow.env]
        slots[name] = slots.get(name, 0) + profile.slots
    return max(able, key=lambda profile: slots[profile.classes[flow.env]], default=None)
