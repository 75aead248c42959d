"""Evaluations: cases that an operator requests outside any run (`try`, `random`), or replays (`verify`), or a finished
run's checkpoint on further hidden cases (`rescore`).

Rules that this module owns: no budget is charged; the same key returns the same evaluation; a cancelled evaluation ends
with the reason in its row.
"""

from __future__ import annotations

import msgspec

from evopolicy_common.messages import operator
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import ReadEvaluation
from evopolicy_coordinator.core.contract.reasons import NotDoneError, Reason
from evopolicy_coordinator.core.contract.records import EvaluationRow, evaluation_group
from evopolicy_coordinator.core.leasing import groups, pins
from evopolicy_coordinator.core.runs import templates, waits
from evopolicy_coordinator.core.structures.timers import Poll
from evopolicy_coordinator.core.tables.model import Evaluation, Flow, JobGroup
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep, EnvironmentFailed, EpisodesDone, FlowPinned


def request(state: State, event: events.EvaluationRequested, step: CoreStep) -> None:
    """Queue an operator's cases, once for each key."""
    row = event.row
    known = state.evaluation_keys.get(row.key)
    if known is not None:
        running = state.groups.get(evaluation_group(known))
        step.reply(
            event.request,
            operator.EvaluationStarted(evaluation=known, episodes=0 if running is None else running.n),
        )
        return
    if not row.cases or len(row.cases) != len(row.case_ids):
        raise NotDoneError("evaluation_without_cases")
    row = msgspec.structs.replace(row, created_at=step.now, stimulus_id=step.stimulus_id)
    step.persist(row)
    evaluation = enter(state, row)
    if row.fingerprint_class is None:
        pins.pin(state, evaluation.flow, step)
    else:
        pins.place(state, evaluation.flow, row.fingerprint_class, step)
    queue_jobs(state, evaluation, step)
    step.reply(event.request, operator.EvaluationStarted(evaluation=row.evaluation, episodes=len(row.cases)))


def enter(state: State, row: EvaluationRow) -> Evaluation:
    """Add an evaluation to the core, with none of its jobs queued yet."""
    hidden = templates.hidden_evaluation(row)
    case_set = state.case_sets.join(row.env, (*row.cases, *row.related)) if hidden else None
    flow = Flow(row.evaluation, row.env, row.tier, "evaluation", row.secret)
    flow.case_set, flow.definition = case_set, row.definition
    pins.add_flow(state, flow)
    evaluation = state.evaluations[row.evaluation] = Evaluation(row, flow)
    state.evaluation_keys[row.key] = row.evaluation
    return evaluation


def queue_jobs(state: State, evaluation: Evaluation, step: CoreStep) -> None:
    group = templates.evaluation(evaluation, step)
    groups.open_group(state, group, step)


def pinned(state: State, news: FlowPinned, step: CoreStep) -> None:
    """Store the class of workers that an evaluation is pinned to."""
    evaluation = state.evaluations[news.flow.id]
    evaluation.row = msgspec.structs.replace(
        evaluation.row, fingerprint_class=news.profile.classes[news.flow.env]
    )
    step.persist(evaluation.row)


def progressed(state: State, news: EpisodesDone, step: CoreStep) -> None:
    """Episodes of an evaluation are done: answer waiting polls, and end it after the last one."""
    group = news.group
    if group.done == group.n:
        end(state, group, "", step)
    else:
        _answer_polls(state, group, step, finished=False)


def environment_failed(state: State, news: EnvironmentFailed, step: CoreStep) -> None:
    """The environment cannot play one of the episodes."""
    if news.group.run in state.evaluations:
        end(state, news.group, news.error, step)


def cancel(state: State, name: str, step: CoreStep) -> bool:
    """End a running evaluation; returns False when it is unknown."""
    if name not in state.evaluations:
        return name in state.ended_evaluations
    end(state, state.groups[evaluation_group(name)], "cancelled by the operator", step)
    return True


def end(state: State, group: JobGroup, error: str, step: CoreStep) -> None:
    """End an evaluation: close its group and answer waiting polls. `error` is the reason of an early end."""
    evaluation = state.evaluations.pop(group.run)
    step.persist(msgspec.structs.replace(evaluation.row, finished=True, error=error))
    state.ended_evaluations[group.run] = group.done
    groups.close_group(state, group, step)
    pins.drop_flow(state, evaluation.flow)
    _answer_polls(state, group, step, finished=True)


def _answer_polls(state: State, group: JobGroup, step: CoreStep, *, finished: bool) -> None:
    for poll in state.polls.take_all(group.id):
        step.add(_page(state, poll, group, finished=finished))


def polled(state: State, event: events.Requested[operator.EvaluationPoll], step: CoreStep) -> None:
    """An operator polls for outcomes: answered at once, or when there are more than it has."""
    message = event.message
    poll = Poll(event.request, "evaluation", evaluation_group(message.evaluation), message.cursor)
    total = state.ended_evaluations.get(message.evaluation)
    if total is not None:
        step.add(_read(poll, message.evaluation, total, total, finished=True))
        return
    group = state.groups.get(poll.target)
    if group is None:
        raise NotDoneError("unknown_evaluation", evaluation=message.evaluation)
    if group.done > message.cursor or not state.polls.wait(poll, message.wait_s, step.now):
        step.add(_page(state, poll, group, finished=False))


def answer(state: State, poll: Poll, step: CoreStep) -> None:
    """Answer a poll that has timed out."""
    step.add(_page(state, poll, state.groups[poll.target], finished=False))


def _page(state: State, poll: Poll, group: JobGroup, *, finished: bool) -> ReadEvaluation:
    total = group.done if finished else group.n
    waits_for = None if finished else waits.waits_for(state, group)
    return _read(poll, group.run, group.done, total, finished=finished, waits_for=waits_for)


def _read(
    poll: Poll, evaluation: str, upto: int, total: int, *, finished: bool, waits_for: Reason | None = None
) -> ReadEvaluation:
    return ReadEvaluation(
        request=poll.request,
        evaluation=evaluation,
        cursor=max(0, poll.cursor),
        upto=upto,
        total=total,
        finished=finished,
        waits_for=waits_for,
    )
