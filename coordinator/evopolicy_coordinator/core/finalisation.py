"""What follows once a run takes no more submits: validation, selection, held-out, the random reference.

Rules that this module owns:
- Every ok checkpoint is validated on all hidden validation cases. That begins as soon as it is ok, in idle slots, and is
  never played twice: an outcome is stored under (run, submit, split, index), which fixes bundle, env_meta, case, scope and
  policy seed, in a run that is pinned to one fingerprint class.
- Selection waits until every ok checkpoint is validated or ineligible. The highest mean wins, a tie goes to the later submit.
- A checkpoint that an earlier version found ineligible stays so, and only the finished run says it.
- The selected checkpoint plays all held-out cases; uniform random actions play the same ones. Those actions follow from
  split and case (`seeds.reference_seed`), except in a run that was created when they followed from its secret.
- Each stage is found again from the store: `advance` may be called any number of times.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages.environment import PolicyScope
from evopolicy_common.wire.refusals import Refusal

from . import audit, events
from .jobs import EARLY_VALIDATION, HELDOUT, REFERENCE, JobGroup, Template
from .polls import Poll
from .records import (
    FinishedRow,
    SubmitRow,
    heldout_group,
    random_group,
    submit_done,
    train_group,
    validation_group,
)
from .runs import Run, answer_polls, env_meta, finished_effect
from .turn import Turn

if TYPE_CHECKING:
    from .machine import Core

RANDOM = -1
"""Submit index of the random reference."""


# ---- groups ----


def validate_early(core: Core, run: Run, row: SubmitRow, turn: Turn) -> None:
    """Queue the validation of an ok checkpoint; in idle slots only as long as the run is open."""
    priority = EARLY_VALIDATION if run.state.phase == "open" else HELDOUT
    _open(core, run, "validation", row, priority, turn)


def _open(
    core: Core,
    run: Run,
    kind: Literal["validation", "heldout", "random"],
    row: SubmitRow | None,
    priority: int,
    turn: Turn,
) -> None:
    settings = run.row.settings
    cases = run.row.validation if kind == "validation" else run.row.heldout
    secret: bytes | None = run.row.secret
    split: str = kind
    if row is None:
        name, index, modulo, bundle = random_group(run.id), RANDOM, len(cases), None
        if run.row.reference_by_case:
            secret, split = None, "heldout"
        scope: PolicyScope = "episode"
        meta: dict[str, object] = {"env": settings.env}
    else:
        index, modulo, bundle = row.submit_index, len(row.env_instances), row.bundle
        name = validation_group(run.id, index) if kind == "validation" else heldout_group(run.id, index)
        scope, meta = settings.policy_scope, env_meta(run, row)
    if name in core.groups:
        return
    template = Template(
        env=settings.env,
        bundle=bundle,
        cases=cases,
        case_ids=tuple(range(len(cases))),
        occurrences=(0,) * len(cases),
        secret=secret,
        split=split,
        submit_index=index,
        modulo=modulo,
        per_job=modulo if scope == "submit" else 1,
        scope=scope,
        env_meta=meta,
        observations=settings.observations,
        record="actions",
        video=settings.recorded_heldout if kind == "heldout" else "off",
        tier=settings.sandbox_tier,
        limits=settings.limits,
        max_steps=run.row.max_steps,
    )
    group = JobGroup(
        id=name,
        kind=kind,
        run=run.id,
        submit_index=index,
        flow=run.flow,
        template=template,
        stimulus_id=run.row.stimulus_id if row is None else row.stimulus_id,
        priority=priority,
        created_at=turn.now,
    )
    core.open_group(group, turn)


def progressed(core: Core, group: JobGroup, turn: Turn) -> None:
    """Some hidden episodes are done."""
    if group.done < group.n:
        return
    run = core.runs[group.run]
    run.hidden_failures[group.id] = group.failed()
    if group.kind == "validation":
        run.change_submit(group.submit_index, turn, val_mean=group.mean_return())
    else:
        run.hidden_returns[group.id] = group.returns()
    core.close_group(group, turn, "all done")
    advance(core, run, turn)


# ---- stages ----


def close(core: Core, event: events.Asked[gateway.CloseRun], turn: Turn) -> None:
    """The agent is gone: no more submits, and the hidden cases are played. Closing twice is closing once."""
    message = event.message
    run = core.runs.get(message.run)
    if run is None and message.run not in core.capabilities:
        turn.refuse(event.request, Refusal.UNKNOWN_RUN, f"there is no run {message.run!r}")
        return
    core.isolation.end(message.run, turn, "its run was closed")
    core.isolation.drop_asks(message.run, Refusal.RUN_CLOSED, f"run {message.run!r} is closed", turn)
    if run is not None and run.state.phase == "open":
        run.change(turn, phase="closed", closed_at=turn.now, close_reason=message.reason, agent=message.agent)
        core.queue.close(run.flow)
        turn.log("info", "run_closed", run=run.id, reason=message.reason, submits=len(run.submits))
        advance(core, run, turn)
    turn.reply(event.request, gateway.RunClosed())


def advance(core: Core, run: Run, turn: Turn) -> None:
    """Take a closed run as far as it can go now."""
    if run.state.phase != "closed" or run.open is not None:
        return
    if _unspent(run):
        _finish(core, run, None, turn, unplayed=True)
        return
    if random_group(run.id) not in run.hidden_returns:
        _open(core, run, "random", None, REFERENCE, turn)
    waiting = [row for row in _ok(run) if row.val_mean is None and row.ineligible is None]
    for row in waiting:
        validate_early(core, run, row, turn)
        core.promote(core.groups[validation_group(run.id, row.submit_index)], HELDOUT, turn)
    if waiting:
        return
    best = select(run)
    if best is not None and heldout_group(run.id, best.submit_index) not in run.hidden_returns:
        _open(core, run, "heldout", best, HELDOUT, turn)
        return
    if random_group(run.id) in run.hidden_returns and not audit.holds_up(core, run, turn):
        _finish(core, run, best, turn)


def _unspent(run: Run) -> int:
    """Episodes of its budget that the agent of a run which must spend it has left; what no submit can have does not count."""
    left = run.ledger.available
    return left if run.row.settings.finish == "budget" and left >= run.row.min_episodes_per_submit else 0


def _ok(run: Run) -> list[SubmitRow]:
    return [row for row in run.submits if row.status == "ok"]


def select(run: Run) -> SubmitRow | None:
    """The eligible checkpoint with the highest validation mean, the later of equals; None when there is none."""
    best: SubmitRow | None = None
    best_mean = 0.0
    for row in _ok(run):
        if (
            row.ineligible is None
            and row.val_mean is not None
            and (best is None or row.val_mean >= best_mean)
        ):
            best, best_mean = row, row.val_mean
    return best


def cancel(core: Core, event: events.Asked[operator.CancelRun], turn: Turn) -> None:
    """An operator ends a run here and now: nothing of it is scored."""
    message = event.message
    run = core.runs.get(message.run)
    if run is None:
        if core.cancel_evaluation(message.run, turn) or message.run in core.capabilities:
            turn.reply(event.request, operator.Done())
        else:
            turn.refuse(event.request, Refusal.UNKNOWN_RUN, f"there is no run {message.run!r}")
        return
    if run.open is not None:
        index, run.open = run.open, None
        run.ledger.refund(index)
        run.change_submit(index, turn, status="cancelled", completed_at=turn.now, refunded=True)
        group = core.groups[train_group(run.id, index)]
        core.close_group(group, turn, "run cancelled")
        answer_polls(core, group, turn)
    if run.state.phase == "open":
        run.change(turn, phase="closed", closed_at=turn.now, close_reason=gateway.CANCELLED)
        core.isolation.cancelled(run.id, turn)
    core.isolation.drop_asks(run.id, Refusal.RUN_CANCELLED, f"run {run.id!r} was cancelled", turn)
    _finish(core, run, None, turn, cancelled=True, unplayed=True)
    turn.reply(event.request, operator.Done())


def _finish(
    core: Core,
    run: Run,
    best: SubmitRow | None,
    turn: Turn,
    *,
    cancelled: bool = False,
    unplayed: bool = False,
) -> None:
    """The run is over: its result becomes durable, and all that the core holds of it goes. `unplayed`: as far as it got."""
    audit.cancel(core, run, turn)
    core.timers.disarm(("audits", run.id))
    for group in [group for group in core.groups.values() if group.run == run.id] if unplayed else []:
        core.close_group(group, turn, "run cancelled" if cancelled else "budget not spent")
    result = _result(core, run, best, turn.now, cancelled=cancelled)
    turn.persist(FinishedRow(run=run.id, result=result))
    run.change(turn, phase="finished", remaining_budget=run.ledger.available, n_submits=len(run.submits))
    core.forget_run(run)
    for poll in core.polls.take_all(run.id):
        turn.add(finished_effect(poll.request, run.id, turn))
    turn.log("info", "run_finished", run=run.id, status=result.status, best=result.best_submit_index)


def _result(
    core: Core, run: Run, best: SubmitRow | None, now: float, *, cancelled: bool
) -> operator.RunFinished:
    row, state, ok = run.row, run.state, _ok(run)
    status: Literal["completed", "no_ok_submit", "error", "cancelled"] = "completed"
    error = None
    if cancelled:
        status = "cancelled"
    elif left := _unspent(run):
        status = "error"
        error = (
            f"the run ended ({state.close_reason.replace('_', ' ')}) with {left} of its {row.budget} episodes left, and"
            " must spend them (finish = budget)"
        )
    elif not ok:
        status = "no_ok_submit"
    elif best is None:
        status, error = "error", "no ok checkpoint is eligible: each brought its slots down while hidden"
    heldout: tuple[float, ...] = ()
    failures: dict[str, int] = {}
    final_score = None
    if best is not None:
        index = best.submit_index
        heldout = run.hidden_returns[heldout_group(run.id, index)]
        final_score = mean(heldout)
        failures = {
            "validation": run.hidden_failures.get(validation_group(run.id, index), 0),
            "heldout": run.hidden_failures.get(heldout_group(run.id, index), 0),
        }
    description = state.description
    closed_at = now if state.closed_at is None else state.closed_at
    return operator.RunFinished(
        run=run.id,
        settings=row.settings,
        status=status,
        error=error,
        close_reason=state.close_reason,
        agent=state.agent,
        final_score=final_score,
        best_submit_index=None if best is None else best.submit_index,
        val_scores={each.submit_index: each.val_mean for each in ok if each.val_mean is not None},
        heldout_returns=heldout,
        validation_ineligible={
            each.submit_index: each.ineligible for each in ok if each.ineligible is not None
        },
        policy_failures=failures,
        random_heldout_returns=run.hidden_returns.get(random_group(run.id), ()),
        reference_by_case=row.reference_by_case,
        episode_budget=row.budget,
        budget_used=run.ledger.settled,
        split_hashes=row.split_hashes,
        split_secret=row.split_secret,
        env_version="" if description is None else description.env_version,
        deterministic=True if description is None else description.deterministic,
        fingerprint=state.fingerprint,
        created_at=row.created_at,
        closed_at=closed_at,
        finished_at=now,
        submits=tuple(_submit_record(each) for each in run.submits if not each.refunded),
        wall_s={"queue": run.queue_s, "rollout": run.rollout_s, "finalise": max(0.0, now - closed_at)},
        infrastructure_retries=state.infrastructure_retries,
        nondeterministic_results=state.nondeterministic_results,
        audit=audit.record(core, run),
        hidden_isolation=state.isolation,
        fingerprint_overrides=state.overrides,
    )


def mean(returns: tuple[float, ...]) -> float:
    """Mean, summed exactly."""
    return math.fsum(returns) / len(returns)


def _submit_record(row: SubmitRow) -> operator.SubmitRecord:
    done = submit_done(row)
    assert done is not None
    return operator.SubmitRecord(
        submit_index=row.submit_index,
        status=done.status,
        bundle=row.bundle,
        env_instances=row.env_instances,
        remaining_budget=row.remaining_budget,
        mean_return=row.mean_return,
        val_mean=row.val_mean,
        started_at=row.accepted_at,
        completed_at=done.completed_at,
    )


# ---- waiting for the end ----


def waited(core: Core, event: events.Asked[operator.WaitRun], turn: Turn) -> None:
    """An operator waits for the end of a run."""
    message = event.message
    run = core.runs.get(message.run)
    if run is None:
        if message.run in core.capabilities:
            turn.add(finished_effect(event.request, message.run, turn))
        else:
            turn.refuse(event.request, Refusal.UNKNOWN_RUN, f"there is no run {message.run!r}")
        return
    poll = Poll(event.request, "run", run.id)
    if not core.polls.wait(poll, message.wait_s, turn.now):
        turn.reply(event.request, progress(core, run))


def progress(core: Core, run: Run) -> operator.RunProgress:
    """Where an unfinished run stands, for its operator."""
    if run.state.phase == "open" or run.open is not None:
        group = None if run.open is None else core.groups[train_group(run.id, run.open)]
        done = run.ledger.settled + (0 if group is None else group.done)
        waits_for = "" if group is None else core.waits_for(group)
        if run.state.description is None:  # its gateway cannot serve yet
            waits_for = core.waits_for_workers(run.flow)
        return operator.RunProgress(phase="open", done=done, total=run.row.budget, waits_for=waits_for)
    ok = [row for row in _ok(run) if row.ineligible is None]
    n = len(run.row.validation)
    groups = [core.groups.get(validation_group(run.id, row.submit_index)) for row in ok]
    done = sum(n if group is None else group.done for group in groups)
    playing = [group for group in groups if group is not None]
    if playing:
        waits_for = core.waits_for(playing[0])
        return operator.RunProgress(phase="validation", done=done, total=n * len(ok), waits_for=waits_for)
    best = select(run)
    group = None if best is None else core.groups.get(heldout_group(run.id, best.submit_index))
    phase: Literal["heldout", "random"] = "heldout"
    if group is None:
        phase, group = "random", core.groups.get(random_group(run.id))
    total = len(run.row.heldout)
    if group is None:
        return operator.RunProgress(phase=phase, done=total, total=total, waits_for=audit.waits_for(run))
    return operator.RunProgress(phase=phase, done=group.done, total=total, waits_for=core.waits_for(group))
