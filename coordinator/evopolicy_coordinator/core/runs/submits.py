"""A run's submits: accepted or refused, played, ended and charged.

Rules that this module owns:
- A submit is reserved, made durable, then answered; one submit per key; one open submit per run; a refused submit
  changes nothing.
- The episode at index 0 is a gate: no episode is released until its outcome shows that the bundle yields a Policy. If
  the outcome shows that it does not, that is the whole submit's verdict.
- In the published profiles a request that plays nothing may take an index; nothing is reserved for it.
- A submit's end settles its reservation once, whatever the verdict (`end`). Only a cancelled run's open submit is
  refunded.
- A fault of ours (a worker, an environment) ends no submit: its limit on wall time begins again.
"""

from __future__ import annotations

from typing import cast

from evopolicy_common.messages import gateway
from evopolicy_common.messages.episode import NO_POLICY, PolicyFailure
from evopolicy_common.messages.gateway import SubmitStatus
from evopolicy_coordinator.core.agents import requests
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import ReadResults
from evopolicy_coordinator.core.contract.reasons import NotDoneError
from evopolicy_coordinator.core.contract.records import SubmitRow, submit_accepted, submit_group
from evopolicy_coordinator.core.leasing import groups
from evopolicy_coordinator.core.runs import templates, waits
from evopolicy_coordinator.core.runs.runs import held_s
from evopolicy_coordinator.core.structures.ledger import check_request
from evopolicy_coordinator.core.structures.timers import Poll
from evopolicy_coordinator.core.tables.model import JobGroup, Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep, EpisodesDone, SubmitEnded


def submit(state: State, event: events.Requested[gateway.Submit], step: CoreStep) -> None:
    """Accept a submit, or refuse it for the first cause in the protocol's order; the same request with a known key
    gets the earlier answer."""
    message = event.message
    run = requests.live(state, message.run)
    known = run.keys.get(message.key)
    if known is not None:
        row = run.submits[known]
        if (message.env_instances, message.bundle) != (row.env_instances, row.bundle):
            raise NotDoneError("key_used", key=message.key, submit=row.submit_index)
        step.reply(event.request, submit_accepted(row))
        return
    if run.state.phase != "open":
        raise NotDoneError(requests.over(state, run.id))
    requests.check_whole(run, message.after)
    if run.open is not None:
        raise NotDoneError("busy", submit=run.open)
    check_request(
        message.env_instances,
        n_cases=len(run.row.train),
        minimum=run.row.min_episodes_per_submit,
        maximum=run.row.max_episodes_per_submit,
        available=run.ledger.available,
    )
    if message.bundle is None and message.bundle_error is None:
        raise NotDoneError("no_bundle")
    requests.demand_permit(state, run, step)
    _accept(state, run, event, step)


def _accept(state: State, run: Run, event: events.Requested[gateway.Submit], step: CoreStep) -> None:
    message = event.message
    index, n = len(run.submits), len(message.env_instances)
    first_global_episode = run.ledger.spent
    run.ledger.reserve(index, n)
    row = SubmitRow(
        run=run.id,
        submit_index=index,
        key=message.key,
        env_instances=message.env_instances,
        bundle=message.bundle,
        tree=message.tree,
        first_global_episode=first_global_episode,
        remaining_budget=run.ledger.available,
        accepted_at=step.now,
        stimulus_id=step.stimulus_id,
    )
    run.submits.append(row)
    run.keys[message.key] = index
    step.reply(event.request, submit_accepted(row))
    step.log("info", "submit_accepted", run=run.id, submit=index, episodes=n, remaining=row.remaining_budget)
    failure = message.bundle_error
    if failure is not None:
        run.ledger.settle(index)
        status: SubmitStatus = "import_error"
        if failure.category in NO_POLICY:
            status = cast(SubmitStatus, failure.category)
        step.change_submit(run, index, status=status, failure=failure, completed_at=step.now)
        return
    step.persist(row)
    run.open = index
    queue_jobs(state, run, row, step)


def queue_jobs(state: State, run: Run, row: SubmitRow, step: CoreStep) -> None:
    """Queue the unfinished jobs of an open submit."""
    groups.open_group(state, templates.train(run, row, step), step)


# ---- progress and end of a submit ----


def progressed(state: State, news: EpisodesDone, step: CoreStep) -> None:
    group = news.group
    run = state.runs[group.run]
    for outcome in news.outcomes:
        failure = outcome.failure
        if outcome.index == 0 and failure is not None and failure.category in NO_POLICY:
            end(state, run, group, cast(SubmitStatus, failure.category), failure, step)
            return
    if group.done < group.n:
        if 0 in group.digests:
            step.grown[group] = None
        return
    failed = group.first_failed()
    if failed is None or run.row.settings.failed_episodes == "play-on":
        end(state, run, group, "ok", None, step)
        return
    index, category = failed
    text = (
        f"the policy failed in {group.failed()} of {group.n} episodes, first in number {index} of the submit"
    )
    failure = PolicyFailure(category=category, step_index=None, message=text)
    end(state, run, group, "rollout_timeout", failure, step)


def limit_passed(state: State, name: str, step: CoreStep) -> None:
    """The deadline of the operator's limit on a submit's wall time; extended by the time for which it was held, and by
    another such limit after faults of ours in episodes that are not done."""
    group = state.groups.get(name)
    if group is None:
        return
    run = state.runs[group.run]
    limit_s = run.row.settings.limits.submit_wall_s
    assert limit_s is not None
    held_s = group.held_until_s(step.now) - group.held_counted_s
    if held_s > 0.0:
        group.held_counted_s += held_s
        state.timers.arm(("submit", name), step.now + held_s)
    elif step.now < state.hold_until:
        state.timers.arm(("submit", name), state.hold_until)
    elif faulty := [job for job in group.jobs.values() if job.failures > job.failures_counted]:
        for job in faulty:
            job.failures_counted = job.failures
        state.timers.arm(("submit", name), step.now + limit_s)
    else:
        done = f"{group.done} of {group.n} episodes were done"
        text = f"the submit took longer than its limit of {limit_s} s; {done}"
        failure = PolicyFailure(category="episode_timeout", step_index=None, message=text, limit=limit_s)
        end(state, run, group, "rollout_timeout", failure, step)


def end(
    state: State,
    run: Run,
    group: JobGroup,
    status: SubmitStatus,
    failure: PolicyFailure | None,
    step: CoreStep,
) -> None:
    """Settle a submit with its verdict."""
    n_kept = 0
    if status == "ok":
        n_kept = group.n
    elif status == "rollout_timeout":
        n_kept = group.first_unfinished()
    row = step.change_submit(
        run,
        group.submit_index,
        status=status,
        failure=failure,
        completed_at=step.now,
        first_leased_at=group.first_leased_at,
        released=group.done if n_kept else 0,
        n_kept=n_kept,
        mean_return=group.mean_return() if status == "ok" else None,
        held_s=group.held_until_s(step.now),
    )
    started_at = group.first_leased_at or step.now
    run.queue_s += max(0.0, started_at - row.accepted_at)
    run.rollout_s += step.now - started_at
    run.ledger.settle(group.submit_index)
    run.open = None
    groups.close_group(state, group, step)
    answer_polls(state, group, step)
    step.log("info", "submit_ended", run=run.id, submit=group.submit_index, status=status, episodes=group.n)
    step.tell(SubmitEnded(run, row))


def results(state: State, event: events.Requested[gateway.ResultsRequest], step: CoreStep) -> None:
    """A gateway polls for outcomes: answered at once, or when there are more than it has."""
    message = event.message
    run = requests.known_run(state, message.run)
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


def answer_polls(state: State, group: JobGroup, step: CoreStep) -> None:
    """Answer the polls that wait for a submit's new results."""
    for poll in state.polls.take_all(group.id):
        answer(state, poll, step)


def answer(state: State, poll: Poll, step: CoreStep) -> None:
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
