"""The document of `GET /info`; pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec

from evopolicy_common import published_forms
from evopolicy_common.messages.gateway import RunState
from evopolicy_common.records.run_record import PROTOCOL_VERSION
from evopolicy_gateway.submits.tickets import Ticket, TicketMachine
from evopolicy_gateway.workspace.agents_md import LAST_WORDS_S

_COUNTS = ("episode_budget", "min_episodes_per_submit", "max_episodes_per_submit")
_SETTINGS = ("policy_scope", "finish", "feedback", "observations", "sandbox_tier", "video")


def info_document(machine: TicketMachine, left: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Everything that an agent may know of the run, as plain values. `left`: of the agent's own limits."""
    run, state = machine.run, machine.state
    env = run.env
    env_meta = {name: getattr(env, name) for name in ("env", "env_version")}
    env_meta |= {"n_env_instances": run.n_env_instances, "max_episode_steps": run.announced_steps}
    env_meta |= {name: getattr(env, name) for name in ("obs_space", "action_space", "obs_storage")}
    if run.profile != "own":
        env_meta |= published_forms.described(env.obs_space, env.action_space, env.obs_storage)
    elif names := env.reward_components:
        env_meta["reward_components"] = {name: env.reward_texts.get(name, "") for name in names}
    rollout_wall_s = min(run.limits.episode_wall_s, run.limits.submit_wall_s or math.inf)
    return {
        "protocol_version": PROTOCOL_VERSION,
        "state": {
            "remaining_budget": state.remaining_budget,
            "n_submits": state.n_submits,
            "is_finalized": machine.spent or state.is_finalized,
        },
        "env_meta": env_meta,
        "episode_ends_after": min(env.max_episode_steps, run.announced_steps),
        **{name: getattr(run, name) for name in _COUNTS},
        "resource_limits": {"rollout_wall_s": rollout_wall_s} | msgspec.to_builtins(run.limits),
        **{name: list(getattr(run, name)) for name in ("allowed_imports", "denied_imports")},
        **{name: getattr(run, name) for name in _SETTINGS},
        "deterministic": env.deterministic,
        "end_grace_s": LAST_WORDS_S,
        "last_warning": machine.last_warning,
        "submit_in_flight": machine.in_flight and progress_document(machine.in_flight, state),
        **({} if left is None else {"left": left}),
    }


def progress_document(ticket: Ticket, state: RunState | None = None) -> dict[str, Any]:
    """The progress of a running submit, and the reason it waits when no episode of it runs.

    `held_s`: seconds of waiting because the cluster's other work used the machines; they count against no limit.
    """
    n_done, waits_for, held_s = ticket.n_done, ticket.waits_for, ticket.held_s
    seen = state.in_flight if state is not None else None
    if seen is not None and ticket.accepted is not None and seen.submit_index == ticket.accepted.submit_index:
        n_done, waits_for = max(n_done, seen.n_done), waits_for or seen.waits_for
        held_s = max(held_s, seen.held_s)
    return {
        "submit_id": ticket.index,
        "status": "running",
        "n_episodes": ticket.n_episodes,
        "n_done": n_done,
        "waits_for": waits_for,
        "held_s": round(held_s, 1),
    }
