"""Runs: their creation, the replies to their gateways, and what is kept of finished ones.

Rules that this module owns:
- One run per key, with its whole budget available.
- No reply to a gateway depends on hidden results.
- A run is durable together with the journal's entry that commits to it.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages.gateway import CANCELLED
from evopolicy_common.messages.status import RetriedJobs
from evopolicy_common.records.splits import SPLITS
from evopolicy_coordinator.core.agents import requests
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.reasons import NotDoneError, Reason
from evopolicy_coordinator.core.contract.records import RunRow, RunStateRow, submit_group
from evopolicy_coordinator.core.leasing import pins
from evopolicy_coordinator.core.runs import journal, waits
from evopolicy_coordinator.core.structures.ledger import Ledger
from evopolicy_coordinator.core.tables.model import Flow, Run
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import (
    CoreStep,
    EpisodesDone,
    FlowPinned,
    JobRetried,
    ResultsDiffered,
)

MOST_INSTALLATIONS = 64
"""A run's record names no more: a worker may register as often as it wants, each time with another one."""


def create(state: State, event: events.RunRequested, step: CoreStep) -> None:
    """Create a run, once for each key."""
    row = event.row
    known = state.run_keys.get(row.key)
    if known is not None:
        step.reply(event.request, operator.RunCreated(run=known, capability=state.capabilities[known]))
        return
    _check(row)
    journal.check_epoch(state, row)
    if row.run in state.capabilities:
        raise NotDoneError("run_exists", run=row.run)
    row = msgspec.structs.replace(row, created_at=step.now, stimulus_id=step.stimulus_id)
    committed = journal.opened(state, row, step)
    stored = RunStateRow(run=row.run, committed=committed, isolation=requests.stamp(state, row))
    step.persist(row)
    run = enter(state, row, stored)
    step.persist(stored)
    pins.pin(state, run.flow, step)
    step.reply(event.request, operator.RunCreated(run=row.run, capability=row.capability))
    step.log("info", "run_created", run=row.run, env=row.settings.env, budget=row.budget)


def enter(state: State, row: RunRow, stored: RunStateRow) -> Run:
    """Add a run to the core, with its whole budget available."""
    settings = row.settings
    flow = Flow(
        row.run,
        settings.env,
        settings.sandbox_tier,
        "run",
        row.secret,
        case_set=state.case_sets.join(settings.env, (*row.validation, *row.heldout, *row.related)),
        definition=settings.definition,
    )
    pins.add_flow(state, flow)
    run = Run(row, stored, Ledger(row.budget), flow)
    state.runs[row.run] = run
    state.run_keys[row.key] = row.run
    state.capabilities[row.run] = row.capability
    return run


def forget(state: State, run: Run) -> None:
    """Remove a finished run; only the last state that its gateway may request is kept."""
    del state.runs[run.id]
    state.finished[run.id] = last_state(run.state)
    pins.drop_flow(state, run.flow)


def _check(row: RunRow) -> None:
    least, most = row.min_episodes_per_submit, row.max_episodes_per_submit
    if row.budget < 1:
        raise NotDoneError("budget_below_one", budget=row.budget)
    if not 1 <= least <= most:
        raise NotDoneError("submit_bounds", least=least, most=most)
    if least > row.budget:
        raise NotDoneError("minimum_over_budget", least=least, budget=row.budget)
    for split in SPLITS:
        if not row.cases(split):
            raise NotDoneError("no_cases", split=split)


# ---- requests of gateways ----


def opened(state: State, event: events.Requested[gateway.OpenRun], step: CoreStep) -> None:
    """Send a gateway the fixed parameters of its run; refused until a worker has offered the environment."""
    run = requests.live(state, event.message.run)
    if run.flow.pin is None:
        pins.pin(state, run.flow, step)
    description = run.flow.description
    if description is None:
        raise NotDoneError("no_worker_yet", waits_for=waits.waits_for_workers(state, run.flow))
    if not event.message.asks_permit:
        requests.demand_permit(state, run, step)
    current, waits_for = run_state(state, run, step.now)
    row, settings = run.row, run.row.settings
    step.reply(
        event.request,
        gateway.RunOpened(
            **{name: getattr(settings, name) for name in gateway.Conditions.__struct_fields__},
            env=description,
            n_env_instances=len(row.train),
            episode_budget=row.budget,
            min_episodes_per_submit=row.min_episodes_per_submit,
            max_episodes_per_submit=row.max_episodes_per_submit,
            sandbox_tier=settings.sandbox_tier,
            limits=settings.limits,
            allowed_imports=row.allowed_imports,
            denied_imports=row.denied_imports,
            state=current,
            max_steps=row.max_steps,
        ),
        waits_for,
    )


def state_requested(state: State, event: events.Requested[gateway.StateRequest], step: CoreStep) -> None:
    """Send a gateway the state of its run, also after it is finished."""
    last = state.finished.get(event.message.run)
    if last is not None:
        step.reply(event.request, last)
        return
    current, waits_for = run_state(state, requests.live(state, event.message.run), step.now)
    step.reply(event.request, current, waits_for)


def last_state(row: RunStateRow) -> gateway.RunState:
    """The state that the gateway of a finished run is sent."""
    return gateway.RunState(
        remaining_budget=row.remaining_budget,
        n_submits=row.n_submits,
        is_finalized=True,
        cancelled=row.close_reason == CANCELLED,
    )


def held_s(state: State, run: Run, now: float) -> float:
    """Seconds for which hidden jobs held a run's submits."""
    group = None if run.open is None else state.groups.get(submit_group(run.id, run.open, "train"))
    return sum(row.held_s for row in run.submits) + (0.0 if group is None else group.held_until_s(now))


def run_state(state: State, run: Run, now: float) -> tuple[gateway.RunState, Reason | None]:
    """The state that the gateway of an unfinished run is sent, and the reason that its open submit waits for."""
    group = None if run.open is None else state.groups[submit_group(run.id, run.open, "train")]
    current = gateway.RunState(
        remaining_budget=run.ledger.available,
        n_submits=len(run.submits),
        is_finalized=run.state.phase != "open",
        held_s=held_s(state, run, now),
        open_held_s=0.0 if group is None else group.held_until_s(now),
        n_done=0 if group is None else group.done,
    )
    return current, None if group is None else waits.waits_for(state, group)


# ---- news ----


def pinned(state: State, news: FlowPinned, step: CoreStep) -> None:
    """Store the class of workers that a run is pinned to."""
    run, profile = state.runs[news.flow.id], news.profile
    step.change_run(
        run,
        fingerprint_class=profile.classes[news.flow.env],
        description=profile.descriptions[news.flow.env],
        fingerprint=profile.fingerprints[news.flow.env],
    )
    step.log("info", "run_pinned", run=run.id, fingerprint_class=profile.classes[news.flow.env])


def played(state: State, news: EpisodesDone, step: CoreStep) -> None:
    """Note the installation of a worker that has played some of a run's episodes."""
    run, name = state.runs.get(news.group.run), "" if news.worker is None else news.worker.installation
    if run is not None and name:
        known = run.state.installations
        if name not in known and len(known) < MOST_INSTALLATIONS:
            step.change_run(run, installations=(*known, name))


def retried(state: State, news: JobRetried, step: CoreStep) -> None:
    """Count an infrastructure retry, and keep the last ones for operators; `run.json` has the total."""
    run = state.runs.get(news.job.group.run)
    if run is None:
        return
    step.change_run(run, infrastructure_retries=run.state.infrastructure_retries + 1)
    one = RetriedJobs(at=step.now, worker=news.worker, failure=news.failure)
    last = run.retries[-1] if run.retries else None
    if last is not None and last == replace(one, jobs=last.jobs):  # the same failure in the same step
        one = replace(run.retries.pop(), jobs=last.jobs + 1)
    run.retries.append(one)


def differed(state: State, news: ResultsDiffered, step: CoreStep) -> None:
    """Count two differing results of one episode; `run.json` has the total."""
    run = state.runs.get(news.group.run)
    if run is not None:
        step.change_run(run, nondeterministic_results=run.state.nondeterministic_results + 1)
