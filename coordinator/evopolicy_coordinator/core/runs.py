"""Runs and their submits: from creation until the agent is gone. What follows is `finalisation`'s.

Rules that this module owns:
- A submit is reserved, durable, then answered; one submit per key; one open submit per run; refused ones change nothing.
- The episode at index 0 gates: until its outcome shows that the bundle yields a Policy no episode is released, and when it
  shows the contrary that is the whole submit's verdict.
- A submit's end settles its reservation, once, whatever the verdict. Only a cancelled run's open submit is refunded.
- Nothing here that a gateway is answered with depends on hidden work.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import msgspec

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages.episode import NO_POLICY, EpisodeOutcome, PolicyFailure
from evopolicy_common.messages.gateway import CANCELLED, SubmitStatus
from evopolicy_common.wire.refusals import Refusal

from . import events
from .effects import ReadFinished, ReadResults
from .isolation import Family, implied, stamp
from .jobs import TRAIN, JobGroup, Template
from .ledger import Ledger, refusal
from .polls import Poll
from .queue import Flow
from .records import AuditRow, RunRow, RunStateRow, SubmitRow, train_group
from .seeds import occurrences
from .turn import Turn

if TYPE_CHECKING:
    from .machine import Core


@dataclass(slots=True, eq=False)
class Run:
    """An unfinished run."""

    row: RunRow
    state: RunStateRow
    ledger: Ledger
    flow: Flow
    submits: list[SubmitRow] = field(default_factory=list)
    keys: dict[str, int] = field(default_factory=dict)
    """Idempotency key to submit index."""
    open: int | None = None
    """The submit in flight."""
    hidden_failures: dict[str, int] = field(default_factory=dict)
    """Group id to hidden episodes in which the policy failed, of finished groups."""
    hidden_returns: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Held-out and random group id to returns, of finished groups."""
    rollout_s: float = 0.0
    queue_s: float = 0.0
    played: dict[str, int] = field(default_factory=dict)
    """Worker to the run's episodes that it has played."""
    audits: dict[str, AuditRow] = field(default_factory=dict)
    """All that were drawn, by id."""
    audits_waited_s: float = 0.0
    """How long the run, done otherwise, has waited for audits that could be played."""
    audits_looked_at: float | None = None
    """When that was last counted; None before."""

    @property
    def id(self) -> str:
        return self.row.run

    @property
    def family(self) -> Family:
        """The runs that share its hidden cases."""
        assert self.flow.family is not None
        return self.flow.family

    def change(self, turn: Turn, **fields: object) -> None:
        """Change the durable state."""
        self.state = msgspec.structs.replace(self.state, **fields)
        turn.persist(self.state)

    def change_submit(self, index: int, turn: Turn, **fields: object) -> SubmitRow:
        """Change a submit's durable row."""
        row = self.submits[index] = msgspec.structs.replace(self.submits[index], **fields)
        turn.persist(row)
        return row


def create(core: Core, event: events.RunCreated, turn: Turn) -> None:
    """Make a run, once for each key."""
    message = event.message
    known = core.run_keys.get(message.key)
    if known is not None:
        turn.reply(event.request, operator.RunCreated(run=known, capability=core.capabilities[known]))
        return
    fault = _fault(event)
    if fault is None and event.run in core.capabilities:
        fault = f"there is a run {event.run!r} already"
    if fault is not None:
        turn.refuse(event.request, Refusal.BAD_SETTINGS, fault)
        return
    row = RunRow(
        run=event.run,
        key=message.key,
        capability=event.capability,
        secret=event.secret,
        settings=message.settings,
        budget=event.budget,
        min_episodes_per_submit=event.min_episodes_per_submit,
        max_episodes_per_submit=event.max_episodes_per_submit,
        train=event.train,
        validation=event.validation,
        heldout=event.heldout,
        split_hashes=event.split_hashes,
        split_secret=event.split_secret,
        allowed_imports=event.allowed_imports,
        denied_imports=event.denied_imports,
        max_steps=event.max_steps,
        audit_share=core.settings.audit_share,
        reference_by_case=True,
        created_at=turn.now,
        stimulus_id=turn.stimulus_id,
    )
    state = RunStateRow(run=event.run, isolation=stamp(core, row))
    turn.persist(row)
    run = enter(core, row, state)
    turn.persist(state)
    core.pin(run.flow, turn)
    turn.reply(event.request, operator.RunCreated(run=event.run, capability=event.capability))
    turn.log("info", "run_created", run=event.run, env=message.settings.env, budget=event.budget)


def enter(core: Core, row: RunRow, state: RunStateRow) -> Run:
    """Take a run into the core, with its whole budget available."""
    family = core.isolation.families.join(row.settings.env, (*row.validation, *row.heldout))
    flow = core.add_flow(
        row.run, row.settings.env, row.settings.sandbox_tier, family, closed=state.phase != "open"
    )
    run = Run(row, state, Ledger(row.budget), flow)
    core.runs[row.run] = run
    core.run_keys[row.key] = row.run
    core.capabilities[row.run] = row.capability
    return run


def _fault(event: events.RunCreated) -> str | None:
    least, most = event.min_episodes_per_submit, event.max_episodes_per_submit
    if event.budget < 1:
        return f"a budget of {event.budget} episodes; at least 1 is needed"
    if not 1 <= least <= most:
        return f"a submit of {least} to {most} episodes; wanted is 1 ≤ minimum ≤ maximum"
    if least > event.budget:
        return f"a submit takes at least {least} episodes, the budget is {event.budget}"
    for name, cases in (("train", event.train), ("validation", event.validation), ("heldout", event.heldout)):
        if not cases:
            return f"the {name} split has no cases"
    return None


# ---- what a gateway asks ----


def opened(core: Core, event: events.Asked[gateway.OpenRun], turn: Turn) -> None:
    """Tell a gateway all that is fixed of its run; refused until some worker has offered the environment."""
    run = _live(core, event.request, event.message.run, turn)
    if run is None:
        return
    if run.flow.pin is None:
        core.pin(run.flow, turn)
    description = run.state.description
    row, settings = run.row, run.row.settings
    if description is None:
        text = f"the run waits for {core.waits_for_workers(run.flow)}"
        turn.refuse(event.request, Refusal.NO_WORKER, text)
        return
    if not event.message.asks_permit and _without_permit(core, event.request, run, turn):
        return
    turn.reply(
        event.request,
        gateway.RunOpened(
            env=description,
            n_env_instances=len(row.train),
            episode_budget=row.budget,
            min_episodes_per_submit=row.min_episodes_per_submit,
            max_episodes_per_submit=row.max_episodes_per_submit,
            policy_scope=settings.policy_scope,
            observations=settings.observations,
            sandbox_tier=settings.sandbox_tier,
            video=settings.video,
            limits=settings.limits,
            allowed_imports=row.allowed_imports,
            denied_imports=row.denied_imports,
            simulation=settings.simulation,
            max_steps=row.max_steps,
            state=run_state(core, run, turn.now),
        ),
    )


def _without_permit(core: Core, request: events.RequestId, run: Run, turn: Turn) -> bool:
    """Refuse, for now, what an agent asks that may be on any machine, until it may."""
    waits_for = implied(core, run, turn) if run.state.phase == "open" else ""
    if waits_for:
        turn.refuse(
            request, Refusal.UNAVAILABLE, f"the run's agent may not start yet; it waits for {waits_for}"
        )
    return bool(waits_for)


def state_requested(core: Core, event: events.Asked[gateway.StateRequest], turn: Turn) -> None:
    """Tell a gateway how its run stands, also after it is finished."""
    last = core.finished.get(event.message.run)
    if last is not None:
        turn.reply(event.request, gateway.StateReply(state=last))
        return
    run = _live(core, event.request, event.message.run, turn)
    if run is not None:
        turn.reply(event.request, gateway.StateReply(state=run_state(core, run, turn.now)))


def last_state(row: RunStateRow) -> gateway.RunState:
    """What the gateway of a finished run is told of it."""
    return gateway.RunState(
        remaining_budget=row.remaining_budget,
        n_submits=row.n_submits,
        is_finalized=True,
        cancelled=row.close_reason == CANCELLED,
    )


def held_s(core: Core, run: Run, now: float) -> float:
    """Seconds for which hidden jobs held a run's submits."""
    group = None if run.open is None else core.groups.get(train_group(run.id, run.open))
    return sum(row.held_s for row in run.submits) + (0.0 if group is None else group.held(now))


def run_state(core: Core, run: Run, now: float) -> gateway.RunState:
    """What the gateway of an unfinished run is told of it."""
    in_flight = None
    if run.open is not None:
        group = core.groups[train_group(run.id, run.open)]
        in_flight = gateway.SubmitInFlight(
            submit_index=run.open,
            n_episodes=group.n,
            n_done=group.done,
            waits_for=core.waits_for(group),
            held_s=group.held(now),
        )
    return gateway.RunState(
        remaining_budget=run.ledger.available,
        n_submits=len(run.submits),
        is_finalized=run.state.phase != "open",
        in_flight=in_flight,
        held_s=held_s(core, run, now),
    )


def _live(core: Core, request: events.RequestId, name: str, turn: Turn) -> Run | None:
    run = core.runs.get(name)
    if run is None:
        turn.refuse(request, *over(core, name))
    return run


def over(core: Core, name: str) -> tuple[Refusal, str]:
    """Why nothing more is taken of a run that is not open, in a word and a sentence."""
    last = core.finished.get(name)
    if last is not None and last.cancelled:
        return Refusal.RUN_CANCELLED, f"run {name!r} was cancelled by the operator"
    if last is not None:
        return Refusal.RUN_FINISHED, f"run {name!r} is finished"
    if name in core.runs:
        return Refusal.RUN_CLOSED, f"run {name!r} is closed and takes no more submits"
    return Refusal.UNKNOWN_RUN, f"there is no run {name[:64]!r}"


def submit(core: Core, event: events.Asked[gateway.Submit], turn: Turn) -> None:
    """Take a submit, or refuse it for the first cause in the protocol's order; a known key is answered as before."""
    message = event.message
    run = _live(core, event.request, message.run, turn)
    if run is None:
        return
    known = run.keys.get(message.key)
    if known is not None:
        _again(event, run.submits[known], turn)
        return
    if run.state.phase != "open":
        turn.refuse(event.request, *over(core, run.id))
        return
    if run.open is not None:
        turn.refuse(event.request, Refusal.BUSY, f"submit {run.open} is still running; one runs at a time")
        return
    refused = refusal(
        message.env_instances,
        n_cases=len(run.row.train),
        minimum=run.row.min_episodes_per_submit,
        maximum=run.row.max_episodes_per_submit,
        available=run.ledger.available,
    )
    if refused is not None:
        turn.refuse(event.request, *refused)
        return
    if message.bundle is None and message.bundle_error is None:
        turn.refuse(event.request, Refusal.BAD_REQUEST, "a submit names a bundle, or says why there is none")
        return
    if _without_permit(core, event.request, run, turn):
        return
    _accept(core, run, event, turn)


def _again(event: events.Asked[gateway.Submit], row: SubmitRow, turn: Turn) -> None:
    """The answer to a key that is known: the same as the first time, if the request is."""
    message = event.message
    if (message.env_instances, message.bundle) != (row.env_instances, row.bundle):
        text = f"key {message.key!r} was used for submit {row.submit_index} with another request"
        turn.refuse(event.request, Refusal.KEY_CONFLICT, text)
        return
    turn.reply(event.request, _accepted(row))


def _accepted(row: SubmitRow) -> gateway.SubmitAccepted:
    return gateway.SubmitAccepted(
        submit_index=row.submit_index,
        first_global_episode=row.first_global_episode,
        remaining_budget=row.remaining_budget,
    )


def _accept(core: Core, run: Run, event: events.Asked[gateway.Submit], turn: Turn) -> None:
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
        first_global_episode=first_global_episode,
        remaining_budget=run.ledger.available,
        accepted_at=turn.now,
        stimulus_id=turn.stimulus_id,
    )
    run.submits.append(row)
    run.keys[message.key] = index
    turn.reply(event.request, _accepted(row))
    turn.log("info", "submit_accepted", run=run.id, submit=index, episodes=n, remaining=row.remaining_budget)
    failure = message.bundle_error
    if failure is not None:
        run.ledger.settle(index)
        status: SubmitStatus = "import_error"
        if failure.category in NO_POLICY:
            status = cast(SubmitStatus, failure.category)
        run.change_submit(index, turn, status=status, failure=failure, completed_at=turn.now)
        return
    turn.persist(row)
    run.open = index
    play(core, run, row, turn)


def play(core: Core, run: Run, row: SubmitRow, turn: Turn) -> JobGroup:
    """Queue what is left of an open submit."""
    n = len(row.env_instances)
    settings = run.row.settings
    template = Template(
        env=settings.env,
        bundle=row.bundle,
        cases=tuple(run.row.train[case_id] for case_id in row.env_instances),
        case_ids=row.env_instances,
        occurrences=occurrences(row.env_instances),
        secret=run.row.secret,
        split="train",
        submit_index=row.submit_index,
        modulo=n,
        per_job=n if settings.policy_scope == "submit" else 1,
        scope=settings.policy_scope,
        env_meta=env_meta(run, row),
        observations=settings.observations,
        record="full",
        video=settings.video,
        tier=settings.sandbox_tier,
        limits=settings.limits,
        max_steps=run.row.max_steps,
    )
    group = JobGroup(
        id=train_group(run.id, row.submit_index),
        kind="train",
        run=run.id,
        submit_index=row.submit_index,
        flow=run.flow,
        template=template,
        stimulus_id=row.stimulus_id,
        priority=TRAIN,
        created_at=row.accepted_at,
    )
    core.open_group(group, turn)
    return group


def env_meta(run: Run, row: SubmitRow) -> dict[str, object]:
    """What a submit's policies are told, in every split; the worker adds the spaces."""
    return {
        "env": run.row.settings.env,
        "submit_index": row.submit_index,
        "n_episodes_this_submit": len(row.env_instances),
        "remaining_budget_after": row.remaining_budget,
    }


# ---- how a submit goes on and ends ----


def progressed(core: Core, group: JobGroup, outcomes: tuple[EpisodeOutcome, ...], turn: Turn) -> None:
    """Some episodes of an open submit are done."""
    run = core.runs[group.run]
    for outcome in outcomes:
        failure = outcome.failure
        if outcome.index == 0 and failure is not None and failure.category in NO_POLICY:
            end(core, run, group, cast(SubmitStatus, failure.category), failure, turn)
            return
    if group.done == group.n:
        end(core, run, group, "ok", None, turn)
    elif 0 in group.marks:
        answer_polls(core, group, turn)


def timed_out(core: Core, group: JobGroup, turn: Turn) -> None:
    """The operator's limit on a whole submit's wall time has passed."""
    run = core.runs[group.run]
    limit_s = run.row.settings.limits.submit_wall_s
    text = (
        f"the submit took longer than its limit of {limit_s} s; {group.done} of {group.n} episodes were done"
    )
    failure = PolicyFailure(category="episode_timeout", step_index=None, message=text, limit=limit_s)
    end(core, run, group, "rollout_timeout", failure, turn)


def end(
    core: Core, run: Run, group: JobGroup, status: SubmitStatus, failure: PolicyFailure | None, turn: Turn
) -> None:
    """Settle a submit with its verdict."""
    n_kept = 0
    if status == "ok":
        n_kept = group.n
    elif status == "rollout_timeout":
        n_kept = group.first_unfinished()
    row = run.change_submit(
        group.submit_index,
        turn,
        status=status,
        failure=failure,
        completed_at=turn.now,
        first_leased_at=group.first_leased_at,
        released=group.done if n_kept else 0,
        n_kept=n_kept,
        mean_return=group.mean_return() if status == "ok" else None,
        held_s=group.held(turn.now),
    )
    started_at = group.first_leased_at or turn.now
    run.queue_s += max(0.0, started_at - row.accepted_at)
    run.rollout_s += turn.now - started_at
    run.ledger.settle(group.submit_index)
    run.open = None
    core.close_group(group, turn, f"submit ended: {status}")
    answer_polls(core, group, turn)
    turn.log("info", "submit_ended", run=run.id, submit=group.submit_index, status=status, episodes=group.n)
    core.submit_ended(run, row, turn)


# ---- long polls ----


def results(core: Core, event: events.Asked[gateway.ResultsRequest], turn: Turn) -> None:
    """A gateway asks for outcomes: answered at once, or when there are more than it has."""
    message = event.message
    run = core.runs.get(message.run)
    if run is None:
        if message.run in core.capabilities:
            turn.add(
                _page(event.request, message.run, message.submit_index, message.cursor, None, "", 0.0, turn)
            )
        else:
            turn.refuse(event.request, Refusal.UNKNOWN_RUN, f"there is no run {message.run!r}")
        return
    if not 0 <= message.submit_index < len(run.submits):
        text = f"run {run.id!r} has {len(run.submits)} submits, none of index {message.submit_index}"
        turn.refuse(event.request, Refusal.UNKNOWN_SUBMIT, text)
        return
    target = train_group(run.id, message.submit_index)
    poll = Poll(event.request, "results", target, message.cursor)
    closed = run.submits[message.submit_index].status is not None
    ready = closed or _released(core, target) > message.cursor
    if ready or not core.polls.wait(poll, message.wait_s, turn.now):
        answer(core, run, poll, turn)


def _released(core: Core, target: str) -> int:
    """Episodes of an open submit that its gateway may see."""
    group = core.groups[target]
    return group.done if 0 in group.marks else 0


def answer_polls(core: Core, group: JobGroup, turn: Turn) -> None:
    """There is something new for those who wait for a submit's results."""
    for poll in core.polls.take_all(group.id):
        answer(core, core.runs[group.run], poll, turn)


def answer(core: Core, run: Run, poll: Poll, turn: Turn) -> None:
    """Answer a poll with what there is."""
    index = int(poll.target.split("/")[1][1:])
    row = run.submits[index]
    waits_for = "" if row.status is not None else core.waits_for(core.groups[poll.target])
    upto = row.released if row.status is not None else _released(core, poll.target)
    held = held_s(core, run, turn.now)
    turn.add(_page(poll.request, run.id, index, poll.cursor, upto, waits_for, held, turn))


def _page(
    request: events.RequestId,
    run: str,
    index: int,
    cursor: int,
    upto: int | None,
    waits_for: str,
    held: float,
    turn: Turn,
) -> ReadResults:
    return ReadResults(
        request=request,
        run=run,
        submit_index=index,
        cursor=max(0, cursor),
        upto=upto,
        waits_for=waits_for,
        held_s=held,
        stimulus_id=turn.stimulus_id,
    )


def finished_effect(request: events.RequestId, run: str, turn: Turn) -> ReadFinished:
    """Have the shell answer with the finished run."""
    return ReadFinished(request=request, run=run, stimulus_id=turn.stimulus_id)
