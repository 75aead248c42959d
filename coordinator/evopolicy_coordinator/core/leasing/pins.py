"""Pins: the class of workers that plays a run or an evaluation, from its first episode to its last.

Rules that this module owns:
- A flow is pinned to the fingerprint class that serves it best when it is created, or as soon as one exists.
- The flow's run or evaluation receives the news (`FlowPinned`) and stores the class.
"""

from __future__ import annotations

import msgspec

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_coordinator.core.leasing import fleet, queue
from evopolicy_coordinator.core.tables.model import Flow, Profile, Run, Worker
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep, FlowPinned


def add_flow(state: State, flow: Flow) -> None:
    """Enter the flow of a run or an evaluation, not pinned to workers yet."""
    state.n_flows += 1
    flow.seq = state.n_flows
    state.unpinned[flow.id] = flow


def drop_flow(state: State, flow: Flow) -> None:
    """Remove the flow of a finished run or evaluation, which has no waiting jobs."""
    state.unpinned.pop(flow.id, None)
    if flow.lane is not None:
        flow.lane.n_flows -= 1
        flow.lane = None
    state.case_sets.leave(flow.case_set)


def pin(state: State, flow: Flow, step: CoreStep) -> None:
    """Pin a flow to the fingerprint class that serves it best now, if there is one."""
    profile = fleet.offer(state, flow) if flow.pin is None else None
    if profile is None:
        return
    place(state, flow, profile.classes[flow.env], step)
    flow.description = profile.descriptions[flow.env]
    step.tell(FlowPinned(flow, profile))


def place(state: State, flow: Flow, fingerprint_class: str, step: CoreStep) -> None:
    """Pin a flow to a class of workers; its waiting jobs then wait for them."""
    state.unpinned.pop(flow.id, None)
    step.dirty[queue.place(state, flow, fingerprint_class)] = None


def pin_waiting(state: State, worker: Worker, step: CoreStep) -> None:
    """When a worker becomes available, pin the flows that no worker could serve before."""
    for flow in list(state.unpinned.values()):
        if worker.profile.offers(flow):
            pin(state, flow, step)


# ---- in words ----


def refused_runs(state: State, profile: Profile) -> dict[str, str]:
    """Unfinished runs in the profile's environments that its workers get no jobs of, with the reason."""
    refused = {
        run.id: _mismatch(run, profile)
        for run in state.runs.values()
        if run.flow.env in profile.classes and run.flow.pin not in (None, profile.classes[run.flow.env])
    }
    return refused | {
        run.id: f"the run demands sandbox tier {run.flow.tier}; the worker has {', '.join(sorted(profile.key[1]))}"
        for run in state.runs.values()
        if run.flow.env in profile.descriptions and run.flow.tier not in profile.key[1]
    }


def _mismatch(run: Run, profile: Profile) -> str:
    env = run.flow.env
    text = f"the run is pinned to fingerprint class {run.flow.pin}, the worker is of class {profile.classes[env]}"
    began = run.state.fingerprint
    if began is None:
        return text
    theirs, ours = began.versions(), profile.fingerprints[env].versions()
    differing = [
        f"{name} {theirs.get(name, 'none')} there, {ours.get(name, 'none')} here"
        for name in sorted(theirs.keys() | ours.keys())
        if theirs.get(name) != ours.get(name) and name not in (_NO_PART if began.adapter else ())
    ]
    if run.state.description is not None:
        differing += differences(run.state.description, profile.descriptions[env])
    return f"{text} ({'; '.join(differing)})" if differing else text


_NO_PART = ("evopolicy-worker",)
"""Not part of the class of a single environment."""


def differences(there: EnvironmentDescription, here: EnvironmentDescription) -> list[str]:
    """Differences between two definitions of one environment, one entry per field, values cut to
    `_SHOWN` characters."""
    ours, theirs = msgspec.to_builtins(here), msgspec.to_builtins(there)
    return [
        f"{name} {_short(theirs[name])} there, {_short(ours[name])} here"
        for name in ours
        if name not in ("env_version", "adapter", "packages", "step_us") and ours[name] != theirs[name]
    ]


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


_SHOWN = 60
"""Characters of a value that are shown."""
