"""Audits: of a sampled share of the episodes that workers hand in, the recorded actions are played again elsewhere.

Rules that this module owns:
- Which episodes are drawn follows from the run's secret, so no worker can tell which of its own they will be.
- An episode is never audited by its player, and only by workers of the same versions and processor features: others may
  honestly come to other bits. Environments that do not repeat themselves are not audited.
- Recorded actions are played, no policy: what a policy reads from a clock changes nothing. Who plays them again is told
  the actions alone, so it cannot echo what it should confirm.
- Where machines have credentials of their own, player and auditors are of as many machines, and a forger's machine goes
  with it: whoever brings several workers has one voice.
- Two workers that disagree are in dispute; a third opinion decides. Who stands alone against two is named and gets no
  more leases. What is settled stays, once and for all; the run says that it is in question.
- Audits come last in the queue and are stopped for any train job. A run that is otherwise done waits for them
  `CoreSettings.audit_wait_s` at most, and not at all for what no other worker can play. Time in which a hidden one is kept
  from all workers that could play it (`isolation`) does not count.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import msgspec

from evopolicy_common.messages.audit import AuditFinding, AuditRecord
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeOutcome

from . import events
from .effects import CompareAudit, PrepareAudit
from .isolation import HIDDEN_SPLITS
from .jobs import AUDIT, HIDDEN_AUDIT, JobGroup, Template
from .records import AuditRow, WorkerRow
from .runs import Run
from .turn import Turn
from .workers import Worker

if TYPE_CHECKING:
    from .machine import Core

LOOK_AGAIN_S = 5.0
"""A run that waits for its audits sees so often whether anyone can still play them."""

FINDINGS_MAX = 100
"""Findings that a run's record keeps."""

ONE_WORKER = "one worker only"
ONE_MACHINE = "one machine only"
OTHERS_DIFFER = "the other workers have other versions or processors"
UNKNOWN_KERNEL = "the other workers' kernels are not known"
NOT_REPEATABLE = "the environment is marked as not deterministic"
NO_STEPS = "no step was played"
TOO_LATE = "nobody played it again in time"
CANCELLED = "the run was cancelled"
FORGING_AUDITOR = "only a forger had played it again"


def drawn(secret: bytes, group: str, index: int, share: float) -> bool:
    """Whether the episode at `index` of a group is among the sampled `share`."""
    digest = hmac.digest(secret, f"audit|{group}|{index}".encode(), hashlib.sha256)
    return int.from_bytes(digest[:8], "big") < share * 2.0**64


def audit_id(group: str, index: int) -> str:
    """What an audit is called; the group of its k-th replay (from 1) is `id.k`."""
    return f"{group}/audit-{index}"


# ---- how an audit goes ----


def sample(
    core: Core, worker: Worker, group: JobGroup, outcomes: tuple[EpisodeOutcome, ...], turn: Turn
) -> None:
    """Draw from the episodes that a worker has handed in."""
    run, kind = core.runs.get(group.run), group.kind
    if run is None or kind == "evaluation" or kind == "audit":
        return
    run.played[worker.name] = run.played.get(worker.name, 0) + len(outcomes)
    if not run.row.audit_share:
        return
    description = run.state.description
    for outcome in outcomes:
        if not drawn(run.row.secret, group.id, outcome.index, run.row.audit_share):
            continue
        reason = ""
        if description is not None and not description.deterministic:
            reason = NOT_REPEATABLE
        elif outcome.trajectory is None or not outcome.length:
            reason = NO_STEPS
        row = AuditRow(
            run=run.id,
            audit=audit_id(group.id, outcome.index),
            group=group.id,
            index=outcome.index,
            kind=kind,
            submit_index=group.submit_index,
            player=worker.name,
            machines=(worker.machine,) if worker.machine else (),
            numerics=worker.numerics,
            state="not_audited" if reason else "open",
            reason=reason,
        )
        _put(run, row, turn)
        if row.state == "open":
            turn.add(_prepare(row, turn))


def _put(run: Run, row: AuditRow, turn: Turn) -> AuditRow:
    run.audits[row.audit] = row
    turn.persist(row)
    return row


def _prepare(row: AuditRow, turn: Turn) -> PrepareAudit:
    return PrepareAudit(
        run=row.run, audit=row.audit, group=row.group, index=row.index, stimulus_id=turn.stimulus_id
    )


def prepared(core: Core, event: events.AuditPrepared, turn: Turn) -> None:
    """The actions of an audited episode are stored by themselves, or could not be read."""
    run, row = _open(core, event.run, event.audit)
    if run is None or row is None or row.actions is not None:
        return
    if event.actions is None:
        _settle(
            core, run, row, turn, state="disputed" if event.at_fault else "not_audited", reason=event.error
        )
        if event.at_fault:
            _dispute(core, f"{row.player} handed in {row.group}, episode {row.index}: {event.error}", turn)
    else:
        _play(core, run, _put(run, msgspec.structs.replace(row, actions=event.actions), turn), turn)
    core.audits_moved(run, turn)


def replayed(core: Core, worker: Worker, group: JobGroup, turn: Turn) -> None:
    """A worker has played an audited episode again."""
    run, row = _open(core, group.run, group.id.rpartition(".")[0])
    core.close_group(group, turn, "played again")
    if run is not None and row is not None:
        machines = (*row.machines, worker.machine) if worker.machine else row.machines
        row = msgspec.structs.replace(row, replayed_by=(*row.replayed_by, worker.name), machines=machines)
        turn.add(_compare(_put(run, row, turn), turn))


def _compare(row: AuditRow, turn: Turn) -> CompareAudit:
    return CompareAudit(
        run=row.run,
        audit=row.audit,
        group=row.group,
        index=row.index,
        replays=tuple(f"{row.audit}.{n + 1}" for n in range(len(row.replayed_by))),
        stimulus_id=turn.stimulus_id,
    )


def compared(core: Core, event: events.AuditCompared, turn: Turn) -> None:
    """The last replay was compared with what its player had handed in, and with the replay before it."""
    run, row = _open(core, event.run, event.audit)
    if run is None or row is None or event.replay != len(row.replayed_by) or row.compared >= event.replay:
        return
    row = msgspec.structs.replace(row, compared=event.replay)
    if event.error:
        _settle(core, run, row, turn, state="not_audited", reason=event.error)
    elif event.with_player is None:
        _settle(core, run, row, turn, state="agreed")
        if row.difference:
            _name(core, row.replayed_by[0], row, turn)
    elif event.replay == 1:
        row = _put(run, msgspec.structs.replace(row, difference=event.with_player), turn)
        turn.log("warning", "audit_differs", player=row.player, auditor=row.replayed_by[0], audit=row.audit,
                 difference=row.difference)  # fmt: skip
        if row.player in core.fleet.quarantined:
            _refuted(core, run, row, turn)
        else:
            _play(core, run, row, turn)
    elif event.with_first is None:
        _refuted(core, run, row, turn)
        _name(core, row.player, row, turn)
    else:
        _settle(core, run, row, turn, state="disputed", reason="three workers, three results")
        _dispute(core, _words(row), turn)
    core.audits_moved(run, turn)


def _refuted(core: Core, run: Run, row: AuditRow, turn: Turn) -> None:
    _settle(core, run, row, turn, state="disputed", reason="refuted", forger=row.player)


def _open(core: Core, run_id: str, audit: str) -> tuple[Run | None, AuditRow | None]:
    """The run and its audit, as long as that is open."""
    run = core.runs.get(run_id)
    row = None if run is None else run.audits.get(audit)
    return run, row if row is not None and row.state == "open" else None


def _settle(core: Core, run: Run, row: AuditRow, turn: Turn, **fields: Any) -> None:
    """The audit is over; nothing more is played for it."""
    for n in range(1, len(row.replayed_by) + 2):
        group = core.groups.get(f"{row.audit}.{n}")
        if group is not None:
            core.close_group(group, turn, "its audit is over")
    row = _put(run, msgspec.structs.replace(row, actions=None, **fields), turn)
    core.chronicle.tell(turn.now, turn.stimulus_id, row.audit, f"audit: {row.state} {row.reason}")


def _play(core: Core, run: Run, row: AuditRow, turn: Turn) -> None:
    """Queue the next replay of an audit, for a worker that has not had to do with the episode."""
    settings = run.row.settings
    assert row.actions is not None
    template = Template(
        env=settings.env,
        bundle=None,
        cases=(_case(run, row),),
        case_ids=(row.index,),
        occurrences=(0,),
        secret=run.row.secret,
        split="audit",
        submit_index=row.submit_index,
        modulo=1,
        per_job=1,
        scope="episode",
        env_meta={"env": settings.env},
        observations=settings.observations,
        record="full" if row.kind == "train" else "actions",
        video="off",
        tier=settings.sandbox_tier,
        limits=settings.limits,
        max_steps=run.row.max_steps,
        replays=(row.actions,),
    )
    group = JobGroup(
        id=f"{row.audit}.{len(row.replayed_by) + 1}",
        kind="audit",
        run=run.id,
        submit_index=row.submit_index,
        flow=run.flow,
        template=template,
        stimulus_id=turn.stimulus_id,
        priority=HIDDEN_AUDIT if row.kind in HIDDEN_SPLITS else AUDIT,
        created_at=turn.now,
        not_on=frozenset((row.player, *row.replayed_by)),
        not_of=frozenset(row.machines),
        numerics=row.numerics,
    )
    core.open_group(group, turn)


def _case(run: Run, row: AuditRow) -> Case:
    if row.kind == "train":
        return run.row.train[run.submits[row.submit_index].env_instances[row.index]]
    return (run.row.validation if row.kind == "validation" else run.row.heldout)[row.index]


def resume(core: Core, run: Run, turn: Turn) -> None:
    """Go on, in a core that was just loaded, with what is open of a run's audits."""
    for row in list(run.audits.values()):
        if row.state != "open":
            continue
        if row.actions is None:
            turn.add(_prepare(row, turn))
        elif len(row.replayed_by) > row.compared:
            turn.add(_compare(row, turn))
        else:
            _play(core, run, row, turn)


# ---- forgers ----


def _words(row: AuditRow) -> str:
    others = " and ".join(row.replayed_by)
    return f"{row.player} and {others} disagree about {row.group}, episode {row.index}: {row.difference}"


def undecided(core: Core) -> list[str]:
    """Disputes of unfinished runs that wait for a third worker, in words."""
    rows = [row for run in core.runs.values() for row in run.audits.values()]
    return [f"{_words(row)}; a third is to decide" for row in rows if row.state == "open" and row.difference]


def _dispute(core: Core, text: str, turn: Turn) -> None:
    core.disputes.append(text)
    turn.log("error", "audit_disputed", what=text)


def _name(core: Core, name: str, row: AuditRow, turn: Turn) -> None:
    """A worker was found to have handed in what two others refute: it gets no more leases."""
    said = "handed in" if name == row.player else "played again"
    text = f"forged results: what it {said} as {row.group}, episode {row.index}, two other workers refute ({row.difference})"
    if name in core.fleet.quarantined:
        return
    workers = core.fleet.workers
    machine = workers[name].machine if name in workers else ""
    turn.log("error", "forger_named", worker=name, machine=machine, why=text)
    beside = [
        each.name for each in workers.values() if machine and each.machine == machine and each.name != name
    ]
    for each, why in (*((other, f"its machine's {name} {text}") for other in beside), (name, text)):
        turn.persist(WorkerRow(worker=each, state="quarantined", reason=why, machine=machine))
        core.fleet.set_state(each, "quarantined", why, machine)
        core.book.take_away(each, turn)
    for run in list(core.runs.values()):
        for other in list(run.audits.values()):
            if other.state == "open" and other.player == name and other.difference:
                _refuted(core, run, other, turn)
        core.audits_moved(run, turn)


# ---- the end of a run ----


def holds_up(core: Core, run: Run, turn: Turn) -> bool:
    """Whether a run that is done otherwise still waits for audits; gives up those that are waited for no more."""
    waiting = [row for row in run.audits.values() if row.state == "open"]
    if not waiting:
        core.timers.disarm(("audits", run.id))
        return False
    if run.audits_looked_at is not None and all(_playable(core, run, row) for row in waiting):
        run.audits_waited_s += turn.now - run.audits_looked_at
    run.audits_looked_at = turn.now
    left_s = core.settings.audit_wait_s - run.audits_waited_s
    # After a start or a standstill workers may not have come back yet.
    in_vain = turn.now >= core.hold_until and all(_obstacle(core, run, row) for row in waiting)
    if left_s > 0.0 and not in_vain:
        core.timers.arm(("audits", run.id), turn.now + min(left_s, LOOK_AGAIN_S))
        return True
    core.timers.disarm(("audits", run.id))
    for row in waiting:
        _give_up(core, run, row, _obstacle(core, run, row) or TOO_LATE, turn)
    return False


def _give_up(core: Core, run: Run, row: AuditRow, reason: str, turn: Turn) -> None:
    if not row.difference:
        _settle(core, run, row, turn, state="not_audited", reason=reason)
    elif row.replayed_by[0] in core.fleet.quarantined:
        _settle(core, run, row, turn, state="not_audited", reason=FORGING_AUDITOR)
    else:
        _settle(core, run, row, turn, state="disputed", reason="no third worker to decide")
        _dispute(core, _words(row), turn)


def _obstacle(core: Core, run: Run, row: AuditRow) -> str:
    """Why no worker that is known can play the audit's next replay; empty when one can, or the shell is at it."""
    if row.actions is None or len(row.replayed_by) > row.compared:
        return ""
    reason = ONE_WORKER
    for _, why in _auditors(core, run, row):
        if not why:
            return ""
        reason = why if reason == ONE_WORKER or why != ONE_MACHINE else reason
    return reason


def _playable(core: Core, run: Run, row: AuditRow) -> bool:
    """Whether some worker may play the audit's next replay now, or nobody can, or the shell is at it: waiting counts."""
    if row.actions is None or len(row.replayed_by) > row.compared or row.kind not in HIDDEN_SPLITS:
        return True
    able = [worker for worker, why in _auditors(core, run, row) if not why]
    isolation = core.isolation
    return (
        not able
        or not isolation.on
        or any(isolation.hidden_bar(run.family, worker.kernel) is None for worker in able)
    )


def _auditors(core: Core, run: Run, row: AuditRow) -> Iterator[tuple[Worker, str]]:
    """Workers that have not had to do with the episode, each with why it cannot play it again; empty when it can."""
    fleet, isolation = core.fleet, core.isolation
    for worker in fleet.workers.values():
        had = worker.name == row.player or worker.name in row.replayed_by
        shut_out = worker.name in fleet.quarantined or worker.machine in fleet.quarantined_machines
        if had or shut_out or run.flow.env not in worker.profile.descriptions:
            continue
        if worker.machine in row.machines:
            yield worker, ONE_MACHINE
        elif worker.numerics != row.numerics:
            yield worker, OTHERS_DIFFER
        elif isolation.on and row.kind in HIDDEN_SPLITS and worker.kernel is isolation.everywhere:
            yield worker, UNKNOWN_KERNEL
        else:
            yield worker, ""


def cancel(core: Core, run: Run, turn: Turn) -> None:
    """The run is cancelled: what is open of its audits is played no more."""
    for row in list(run.audits.values()):
        if row.state == "open":
            _give_up(core, run, row, CANCELLED, turn)


def waits_for(run: Run) -> str:
    """What a run that is otherwise done waits for."""
    n = sum(row.state == "open" for row in run.audits.values())
    return f"{n} audits of its episodes on other workers" if n else ""


def record(core: Core, run: Run) -> AuditRecord | None:
    """What a finished run's audits came to; None where nothing was to be audited and no forger played in it."""
    rows = list(run.audits.values())
    named = {row.replayed_by[0] if row.state == "agreed" else row.forger for row in rows if _told(row)} - {""}
    named |= {name for name in run.played if name in core.fleet.quarantined}
    if not run.row.audit_share and not named:
        return None
    why: dict[str, int] = {}
    for row in rows:
        if row.state == "not_audited":
            why[row.reason] = why.get(row.reason, 0) + 1
    states = [row.state for row in rows]
    return AuditRecord(
        share=run.row.audit_share,
        sampled=len(rows),
        audited=states.count("agreed") + states.count("disputed"),
        agreed=states.count("agreed"),
        disputed=states.count("disputed"),
        not_audited=dict(sorted(why.items())),
        forgers={name: run.played.get(name, 0) for name in sorted(named)},
        findings=tuple(_finding(row) for row in rows if _told(row))[:FINDINGS_MAX],
    )


def _told(row: AuditRow) -> bool:
    return row.state == "disputed" or (row.state == "agreed" and bool(row.difference))


def _finding(row: AuditRow) -> AuditFinding:
    return AuditFinding(
        split=row.kind,
        submit_index=row.submit_index,
        episode=row.index,
        player=row.player,
        auditors=row.replayed_by,
        difference=row.difference or row.reason,
        forger=row.replayed_by[0] if row.state == "agreed" else row.forger,
    )
