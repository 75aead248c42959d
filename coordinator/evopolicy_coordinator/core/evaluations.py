"""Evaluations: cases that an operator has played outside any run (`try`, `random`), or again (`verify`).

Rules that this module owns: no budget is concerned; the same key gives the same evaluation; a bundle that brings its slots
down too often ends its evaluation with that word.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from evopolicy_common.messages import operator
from evopolicy_common.messages.environment import PolicyScope
from evopolicy_common.wire.refusals import Refusal

from . import events
from .effects import ReadEvaluation
from .isolation import hidden_evaluation
from .jobs import HELDOUT, REFERENCE, JobGroup, Template
from .polls import Poll
from .queue import Flow
from .records import EvaluationRow, evaluation_group
from .seeds import occurrences
from .turn import Turn

if TYPE_CHECKING:
    from .machine import Core


@dataclass(slots=True, eq=False)
class Evaluation:
    """An unfinished evaluation."""

    row: EvaluationRow
    flow: Flow


@dataclass(slots=True, frozen=True)
class Ended:
    """What stays known of a finished one."""

    total: int
    """Outcomes that are stored."""


def request(core: Core, event: events.EvaluationRequested, turn: Turn) -> None:
    """Queue an operator's cases, once for each key."""
    message = event.message
    known = core.evaluation_keys.get(message.key)
    if known is not None:
        turn.reply(event.request, operator.EvaluationStarted(evaluation=known))
        return
    if not event.cases or len(event.cases) != len(event.case_ids):
        turn.refuse(event.request, Refusal.BAD_REQUEST, "an evaluation needs at least one case")
        return
    row = EvaluationRow(
        evaluation=event.evaluation,
        key=message.key,
        env=message.env,
        bundle=message.bundle,
        split=message.split,
        case_ids=event.case_ids,
        cases=event.cases,
        secret=event.secret,
        record=message.record,
        tier=message.sandbox_tier,
        limits=message.limits,
        replays=message.replays,
        as_in=message.as_in,
        max_steps=event.max_steps,
        created_at=turn.now,
        stimulus_id=turn.stimulus_id,
    )
    turn.persist(row)
    evaluation = enter(core, row)
    core.pin(evaluation.flow, turn)
    play(core, evaluation, turn)
    turn.reply(event.request, operator.EvaluationStarted(evaluation=row.evaluation))


def enter(core: Core, row: EvaluationRow) -> Evaluation:
    """Take an evaluation into the core, with nothing of it queued yet."""
    family = core.isolation.families.join(row.env, row.cases) if _hidden(row) else None
    evaluation = Evaluation(row, core.add_flow(row.evaluation, row.env, row.tier, family, closed=True))
    core.evaluations[row.evaluation] = evaluation
    core.evaluation_keys[row.key] = row.evaluation
    return evaluation


def _hidden(row: EvaluationRow) -> bool:
    return hidden_evaluation(row.split, row.bundle, replays=bool(row.replays))


def play(core: Core, evaluation: Evaluation, turn: Turn) -> None:
    """Queue the episodes of an evaluation."""
    row = evaluation.row
    n = len(row.cases)
    # What is played again stands where it stood in its run; anything else is a list of its own.
    place = row.as_in or operator.PlayedAs(
        run="",
        submit_index=-1,
        env_instances=row.case_ids,
        indexes=tuple(range(n)),
        modulo=n,
        remaining_budget_after=0,
    )
    scope: PolicyScope = place.policy_scope if row.bundle is not None else "episode"
    counts = occurrences(place.env_instances)
    template = Template(
        env=row.env,
        bundle=row.bundle,
        cases=row.cases,
        case_ids=row.case_ids,
        occurrences=tuple(counts[index] for index in place.indexes),
        secret=None if row.bundle is None else row.secret,
        split=row.split,
        submit_index=place.submit_index,
        modulo=place.modulo,
        per_job=place.modulo if scope == "submit" else 1,
        scope=scope,
        env_meta={
            "env": row.env,
            "submit_index": max(0, place.submit_index),
            "n_episodes_this_submit": place.modulo,
            "remaining_budget_after": place.remaining_budget_after,
        },
        observations=place.observations,
        record=row.record,
        video="off",
        tier=row.tier,
        limits=row.limits,
        max_steps=row.max_steps,
        replays=row.replays,
        indexes=place.indexes,
    )
    group = JobGroup(
        id=evaluation_group(row.evaluation),
        kind="evaluation",
        run=row.evaluation,
        submit_index=-1,
        flow=evaluation.flow,
        template=template,
        stimulus_id=row.stimulus_id,
        priority=HELDOUT if _hidden(row) else REFERENCE,
        created_at=row.created_at,
    )
    core.open_group(group, turn)


def pinned(evaluation: Evaluation, fingerprint_class: str, turn: Turn) -> None:
    """Keep the class of workers that an evaluation is played by."""
    evaluation.row = msgspec.structs.replace(evaluation.row, fingerprint_class=fingerprint_class)
    turn.persist(evaluation.row)


def progressed(core: Core, group: JobGroup, turn: Turn) -> None:
    """Episodes of an evaluation are done: tell those who wait, and end it with its last."""
    if group.done == group.n:
        end(core, group, "", turn)
    else:
        _answer_polls(core, group, turn, finished=False)


def end(core: Core, group: JobGroup, error: str, turn: Turn) -> None:
    """Nothing more of an evaluation is played; `error` says why it ended early."""
    evaluation = core.evaluations.pop(group.run)
    turn.persist(msgspec.structs.replace(evaluation.row, finished=True, error=error))
    core.ended_evaluations[group.run] = Ended(group.done)
    core.close_group(group, turn, error or "all done")
    core.drop_flow(evaluation.flow)
    _answer_polls(core, group, turn, finished=True)


def _answer_polls(core: Core, group: JobGroup, turn: Turn, *, finished: bool) -> None:
    for poll in core.polls.take_all(group.id):
        turn.add(_page(core, poll, group, turn, finished=finished))


def polled(core: Core, event: events.Asked[operator.EvaluationPoll], turn: Turn) -> None:
    """An operator asks for outcomes: answered at once, or when there are more than it has."""
    message = event.message
    poll = Poll(event.request, "evaluation", evaluation_group(message.evaluation), message.cursor)
    ended = core.ended_evaluations.get(message.evaluation)
    if ended is not None:
        turn.add(
            ReadEvaluation(
                request=event.request,
                evaluation=message.evaluation,
                cursor=max(0, message.cursor),
                upto=ended.total,
                total=ended.total,
                finished=True,
                stimulus_id=turn.stimulus_id,
            )
        )
        return
    group = core.groups.get(poll.target)
    if group is None:
        turn.refuse(
            event.request, Refusal.UNKNOWN_EVALUATION, f"there is no evaluation {message.evaluation!r}"
        )
    elif group.done > message.cursor or not core.polls.wait(poll, message.wait_s, turn.now):
        turn.add(_page(core, poll, group, turn, finished=False))


def answer(core: Core, poll: Poll, turn: Turn) -> None:
    """Answer a poll whose time is up."""
    turn.add(_page(core, poll, core.groups[poll.target], turn, finished=False))


def _page(core: Core, poll: Poll, group: JobGroup, turn: Turn, *, finished: bool) -> ReadEvaluation:
    return ReadEvaluation(
        request=poll.request,
        evaluation=group.run,
        cursor=max(0, poll.cursor),
        upto=group.done,
        total=group.done if finished else group.n,
        finished=finished,
        waits_for="" if finished else core.waits_for(group),
        stimulus_id=turn.stimulus_id,
    )
