"""What workers say, and what operators say of them: who is there, who may have work, and under which class.

Rules that this module owns:
- A request under a session that is not the worker's present one is refused, upon which the worker registers again.
- A heartbeat's answer may be held back; it comes at once when there is a lease to stop.
- A liveliness token that went is a hint: it brings the worker's deadline forward, nothing else.
- A name is its machine's as long as the worker is there.
- Whatever a quarantined worker asks is refused with the reason; what it holds is played by others, and what it hands in
  from then on is not taken. An operator may take it back.
- Draining, pausing and quarantine outlive restarts. An operator's change of a run's fingerprint class is recorded in the run.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.wire.refusals import Refusal

from . import events, handin, status
from .isolation import NO_BOOT_ID
from .records import WorkerRow
from .turn import Turn
from .workers import Worker

if TYPE_CHECKING:
    from .machine import Core


def registered(core: Core, event: events.WorkerRegistered, turn: Turn) -> None:
    """A worker joins, or joins again under a new session."""
    message = event.message
    if _refused_as_forger(core, message.worker, event.machine, event.request, turn):
        return
    old = core.fleet.workers.get(message.worker)
    if old is not None and old.state != "lost" and old.machine != event.machine:
        # Else one machine could play under another's name, and have it blamed.
        text = f"a worker of another machine is called {message.worker!r}; choose another --name"
        turn.refuse(event.request, Refusal.NAME_TAKEN, text)
        return
    if old is not None:
        core.scheduler.drop_poll(old, turn)
        if old.beat is not None:
            core.fleet.answer_beat(old, (), turn)
    core.timers.disarm(("forget", message.worker))
    worker = core.fleet.register(event, core.isolation.kernel(message.boot_id), turn)
    core.isolation.joined(worker, turn)
    if old is not None and old.kernel is not worker.kernel:
        core.isolation.forgotten(old)
    reply = wire.Registered(
        session=event.session,
        lease_ttl_s=core.settings.lease_ttl_s,
        heartbeat_s=core.settings.heartbeat_s,
        refused=status.refused_runs(core, worker),
        hidden_bar="" if message.boot_id or not core.isolation.on else NO_BOOT_ID,
    )
    turn.reply(event.request, reply)
    name = worker.profile.fingerprint_class
    turn.log("info", "worker_registered", worker=worker.name, slots=worker.slots, fingerprint_class=name)
    _pin_waiting(core, worker, turn)


def _pin_waiting(core: Core, worker: Worker, turn: Turn) -> None:
    """A worker may have work again: runs that nobody could serve when they were opened are pinned now."""
    for flow in list(core.unpinned.values()):
        if flow.env in worker.profile.key[0] and flow.tier in worker.profile.key[1]:
            core.pin(flow, turn)


def _refused_as_forger(core: Core, name: str, machine: str, request: events.RequestId, turn: Turn) -> bool:
    fleet = core.fleet
    forger = name if name in fleet.quarantined else fleet.quarantined_machines.get(machine)
    if forger is None:
        return False
    same = "" if forger == name else f" (as {forger!r} of the same machine)"
    text = f"worker {name!r} gets no more work here: {fleet.quarantined[forger]}{same}"
    turn.refuse(request, Refusal.QUARANTINED, text)
    return True


def worker_of(
    core: Core, event: events.Asked[wire.LeaseRequest | wire.Heartbeat | wire.HandIn], turn: Turn
) -> Worker | None:
    """Who speaks; None, and the request is refused, when its session is unknown or it is quarantined."""
    message = event.message
    known = core.fleet.workers.get(message.worker)
    if _refused_as_forger(core, message.worker, known.machine if known else "", event.request, turn):
        return None
    was_lost = known is not None and known.state == "lost"
    worker = core.fleet.of_session(message.worker, message.session, turn.now)
    if worker is None:
        text = f"session of worker {message.worker!r} is not known here; register again"
        turn.refuse(event.request, Refusal.UNKNOWN_WORKER, text)
    else:
        core.timers.arm_once(("worker", worker.name), turn.now + core.settings.lease_ttl_s)
        if was_lost:
            _pin_waiting(core, worker, turn)
    return worker


def lease_requested(core: Core, event: events.Asked[wire.LeaseRequest], turn: Turn) -> None:
    """A worker asks for work."""
    worker = worker_of(core, event, turn)
    if worker is not None:
        core.scheduler.poll(worker, event, turn)


def heartbeat(core: Core, event: events.Asked[wire.Heartbeat], turn: Turn) -> None:
    """Renew the leases that a worker lists, and tell it which to stop."""
    message = event.message
    worker = worker_of(core, event, turn)
    if worker is None:
        return
    if worker.beat is not None:
        core.fleet.answer_beat(worker, (), turn)
    stop = core.book.hear(worker, message.held, turn, settled=message.settled)
    worker.beat = event.request
    if stop or not message.wait_s > 0.0:
        core.fleet.answer_beat(worker, stop, turn)
    else:
        core.timers.arm(("beat", worker.name), turn.now + min(message.wait_s, core.settings.max_wait_s))


def handed_in(core: Core, event: events.Asked[wire.HandIn], turn: Turn) -> None:
    """Take results, and answer once they are durable."""
    worker = worker_of(core, event, turn)
    if worker is None:
        return
    for result in event.message.results:
        handin.take(core, worker, result, turn)
    turn.reply(event.request, wire.HandInReply(n=len(event.message.results)))


def liveness_lost(core: Core, event: events.LivenessLost, turn: Turn) -> None:
    """A hint only: the worker's leases are looked at sooner than they would be."""
    worker = core.fleet.workers.get(event.worker)
    if worker is not None and worker.state != "lost" and worker.doubted_at is None:
        worker.doubted_at = turn.now
        core.timers.arm(("worker", worker.name), turn.now + core.settings.liveness_grace_s)


def worker_state(core: Core, event: events.Asked[operator.SetWorker], turn: Turn) -> None:
    """Drain or pause a worker, or take it back; durable, also for one that is not connected."""
    message = event.message
    if message.state != "active" and message.worker in core.fleet.quarantined:
        text = f"{message.worker} is quarantined: {core.fleet.quarantined[message.worker]}"
        turn.refuse(event.request, Refusal.QUARANTINED, text)
        return
    turn.persist(WorkerRow(worker=message.worker, state=message.state))
    worker = core.fleet.workers.get(message.worker)
    if worker is not None and message.state != "active":
        core.scheduler.drop_poll(worker, turn)
    core.fleet.set_state(message.worker, message.state)
    if worker is not None:
        if worker.beat is not None:
            core.fleet.answer_beat(worker, (), turn)
        core.scheduler.emptied(worker)
        _pin_waiting(core, worker, turn)
        for lane in worker.profile.lanes.values():
            turn.dirty[lane] = None
    turn.reply(event.request, operator.Done())


def repinned(core: Core, event: events.Asked[operator.RepinRun], turn: Turn) -> None:
    """Pin an unfinished run to another class of workers, as an operator says."""
    message = event.message
    run = core.runs.get(message.run)
    offered = {
        profile.fingerprint_class: profile
        for profile in core.queue.profiles.values()
        if run is not None and run.flow.env in profile.descriptions and run.flow.tier in profile.key[1]
    }
    if run is None:
        turn.refuse(event.request, Refusal.UNKNOWN_RUN, f"there is no unfinished run {message.run!r}")
    elif message.fingerprint_class not in offered:
        text = f"no worker of class {message.fingerprint_class!r} can play it; there are {', '.join(offered) or 'none'}"
        turn.refuse(event.request, Refusal.UNKNOWN_CLASS, text)
    else:
        text = f"{run.state.fingerprint_class} → {message.fingerprint_class}: {message.reason}"
        profile = offered[message.fingerprint_class]
        run.change(
            turn,
            fingerprint_class=message.fingerprint_class,
            overrides=(*run.state.overrides, text),
            description=run.state.description or profile.descriptions[run.flow.env],
            fingerprint=run.state.fingerprint or profile.fingerprint,
        )
        run.flow.description = run.state.description
        core.place(run.flow, message.fingerprint_class, turn)
        turn.log("warning", "run_repinned", run=run.id, override=text)
        turn.reply(event.request, operator.Done())
