"""The result of a finished run, and the progress of an unfinished one: for its operator and for `run.json`."""

from __future__ import annotations

from typing import Literal

from evopolicy_common.messages import operator
from evopolicy_common.records.aggregates import best_validated, mean
from evopolicy_coordinator.core.agents import requests
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import ReadFinished
from evopolicy_coordinator.core.contract.reasons import Reason
from evopolicy_coordinator.core.contract.records import (
    SubmitRow,
    random_group,
    submit_group,
)
from evopolicy_coordinator.core.runs import waits
from evopolicy_coordinator.core.structures.timers import Poll
from evopolicy_coordinator.core.tables.model import Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep


def unspent(run: Run) -> int:
    """Unspent episodes of a run that must spend its budget; 0 for other runs, or if fewer remain
    than a submit's minimum."""
    n = run.ledger.available
    return n if run.row.settings.finish == "budget" and n >= run.row.min_episodes_per_submit else 0


def ok_submits(run: Run) -> list[SubmitRow]:
    return [row for row in run.submits if row.status == "ok"]


def fails(run: Run, n_failed: int) -> bool:
    """Whether hidden episodes with that many failures of the policy have no mean return."""
    return n_failed > 0 and run.row.settings.failed_episodes == "end-submit"


def select(run: Run) -> SubmitRow | None:
    """The eligible checkpoint with the best validation (`best_validated`); None when none is eligible."""
    means = {
        row.submit_index: row.val_mean
        for row in ok_submits(run)
        if not row.ineligible and row.val_mean is not None
    }
    best = best_validated(means, run.row.settings.profile)
    return None if best is None else run.submits[best]


def result(
    state: State, run: Run, best: SubmitRow | None, now: float, *, cancelled: bool, error: str | None = None
) -> operator.RunFinished:
    """Builds the record of a run that is over; `best` is its selected submit. `now` is Unix time in seconds. `error`:
    why it cannot be scored."""
    row, stored, ok = run.row, run.state, ok_submits(run)
    status: operator.RunEnd = "completed"
    if cancelled:
        status = "error" if error else "cancelled"
    elif n_unspent := unspent(run):
        status = "error"
        error = (
            f"the run ended ({stored.close_reason.replace('_', ' ')}) with {n_unspent} of its {row.budget}"
            " episodes left, and must spend them (finish = budget)"
        )
    elif best is None:
        status = "no_ok_submit"
    elif fails(run, failed := run.hidden_failures.get(submit_group(run.id, best.submit_index, "heldout"), 0)):
        status = "error"
        error = (
            f"the selected policy failed in {failed} of {len(row.heldout)} held-out episodes, so the run has no score"
            " (failed_episodes = end-submit)"
        )
    heldout: tuple[float, ...] = ()
    successes: tuple[bool, ...] = ()
    failures: dict[str, int] = {}
    final_score = None
    if best is not None:
        index = best.submit_index
        heldout = run.hidden_returns[submit_group(run.id, index, "heldout")]
        successes = run.hidden_successes.get(submit_group(run.id, index, "heldout"), ())
        final_score = mean(heldout) if status == "completed" else None
        failures = {
            "validation": run.hidden_failures.get(submit_group(run.id, index, "validation"), 0),
            "heldout": run.hidden_failures.get(submit_group(run.id, index, "heldout"), 0),
        }
    description = stored.description
    told = stored.agent.get("record", {})
    closed_at = now if stored.closed_at is None else stored.closed_at
    return operator.RunFinished(
        run=run.id,
        settings=row.settings,
        status=status,
        error=error,
        closed_reason=stored.close_reason,
        agent={name: fact for name, fact in stored.agent.items() if name != "record"},
        record=told if isinstance(told, dict) else {},
        final_score=final_score,
        best_submit_index=None if best is None else best.submit_index,
        heldout_returns=heldout,
        heldout_successes=successes,
        validation_ineligible=tuple(each.submit_index for each in ok if each.ineligible),
        policy_failures=failures,
        random_heldout_returns=run.hidden_returns.get(random_group(run.id), ()),
        budget=row.budget,
        min_episodes_per_submit=row.min_episodes_per_submit,
        max_episodes_per_submit=row.max_episodes_per_submit,
        n_train=len(row.train),
        n_validation=len(row.validation),
        n_heldout=len(row.heldout),
        budget_used=run.ledger.settled,
        split_hashes=row.split_hashes,
        cases_secret=row.cases_secret,
        env_version="" if description is None else description.env_version,
        deterministic=True if description is None else description.deterministic,
        env_title="" if description is None else description.title,
        env_family="" if description is None else description.family,
        fingerprint=stored.fingerprint,
        created_at=row.created_at,
        finished_at=now,
        submits=tuple(
            operator.SubmitResult(
                submit_index=each.submit_index,
                status=each.status,
                bundle=each.bundle,
                env_instances=each.env_instances,
                remaining_budget=each.remaining_budget,
                mean_return=each.mean_return,
                val_mean=each.val_mean,
                started_at=each.accepted_at,
                completed_at=each.completed_at,
                tree=each.tree,
            )
            for each in run.submits
            if each.env_instances
            and not each.refunded
            and each.status is not None
            and each.completed_at is not None
        ),
        wall_s={"queue": run.queue_s, "rollout": run.rollout_s, "finalise": max(0.0, now - closed_at)},
        infrastructure_retries=stored.infrastructure_retries,
        nondeterministic_results=stored.nondeterministic_results,
        hidden_isolation=stored.isolation,
        n_overrides=len(stored.overrides),
        fingerprint_overrides=stored.overrides,
        committed=stored.committed,
        installations=stored.installations,
    )


# ---- waiting for the end ----


def waited(state: State, event: events.Requested[operator.WaitRun], step: CoreStep) -> None:
    message = event.message
    run = requests.known_run(state, message.run)
    if run is None:
        step.add(ReadFinished(request=event.request, run=message.run))
        return
    poll = Poll(event.request, "run", run.id)
    if not state.polls.wait(poll, message.wait_s, step.now):
        step.reply(event.request, *progress(state, run))


def answer(state: State, poll: Poll, step: CoreStep) -> None:
    """An operator's wait for the end of a run has timed out."""
    step.reply(poll.request, *progress(state, state.runs[poll.target]))


def progress(state: State, run: Run) -> tuple[operator.RunProgress, Reason | None]:
    """Returns the progress of an unfinished run for its operator, and the reason that it waits for."""
    if run.state.phase == "open" or run.open is not None:
        group = None if run.open is None else state.groups[submit_group(run.id, run.open, "train")]
        done = run.ledger.settled + (0 if group is None else group.done)
        waits_for = None if group is None else waits.waits_for(state, group)
        if run.state.description is None:  # its gateway cannot serve yet
            waits_for = waits.waits_for_workers(state, run.flow)
        return operator.RunProgress(phase="open", done=done, total=run.row.budget), waits_for
    ok = [row for row in ok_submits(run) if not row.ineligible]
    n = len(run.row.validation)
    groups = [state.groups.get(submit_group(run.id, row.submit_index, "validation")) for row in ok]
    done = sum(n if group is None else group.done for group in groups)
    playing = [group for group in groups if group is not None]
    if playing:
        waits_for = waits.waits_for(state, playing[0])
        return operator.RunProgress(phase="validation", done=done, total=n * len(ok)), waits_for
    best = select(run)
    group = None if best is None else state.groups.get(submit_group(run.id, best.submit_index, "heldout"))
    phase: Literal["heldout", "random"] = "heldout"
    if group is None:
        phase, group = "random", state.groups.get(random_group(run.id))
    total = len(run.row.heldout)
    if group is None:
        return operator.RunProgress(phase=phase, done=total, total=total), None
    return operator.RunProgress(phase=phase, done=group.done, total=total), waits.waits_for(state, group)
