"""The end of a run's audits: how long the run waits for them, who could still play them, and their record."""

from __future__ import annotations

from collections.abc import Iterator

from evopolicy_common.messages.audit import AuditFinding, AuditRecord
from evopolicy_coordinator.core.contract.reasons import Reason, because
from evopolicy_coordinator.core.contract.records import AuditRow
from evopolicy_coordinator.core.isolation import conflicts
from evopolicy_coordinator.core.runs.audits import dispute, settle, words
from evopolicy_coordinator.core.runs.templates import HIDDEN_SPLITS
from evopolicy_coordinator.core.tables.model import Run, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step

LOOK_AGAIN_S = 5.0
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


def holds_up(state: State, run: Run, step: Step) -> bool:
    """Whether a run that is otherwise done still waits for audits; gives up the open ones when it no longer waits."""
    waiting = [row for row in run.audits.values() if row.state == "open"]
    if not waiting:
        state.timers.disarm(("audits", run.id))
        return False
    if run.audits_checked_at is not None and all(_playable(state, run, row) for row in waiting):
        run.audits_waited_s += step.now - run.audits_checked_at
    run.audits_checked_at = step.now
    left_s = state.settings.audit_wait_s - run.audits_waited_s
    # After a start, or after the loop was blocked, workers may not have returned yet.
    in_vain = step.now >= state.hold_until and all(_obstacle(state, run, row) for row in waiting)
    if left_s > 0.0 and not in_vain:
        state.timers.arm(("audits", run.id), step.now + min(left_s, LOOK_AGAIN_S))
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
    if row.actions is None or len(row.replayed_by) > row.compared or row.kind not in HIDDEN_SPLITS:
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
        elif state.isolates and row.kind in HIDDEN_SPLITS and worker.kernel is state.everywhere:
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
    return AuditFinding(
        split=row.kind,
        submit_index=row.submit_index,
        episode=row.index,
        player=row.player,
        auditors=row.replayed_by,
        difference=row.difference or row.reason,
        forger=row.replayed_by[0] if row.state == "agreed" else row.forger,
    )
