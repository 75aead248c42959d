"""From a snapshot of the store to a core that goes on: nothing accepted is lost, nothing done is played again.

Rules that this module owns:
- Budgets are rebuilt from submits, open groups from submits and outcomes; what was complete but not concluded when the
  process died is concluded first.
- Jobs that were open may be running somewhere: they wait for heartbeats that claim them, for a short while.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import audit, evaluations, finalisation, permits, runs
from .evaluations import Ended
from .jobs import JobGroup
from .records import AuditRow, RunStateRow, Snapshot, SubmitRow, validation_group
from .runs import Run
from .turn import Turn

if TYPE_CHECKING:
    from .machine import Core


def load(core: Core, snapshot: Snapshot, turn: Turn) -> None:
    """Fill an empty core."""
    core.loading = True
    played: dict[str, dict[str, int]] = {}
    for head in snapshot.outcomes:
        core.heads.setdefault(head.group, []).append(head)
        if "/audit-" not in head.group:
            of_run = played.setdefault(head.group.partition("/")[0], {})
            of_run[head.worker] = of_run.get(head.worker, 0) + 1
    for worker in snapshot.workers:
        core.fleet.set_state(worker.worker, worker.state, worker.reason, worker.machine)
    states = {state.run: state for state in snapshot.states}
    core.isolation.load(
        snapshot.permits, snapshot.kernels, {row.run: row for row in snapshot.runs}, states, turn
    )
    submits: dict[str, list[SubmitRow]] = {}
    for submit in snapshot.submits:
        submits.setdefault(submit.run, []).append(submit)
    audits: dict[str, list[AuditRow]] = {}
    for each_audit in snapshot.audits:
        audits.setdefault(each_audit.run, []).append(each_audit)
    for row in sorted(snapshot.runs, key=lambda row: (row.created_at, row.run)):
        state = states.get(row.run, RunStateRow(run=row.run))
        if state.phase == "finished":
            core.run_keys[row.key] = row.run
            core.capabilities[row.run] = row.capability
            core.finished[row.run] = runs.last_state(state)
        else:
            run = runs.enter(core, row, state)
            run.played = played.get(row.run, {})
            run.audits.update((each.audit, each) for each in audits.get(row.run, ()))
            permits.resume(core, run, turn)
            _run(core, run, submits.get(row.run, []), turn)
    for each in sorted(snapshot.evaluations, key=lambda row: (row.created_at, row.evaluation)):
        if each.finished:
            core.evaluation_keys[each.key] = each.evaluation
            core.ended_evaluations[each.evaluation] = Ended(len(each.cases))
            continue
        evaluation = evaluations.enter(core, each)
        if each.fingerprint_class is not None:
            core.place(evaluation.flow, each.fingerprint_class, turn)
        evaluations.play(core, evaluation, turn)
    while core.reloaded:
        group = core.reloaded.pop(0)
        if not group.closed:
            _conclude(core, group, turn)
    core.loading = False
    core.heads.clear()
    if core.adopting:
        core.timers.arm(("adopt", ""), turn.now + core.settings.adoption_s)
    turn.log("info", "core_loaded", incarnation=core.incarnation, runs=len(core.runs), jobs=len(core.jobs))


def _run(core: Core, run: Run, submits: list[SubmitRow], turn: Turn) -> None:
    state = run.state
    if state.fingerprint_class is not None:
        core.place(run.flow, state.fingerprint_class, turn)
        run.flow.description = state.description
    for row in sorted(submits, key=lambda row: row.submit_index):
        run.submits.append(row)
        run.keys[row.key] = row.submit_index
        run.ledger.reserve(row.submit_index, len(row.env_instances))
        if row.refunded:
            run.ledger.refund(row.submit_index)
        elif row.status is not None:
            run.ledger.settle(row.submit_index)
            _spent(run, row)
        else:
            run.open = row.submit_index
            runs.play(core, run, row, turn)
        if row.status == "ok" and row.val_mean is not None:
            heads = core.heads.pop(validation_group(run.id, row.submit_index), [])
            failed = sum(head.failure is not None for head in heads)
            run.hidden_failures[validation_group(run.id, row.submit_index)] = failed
        elif row.status == "ok" and row.ineligible is None:
            finalisation.validate_early(core, run, row, turn)
    audit.resume(core, run, turn)
    finalisation.advance(core, run, turn)


def _spent(run: Run, row: SubmitRow) -> None:
    """Count what a settled submit took of time, as when it ended."""
    if row.completed_at is not None:
        started_at = row.first_leased_at or row.completed_at
        run.queue_s += max(0.0, started_at - row.accepted_at)
        run.rollout_s += max(0.0, row.completed_at - started_at)


def _conclude(core: Core, group: JobGroup, turn: Turn) -> None:
    if group.done:
        core.concluded(group, (), turn)
