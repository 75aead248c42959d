"""From a snapshot of the store to a core that continues: no accepted submit is lost, no finished episode is played
again.

Rules that this module owns:
- Budgets are rebuilt from submits, open groups from submits and outcomes. Groups that were complete but not concluded
  when the process died are concluded first.
- Open jobs may be running on a worker: they wait for a short while for heartbeats that claim them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

from evopolicy_coordinator.core.agents import permits, requests
from evopolicy_coordinator.core.contract.records import (
    Snapshot,
    SubmitRow,
    submit_group,
)
from evopolicy_coordinator.core.isolation import occupancies
from evopolicy_coordinator.core.leasing import fleet, pins
from evopolicy_coordinator.core.runs import evaluations, finalisation, runs, submits
from evopolicy_coordinator.core.tables.model import Run
from evopolicy_coordinator.core.tables.state import Loading, State
from evopolicy_coordinator.core.tables.step import EpisodesDone, Step


def load(state: State, snapshot: Snapshot, step: Step, drain: Callable[[State, Step], None]) -> None:
    """Fill an empty state; `drain` delivers the news of a step."""
    loading = state.loading = Loading()
    state.journal = snapshot.journal
    state.revealed.update(snapshot.revealed)
    for head in snapshot.outcomes:
        loading.heads.setdefault(head.group, []).append(head)
    loading.begun.update({(row.group, row.first): row for row in snapshot.begun})
    for worker in snapshot.workers:
        fleet.set_state(state, worker.worker, worker.state)
    stored = {row.run: row for row in snapshot.states}
    permits.load(state, snapshot.permits, {row.run: row for row in snapshot.runs}, stored, step)
    occupancies.load(state, snapshot.kernels, step)
    submits_of: dict[str, list[SubmitRow]] = defaultdict(list)
    for submit in snapshot.submits:
        submits_of[submit.run].append(submit)
    for row in sorted(snapshot.runs, key=lambda row: (row.created_at, row.run)):
        last = stored[row.run]
        if last.phase == "finished":
            state.run_keys[row.key] = row.run
            state.capabilities[row.run] = row.capability
            state.finished[row.run] = runs.last_state(last)
        else:
            run = runs.enter(state, row, last)
            requests.resume(state, run, step)
            _run(state, run, submits_of[row.run], loading, step)
    for each in sorted(snapshot.evaluations, key=lambda row: (row.created_at, row.evaluation)):
        if each.finished:
            state.evaluation_keys[each.key] = each.evaluation
            state.ended_evaluations[each.evaluation] = len(each.cases)
            continue
        evaluation = evaluations.enter(state, each)
        if each.fingerprint_class is not None:
            pins.place(state, evaluation.flow, each.fingerprint_class, step)
        evaluations.queue_jobs(state, evaluation, step)
    while loading.reloaded:
        group = loading.reloaded.pop(0)
        if group.done and not group.closed:
            step.tell(EpisodesDone(group, None, ()))
            drain(state, step)
    state.loading = None
    if state.adopting:
        state.timers.arm(("adopt", ""), step.now + state.settings.adoption_s)
    step.log("info", "core_loaded", incarnation=state.incarnation, runs=len(state.runs), jobs=len(state.jobs))


def _run(state: State, run: Run, rows: list[SubmitRow], loading: Loading, step: Step) -> None:
    if run.state.fingerprint_class is not None:
        pins.place(state, run.flow, run.state.fingerprint_class, step)
        run.flow.description = run.state.description
    for row in sorted(rows, key=lambda row: row.submit_index):
        run.submits.append(row)
        run.keys[row.key] = row.submit_index
        if not row.env_instances:
            continue
        run.ledger.reserve(row.submit_index, len(row.env_instances))
        if row.refunded:
            run.ledger.refund(row.submit_index)
        elif row.status is not None:
            run.ledger.settle(row.submit_index)
            _spent(run, row)
        else:
            run.open = row.submit_index
            submits.queue_jobs(state, run, row, step)
        if row.status == "ok" and row.val_mean is not None:
            heads = loading.heads.pop(submit_group(run.id, row.submit_index, "validation"), [])
            failed = sum(head.failure is not None for head in heads)
            run.hidden_failures[submit_group(run.id, row.submit_index, "validation")] = failed
    finalisation.advance(state, run, step)


def _spent(run: Run, row: SubmitRow) -> None:
    """Add a settled submit's queue and rollout time to the run's totals, as at its end."""
    if row.completed_at is not None:
        started_at = row.first_leased_at or row.completed_at
        run.queue_s += max(0.0, started_at - row.accepted_at)
        run.rollout_s += max(0.0, row.completed_at - started_at)
