"""Audits: the recorded actions of a sampled share of the reported episodes are replayed on other workers.

Rules that this module owns:
- The run's secret determines the sample, so no worker can predict which of its episodes are drawn.
- An episode is never audited by its player, and only by workers of the same versions and processor features: others may
  honestly get other bits. Nondeterministic environments are not audited.
- An audit replays recorded actions without the policy: a policy that reads a clock changes nothing. The auditor
  receives the actions only, so it cannot echo the results that it should confirm.
- Where machines have credentials of their own, player and auditors are on different machines, and a forger's machine is
  quarantined with it: the owner of several workers has one vote.
- Two workers that disagree are in dispute; a third one decides. The worker that stands alone against two is named and
  gets no more leases. A dispute changes no committed outcome; the run's record reports it.
- Audits are last in the queue and are stopped for any train job. A run that is otherwise done waits for them
  `CoreSettings.audit_wait_s` at most, and not at all for audits that no other worker can play. Time during which a
  hidden audit is kept from all workers that could play it (`isolation`) does not count.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterator
from typing import Any

import msgspec

from evopolicy_common.messages.audit import AuditFinding, AuditRecord
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import CompareAudit, PrepareAudit
from evopolicy_coordinator.core.contract.reasons import Reason, because
from evopolicy_coordinator.core.contract.records import AuditRow, WorkerRow, shared
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.leasing import expiry, fleet, groups
from evopolicy_coordinator.core.runs import templates
from evopolicy_coordinator.core.tables.model import Run, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import AuditsMoved, EpisodesDone, Step

NOT_REPEATABLE = "the environment is marked as not deterministic"
NO_STEPS = "no step was played"
CHECK_S = 5.0
"""Interval at which a run that waits for its audits checks whether a worker can still play them."""

FINDINGS_MAX = 100
"""Findings that a run's record keeps."""

ONE_WORKER = "one worker only"
ONE_MACHINE = "one machine only"
OTHERS_DIFFER = "the other workers have other versions or processors"
UNKNOWN_KERNEL = "the other workers' kernels are not known"
TOO_LATE = "nobody played it again in time"
CANCELLED = "the run was cancelled"
FORGING_AUDITOR = "only a forger had played it again"
MOST_INSTALLATIONS = 64
"""A run's record names no more: a worker may register as often as it wants, each time with another one."""


def drawn(secret: bytes, group: str, index: int, share: float) -> bool:
    """Whether the episode at `index` of a group is in the sampled `share` (0 to 1)."""
    digest = hmac.digest(secret, f"audit|{group}|{index}".encode(), hashlib.sha256)
    return int.from_bytes(digest[:8], "big") < share * 2.0**64


def audit_id(group: str, index: int) -> str:
    """Id of an audit; the group of its k-th replay (from 1) is `id.k`."""
    return f"{group}/audit-{index}"


# ---- course of an audit ----


def sample(state: State, news: EpisodesDone, step: Step) -> None:
    """Note who played the episodes that a worker has reported, and draw audits from them."""
    group, worker = news.group, news.worker
    run, kind = state.runs.get(group.run), group.kind
    if run is None or worker is None or kind == "evaluation" or kind == "audit":
        return
    run.played[worker.name] = run.played.get(worker.name, 0) + len(news.outcomes)
    known = run.state.installations
    if worker.installation and worker.installation not in known and len(known) < MOST_INSTALLATIONS:
        step.change_run(run, installations=(*known, worker.installation))
    if not run.row.audit_share:
        return
    description = run.state.description
    for outcome in news.outcomes:
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
            numerics=worker.numerics(run.flow.env),
            state="not_audited" if reason else "open",
            reason=reason,
        )
        step.put_audit(run, row)
        if row.state == "open":
            step.add(_prepare(row, step))


def _prepare(row: AuditRow, step: Step) -> PrepareAudit:
    return shared(PrepareAudit, row, stimulus_id=step.stimulus_id)


def prepared(state: State, event: events.AuditPrepared, step: Step) -> None:
    """The actions of an audited episode are stored as a blob, or could not be read."""
    run, row = _open(state, event.run, event.audit)
    if run is None or row is None or row.actions is not None:
        return
    if event.actions is None:
        settle(
            state, run, row, step, verdict="disputed" if event.at_fault else "not_audited", reason=event.error
        )
        if event.at_fault:
            dispute(state, f"{row.player} reported {row.group}, episode {row.index}: {event.error}", step)
    else:
        _play(state, run, step.put_audit(run, msgspec.structs.replace(row, actions=event.actions)), step)
    step.tell(AuditsMoved(run))


def replayed(state: State, news: EpisodesDone, step: Step) -> None:
    """A worker has replayed an audited episode."""
    group, worker = news.group, news.worker
    if worker is None:
        return  # loaded from the store, where its audit's row names the auditor
    run, row = _open(state, group.run, group.id.rpartition(".")[0])
    groups.close_group(state, group, step)
    if run is not None and row is not None:
        machines = (*row.machines, worker.machine) if worker.machine else row.machines
        row = msgspec.structs.replace(row, replayed_by=(*row.replayed_by, worker.name), machines=machines)
        step.add(_compare(step.put_audit(run, row), step))


def _compare(row: AuditRow, step: Step) -> CompareAudit:
    replays = tuple(f"{row.audit}.{n + 1}" for n in range(len(row.replayed_by)))
    return shared(CompareAudit, row, replays=replays, stimulus_id=step.stimulus_id)


def compared(state: State, event: events.AuditCompared, step: Step) -> None:
    """The last replay was compared with the player's report, and with the replay before it."""
    run, row = _open(state, event.run, event.audit)
    if run is None or row is None or event.replay != len(row.replayed_by) or row.compared >= event.replay:
        return
    row = msgspec.structs.replace(row, compared=event.replay)
    if event.error:
        settle(state, run, row, step, verdict="not_audited", reason=event.error)
    elif event.with_player is None:
        settle(state, run, row, step, verdict="agreed")
        if row.difference:
            _name(state, row.replayed_by[0], row, step)
    elif event.replay == 1:
        row = step.put_audit(run, msgspec.structs.replace(row, difference=event.with_player))
        step.log("warning", "audit_differs", player=row.player, auditor=row.replayed_by[0], audit=row.audit,
                 difference=row.difference)  # fmt: skip
        if row.player in state.quarantined:
            _refuted(state, run, row, step)
        else:
            _play(state, run, row, step)
    elif event.with_first is None:
        _refuted(state, run, row, step)
        _name(state, row.player, row, step)
    else:
        settle(state, run, row, step, verdict="disputed", reason="three workers, three results")
        dispute(state, words(row), step)
    step.tell(AuditsMoved(run))


def _refuted(state: State, run: Run, row: AuditRow, step: Step) -> None:
    settle(state, run, row, step, verdict="disputed", reason="refuted", forger=row.player)


def _open(state: State, run_id: str, audit: str) -> tuple[Run | None, AuditRow | None]:
    """Returns the run and its audit; None for an audit that is not open."""
    run = state.runs.get(run_id)
    row = None if run is None else run.audits.get(audit)
    return run, row if row is not None and row.state == "open" else None


def settle(state: State, run: Run, row: AuditRow, step: Step, *, verdict: str, **fields: Any) -> None:
    """Settle an audit with its verdict, and close its groups."""
    for n in range(1, len(row.replayed_by) + 2):
        group = state.groups.get(f"{row.audit}.{n}")
        if group is not None:
            groups.close_group(state, group, step)
    row = step.put_audit(run, msgspec.structs.replace(row, actions=None, state=verdict, **fields))


def _play(state: State, run: Run, row: AuditRow, step: Step) -> None:
    """Queue the next replay of an audit, for a worker that has not played the episode."""
    groups.open_group(state, templates.audit(run, row, step), step)


def resume(state: State, run: Run, step: Step) -> None:
    """Resume a run's open audits in a core that was just loaded."""
    for row in list(run.audits.values()):
        if row.state != "open":
            continue
        if row.actions is None:
            step.add(_prepare(row, step))
        elif len(row.replayed_by) > row.compared:
            step.add(_compare(row, step))
        else:
            _play(state, run, row, step)


# ---- forgers ----


def words(row: AuditRow) -> str:
    """The dispute in words: the workers, the episode, and the difference."""
    others = " and ".join(row.replayed_by)
    return f"{row.player} and {others} disagree about {row.group}, episode {row.index}: {row.difference}"


def undecided(state: State) -> list[str]:
    """Disputes of unfinished runs that wait for a third worker, in words."""
    rows = [row for run in state.runs.values() for row in run.audits.values()]
    return [f"{words(row)}; a third is to decide" for row in rows if row.state == "open" and row.difference]


def dispute(state: State, text: str, step: Step) -> None:
    """Report a dispute to operators."""
    state.disputes.append(text)
    step.log("error", "audit_disputed", what=text)


def _name(state: State, name: str, row: AuditRow, step: Step) -> None:
    """Quarantine a worker, with its machine, whose report two others refute."""
    verb = "reported" if name == row.player else "played again"
    text = (
        f"forged results: two other workers refute what it {verb} as {row.group}, episode {row.index}"
        f" ({row.difference})"
    )
    if name in state.quarantined:
        return
    workers = state.workers
    machine = workers[name].machine if name in workers else ""
    step.log("error", "forger_named", worker=name, machine=machine, why=text)
    beside = [
        each.name for each in workers.values() if machine and each.machine == machine and each.name != name
    ]
    for each, why in (*((other, f"its machine's {name} {text}") for other in beside), (name, text)):
        step.persist(WorkerRow(worker=each, state="quarantined", reason=why, machine=machine))
        fleet.set_state(state, each, "quarantined", why, machine)
        expiry.take_away(state, each, step)
    for run in list(state.runs.values()):
        for other in list(run.audits.values()):
            if other.state == "open" and other.player == name and other.difference:
                _refuted(state, run, other, step)
        step.tell(AuditsMoved(run))


# ---- the end of a run's audits ----


def holds_up(state: State, run: Run, step: Step) -> bool:
    """Whether a run that is otherwise done still waits for audits; gives up the open ones when it no longer waits."""
    waiting = [row for row in run.audits.values() if row.state == "open"]
    if not waiting:
        state.timers.disarm(("audits", run.id))
        return False
    if run.audits_checked_at is not None and all(_playable(state, run, row) for row in waiting):
        run.audits_waited_s += step.now - run.audits_checked_at
    run.audits_checked_at = step.now
    remaining_s = state.settings.audit_wait_s - run.audits_waited_s
    # After a start, or after the loop was blocked, workers may not have returned yet.
    in_vain = step.now >= state.hold_until and all(_obstacle(state, run, row) for row in waiting)
    if remaining_s > 0.0 and not in_vain:
        state.timers.arm(("audits", run.id), step.now + min(remaining_s, CHECK_S))
        return True
    state.timers.disarm(("audits", run.id))
    for row in waiting:
        _give_up(state, run, row, _obstacle(state, run, row) or TOO_LATE, step)
    return False


def _give_up(state: State, run: Run, row: AuditRow, reason: str, step: Step) -> None:
    if not row.difference:
        settle(state, run, row, step, verdict="not_audited", reason=reason)
    elif row.replayed_by[0] in state.quarantined:
        settle(state, run, row, step, verdict="not_audited", reason=FORGING_AUDITOR)
    else:
        settle(state, run, row, step, verdict="disputed", reason="no third worker to decide")
        dispute(state, words(row), step)


def _obstacle(state: State, run: Run, row: AuditRow) -> str:
    """Why no known worker can play the audit's next replay; empty when one can, or while the
    shell stores or compares."""
    if row.actions is None or len(row.replayed_by) > row.compared:
        return ""
    reason = ONE_WORKER
    for _, why in _auditors(state, run, row):
        if not why:
            return ""
        reason = why if reason == ONE_WORKER or why != ONE_MACHINE else reason
    return reason


def _playable(state: State, run: Run, row: AuditRow) -> bool:
    """Whether waiting for the audit counts: a worker may play its next replay now, or none ever can, or the
    shell stores or compares."""
    if row.actions is None or len(row.replayed_by) > row.compared or row.kind not in templates.HIDDEN_SPLITS:
        return True
    able = [worker for worker, why in _auditors(state, run, row) if not why]
    return (
        not able
        or not state.isolates
        or any(conflicts.hidden_conflict(state, run.case_set, worker.kernel) is None for worker in able)
    )


def _auditors(state: State, run: Run, row: AuditRow) -> Iterator[tuple[Worker, str]]:
    """Workers that have not played the episode, each with the reason why it cannot replay it; empty when it can."""
    for worker in state.workers.values():
        had = worker.name == row.player or worker.name in row.replayed_by
        shut_out = worker.name in state.quarantined or worker.machine in state.quarantined_machines
        if had or shut_out or run.flow.env not in worker.profile.descriptions:
            continue
        if worker.machine in row.machines:
            yield worker, ONE_MACHINE
        elif worker.numerics(run.flow.env) != row.numerics:
            yield worker, OTHERS_DIFFER
        elif state.isolates and row.kind in templates.HIDDEN_SPLITS and worker.kernel is state.everywhere:
            yield worker, UNKNOWN_KERNEL
        else:
            yield worker, ""


def cancel(state: State, run: Run, step: Step) -> None:
    """Give up the open audits of a run that ends."""
    for row in list(run.audits.values()):
        if row.state == "open":
            _give_up(state, run, row, CANCELLED, step)


def waits_for(run: Run) -> Reason | None:
    """The audits that a run, otherwise done, waits for; None for none."""
    n = sum(row.state == "open" for row in run.audits.values())
    return because("audits", n=n) if n else None


def record(state: State, run: Run) -> AuditRecord | None:
    """The record of a finished run's audits; None if no episode was to be audited and no forger played in it."""
    rows = list(run.audits.values())
    named = {
        row.replayed_by[0] if row.state == "agreed" else row.forger for row in rows if _is_reported(row)
    } - {""}
    named |= {name for name in run.played if name in state.quarantined}
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
        findings=tuple(_finding(row) for row in rows if _is_reported(row))[:FINDINGS_MAX],
    )


def _is_reported(row: AuditRow) -> bool:
    return row.state == "disputed" or (row.state == "agreed" and bool(row.difference))


def _finding(row: AuditRow) -> AuditFinding:
    return shared(
        AuditFinding,
        row,
        split=row.kind,
        episode=row.index,
        auditors=row.replayed_by,
        difference=row.difference or row.reason,
        forger=row.replayed_by[0] if row.state == "agreed" else row.forger,
    )
