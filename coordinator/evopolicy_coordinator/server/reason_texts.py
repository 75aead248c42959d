"""Texts of the core's reasons for operators, gateways and, through them, agents.

Rule that this module owns: agents learn nothing of hidden results. Of the reasons why a submit waits,
an agent learns at most that it waits for hidden cases of another run to be scored.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from evopolicy_common.catalogue import installs
from evopolicy_common.messages.gateway import FREE_SLOT, Permit, RunOpened, RunState
from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.messages.worker import Message, Refused
from evopolicy_coordinator.core.contract.effects import Refuse, Reply
from evopolicy_coordinator.core.contract.reasons import REFUSALS, Reason
from evopolicy_coordinator.core.isolation.conflicts import NO_BOOT_ID


def _workers(
    env: str,
    tier: str,
    same_versions: bool,
    away: tuple[str, ...],
    connected: bool,
    lacking: tuple[tuple[str, str], ...],
    failed: tuple[tuple[str, str], ...],
) -> str:
    wanted = f"a worker that offers {env} with sandbox tier {tier}"
    if same_versions:
        wanted += ", of the versions that the run started with"
    if lacking:
        reasons = "; ".join(f"{worker}: {why}" for worker, why in lacking)
        wanted += f" (the tier does not work on {reasons})"
    if failed:
        # The reasons may name files and code of the environment, which are not for agents.
        return f"{wanted}; it failed on {', '.join(worker for worker, _ in failed)}"
    if away:
        return f"{wanted}: those that do are {' or '.join(away)}"
    if not connected:
        # A worker that is still starting lacks nothing that has to be installed.
        return f"{wanted}; no worker is connected yet"
    advice = "" if lacking else installs.advice(env)
    return f"{wanted} ({advice} on a machine)" if advice else wanted


def _agent_alive(run: str, place: str) -> str:
    where = f"on {place}" if place else "on any machine"
    return (
        f"the agent of {run} to end, which may be alive {where}; if it is not, resume that run, or run"
        f" `evopolicy runs agent-gone {run}`; to end it, run `evopolicy runs cancel {run}`"
    )


TEXTS: Mapping[str, str | Callable[..., str]] = {
    **{code: text for code, (_, text) in REFUSALS.items()},
    "workers": _workers,
    "description": "a connected worker to describe {env}, as it does before its first episode",
    "scoring": "hidden cases of another run to be scored",
    "to_report": "workers of this machine to report that they play no hidden cases",
    "agent_alive": _agent_alive,
    "agent_starting": "an agent that is about to start there",
    "related_train": "train episodes of runs with the same hidden cases to end",
    "unknown_kernel": f"a worker that reports its kernel's boot id: {NO_BOOT_ID}",
    "adoption": "workers to report after a restart",
    "own_fault": "a retry after an infrastructure failure",
    "bench": "workers whose jobs kept failing to be tried again",
    "free_slot": FREE_SLOT,
}
"""By code: a text with placeholders for the reason's details, or a function of them."""


def reason_text(reason: Reason | None, state: Path | None = None) -> str:
    """A reason as text; empty for None. `state`: the folder that commands for the operator name."""
    if reason is None:
        return ""
    text = TEXTS[reason.code]
    about = {
        name: reason_text(each) if isinstance(each, Reason) else each for name, each in reason.about.items()
    }
    if not isinstance(text, str):
        return text(**about)
    return text.format(**about, state="STATE" if state is None else shlex.quote(str(state)))


def env_failure(reason: Reason | None) -> str:
    """Why the environment that is waited for failed, if no connected worker offers it; empty otherwise. For
    operators."""
    failed = () if reason is None or reason.code != "workers" else reason.about["failed"]
    return (failed[0][1] or "the worker's log has the reason") if failed else ""


def operator_words(reason: Reason | None) -> str:
    """A reason as text for operators, with the reason for which an environment failed; empty for None."""
    return ": ".join(filter(None, (reason_text(reason), env_failure(reason))))


def message(effect: Reply | Refuse, state: Path | None = None) -> Message:
    """The reply for the client: the effect's message, with its reason as text. `state` as in `reason_text`."""
    if isinstance(effect, Refuse):
        return Refused(status=effect.status, message=reason_text(effect.reason, state))
    reply = effect.message
    if effect.waits_for is None:
        return reply
    text = reason_text(effect.waits_for)
    if isinstance(reply, RunOpened):
        return msgspec.structs.replace(reply, state=msgspec.structs.replace(reply.state, waits_for=text))
    if isinstance(reply, RunProgress):
        why = env_failure(effect.waits_for)
        return msgspec.structs.replace(reply, waits_for=operator_words(effect.waits_for), env_failure=why)
    assert isinstance(reply, Permit | RunState)
    return msgspec.structs.replace(reply, waits_for=text)
