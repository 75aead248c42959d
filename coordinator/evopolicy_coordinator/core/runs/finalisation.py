"""The stages of a run that takes no more submits: validation, selection, held-out, the random reference.

Rules that this module owns:
- Every ok checkpoint is validated on all hidden validation cases. Validation starts when the run has
  closed, and is never played twice: an outcome is stored under (run, submit, split, index), which fixes bundle,
  env_meta, case, scope and policy seed, in a run that is pinned to one fingerprint class.
- Selection waits until every ok checkpoint is validated or ineligible. The highest mean wins, a tie goes to the later
  submit.
- With `failed_episodes` = "end-submit", a checkpoint whose policy fails in a validation episode is not eligible, and a
  run whose selected policy fails in a held-out episode ends as an error.
- The selected checkpoint plays all held-out cases; uniform random actions play the same ones. Those actions follow from
  split and case (`jobs.reference_seed`).
- The stage follows from stored rows: `advance` may be called any number of times.
"""

from __future__ import annotations

from evopolicy_common.messages import gateway, operator
from evopolicy_coordinator.core.agents import permits, requests
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import ReadFinished
from evopolicy_coordinator.core.contract.reasons import because
from evopolicy_coordinator.core.contract.records import (
    SubmitRow,
    random_group,
    submit_group,
)
from evopolicy_coordinator.core.leasing import groups
from evopolicy_coordinator.core.runs import evaluations, finished, journal, runs, submits, templates
from evopolicy_coordinator.core.tables.model import JobGroup, Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import (
    AgentOverdue,
    CoreStep,
    EnvironmentFailed,
    EpisodesDone,
    SubmitEnded,
)

# ---- hidden groups ----


def _open(state: State, group: JobGroup, step: CoreStep) -> None:
    if group.id not in state.groups:
        groups.open_group(state, group, step)


def progressed(state: State, news: EpisodesDone, step: CoreStep) -> None:
    group = news.group
    if group.done < group.n:
        return
    run = state.runs[group.run]
    run.hidden_failures[group.id] = group.failed()
    if group.kind == "validation" and finished.fails(run, group.failed()):
        step.change_submit(run, group.submit_index, ineligible=True)
    elif group.kind == "validation":
        step.change_submit(run, group.submit_index, val_mean=group.mean_return())
    else:
        run.hidden_returns[group.id] = group.returns()
        run.hidden_successes[group.id] = group.successes()
    groups.close_group(state, group, step)
    advance(state, run, step)


def submit_ended(state: State, news: SubmitEnded, step: CoreStep) -> None:
    """A submit got its verdict: a closed run may advance."""
    advance(state, news.run, step)


# ---- stages ----


def close(state: State, event: events.Requested[gateway.CloseRun], step: CoreStep) -> None:
    """The agent is gone: the run takes no more submits, and its hidden cases are played. A second
    close changes nothing."""
    message = event.message
    run = requests.known_run(state, message.run)
    if run is not None and run.state.phase == "open":
        requests.check_whole(run, message.after)
    permits.end(state, message.run, step, "its run was closed")
    permits.drop_asks(state, message.run, because("run_closed", run=message.run), step)
    if run is not None and run.state.phase == "open":
        step.change_run(
            run, phase="closed", closed_at=step.now, close_reason=message.reason, agent=message.agent
        )
        step.log("info", "run_closed", run=run.id, reason=message.reason, submits=len(run.submits))
        advance(state, run, step)
    step.reply(event.request, gateway.RunClosed())


def advance(state: State, run: Run, step: CoreStep) -> None:
    """Take a closed run through all stages that are possible now."""
    if run.state.phase != "closed" or run.open is not None:
        return
    if finished.unspent(run):
        _finish(state, run, None, step, unplayed=True)
        return
    # Groups that are opened here end in a later rule.
    has_reference = random_group(run.id) in run.hidden_returns
    if not has_reference:
        _open(state, templates.random(run, step), step)
    waiting = [row for row in finished.ok_submits(run) if row.val_mean is None and not row.ineligible]
    for row in waiting:
        _open(state, templates.hidden("validation", run, row, step), step)
    if waiting:
        return
    best = finished.select(run)
    if best is not None and submit_group(run.id, best.submit_index, "heldout") not in run.hidden_returns:
        _open(state, templates.hidden("heldout", run, best, step), step)
        return
    if has_reference:
        _finish(state, run, best, step)


def cancel(state: State, event: events.Requested[operator.CancelRun], step: CoreStep) -> None:
    """End a run at once on an operator's command; it is not scored. Also ends an evaluation of that name."""
    message = event.message
    if not evaluations.cancel(state, message.run, step):
        run = requests.known_run(state, message.run)
        if run is not None:
            _cancel(state, run, step)
    step.reply(event.request, operator.Done())


def agent_overdue(state: State, news: AgentOverdue, step: CoreStep) -> None:
    """Cancel a run whose agent keeps hidden jobs of others waiting: its gateway ends the agent, as at any
    cancellation."""
    if news.run.id in state.runs:
        step.log(
            "warning",
            "run_cancelled",
            run=news.run.id,
            why="its agent kept hidden cases waiting for too long",
        )
        _cancel(state, news.run, step)


def environment_failed(state: State, news: EnvironmentFailed, step: CoreStep) -> None:
    """End a run with an error, as its environment cannot play one of the episodes: its open submit is not charged."""
    run = state.runs.get(news.group.run)
    if run is not None:
        step.log("error", "environment_given_up", run=run.id, why=news.error)
        _cancel(state, run, step, error=news.error)


def _cancel(state: State, run: Run, step: CoreStep, *, error: str | None = None) -> None:
    if run.open is not None:
        index, run.open = run.open, None
        run.ledger.refund(index)
        step.change_submit(run, index, status="cancelled", completed_at=step.now, refunded=True)
        group = state.groups[submit_group(run.id, index, "train")]
        groups.close_group(state, group, step)
        submits.answer_polls(state, group, step)
    if run.state.phase == "open":
        step.change_run(run, phase="closed", closed_at=step.now, close_reason=gateway.CANCELLED)
        permits.cancelled(state, run.id, step)
    permits.drop_asks(state, run.id, because("run_cancelled", run=run.id), step)
    _finish(state, run, None, step, cancelled=True, unplayed=True, error=error)


def _finish(
    state: State,
    run: Run,
    best: SubmitRow | None,
    step: CoreStep,
    *,
    cancelled: bool = False,
    unplayed: bool = False,
    error: str | None = None,
) -> None:
    """End a run: its result becomes durable, and the core drops its state. `unplayed`: close its
    open groups unfinished. `error`: why it cannot be scored."""
    for group in [group for group in state.groups.values() if group.run == run.id] if unplayed else []:
        groups.close_group(state, group, step)
    result = finished.result(state, run, best, step.now, cancelled=cancelled, error=error)
    result = journal.ended(state, result, step)
    step.persist(result)
    step.change_run(run, phase="finished", remaining_budget=run.ledger.available, n_submits=len(run.submits))
    runs.forget(state, run)
    for poll in state.polls.take_all(run.id):
        step.add(ReadFinished(request=poll.request, run=run.id))
    step.log("info", "run_finished", run=run.id, status=result.status, best=result.best_submit_index)
