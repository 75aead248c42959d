"""Gateways read the outcomes of a submit by long polls, answered when there are more than they have."""

from __future__ import annotations

from evopolicy_common.messages import gateway
from evopolicy_coordinator.core.agents import requests
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import ReadResults
from evopolicy_coordinator.core.contract.reasons import NotDoneError
from evopolicy_coordinator.core.contract.records import submit_group
from evopolicy_coordinator.core.runs import waits
from evopolicy_coordinator.core.runs.runs import held_s
from evopolicy_coordinator.core.structures.timers import Poll
from evopolicy_coordinator.core.tables.model import JobGroup
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import Step


def results(state: State, event: events.Requested[gateway.ResultsRequest], step: Step) -> None:
    """A gateway polls for outcomes: answered at once, or when there are more than it has."""
    message = event.message
    run = requests.known(state, message.run)
    if run is None:
        step.add(
            ReadResults(
                request=event.request,
                run=message.run,
                submit_index=message.submit_index,
                cursor=max(0, message.cursor),
                upto=None,
            )
        )
        return
    if not 0 <= message.submit_index < len(run.submits):
        raise NotDoneError("unknown_submit", run=run.id, n=len(run.submits), submit=message.submit_index)
    target = submit_group(run.id, message.submit_index, "train")
    poll = Poll(event.request, "results", target, message.cursor)
    closed = run.submits[message.submit_index].status is not None
    ready = closed or _released(state, target) > message.cursor
    if ready or not state.polls.wait(poll, message.wait_s, step.now):
        answer(state, poll, step)


def _released(state: State, target: str) -> int:
    """Number of episodes of an open submit that its gateway may see."""
    group = state.groups[target]
    return group.done if 0 in group.digests else 0


def answer_polls(state: State, group: JobGroup, step: Step) -> None:
    """Answer the polls that wait for a submit's new results."""
    for poll in state.polls.take_all(group.id):
        answer(state, poll, step)


def answer(state: State, poll: Poll, step: Step) -> None:
    run = state.runs[poll.target.split("/")[0]]
    index = int(poll.target.split("/")[1][1:])
    row = run.submits[index]
    ended = row.status is not None
    step.add(
        ReadResults(
            request=poll.request,
            run=run.id,
            submit_index=index,
            cursor=max(0, poll.cursor),
            upto=row.released if ended else _released(state, poll.target),
            waits_for=None if ended else waits.waits_for(state, state.groups[poll.target]),
            held_s=held_s(state, run, step.now),
        )
    )
