"""Permits: how gateways ask for them, and what ends them beside the run's own end. `isolation` owns the rules."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evopolicy_common.messages import gateway, operator
from evopolicy_common.wire.refusals import Refusal

from . import events
from .isolation import ASK_AGAIN_S, EVERYWHERE, poll_target
from .polls import Poll
from .records import PermitRow
from .runs import Run, over
from .turn import Turn

if TYPE_CHECKING:
    from .machine import Core


def requested(core: Core, event: events.Asked[gateway.RequestPermit], turn: Turn) -> None:
    """A gateway asks that its agent may be alive on a kernel."""
    message = event.message
    run = core.runs.get(message.run)
    if run is None or run.state.phase != "open":
        turn.refuse(event.request, *over(core, message.run))
        return
    isolation = core.isolation
    isolation.booted(message.machine_id, message.boot_id, turn)
    kernel = isolation.place(run, message.boot_id)
    if kernel is None:
        turn.reply(event.request, gateway.Permit(granted=True))
        return
    same = kernel == message.boot_id
    row = PermitRow(
        run=run.id,
        boot_id=kernel,
        machine_id=message.machine_id if same else "",
        host=message.host if same else "",
    )
    waits_for = isolation.ask(run, row, turn)
    if not waits_for:
        turn.reply(event.request, gateway.Permit(granted=True))
        return
    core.timers.arm(("ask", (run.id, kernel)), turn.now + max(0.0, message.wait_s) + ASK_AGAIN_S)
    poll = Poll(event.request, "permit", poll_target(run.id, kernel))
    if not core.polls.wait(poll, message.wait_s, turn.now):
        turn.reply(event.request, gateway.Permit(granted=False, waits_for=waits_for))


def answer(core: Core, poll: Poll, turn: Turn) -> None:
    """A gateway has waited for a permit in vain."""
    _, run, boot_id = poll.target.split(" ", 2)
    family = core.runs[run].family
    waits_for = core.isolation.permit_bar(family, core.isolation.kernel(boot_id))
    turn.reply(poll.request, gateway.Permit(granted=False, waits_for=waits_for))


def agent_gone(core: Core, event: events.Asked[operator.AgentGone], turn: Turn) -> None:
    """An operator vouches that a run's agent is not alive any more."""
    message = event.message
    if message.run not in core.capabilities:
        turn.refuse(event.request, Refusal.UNKNOWN_RUN, f"there is no run {message.run!r}")
        return
    core.isolation.end(message.run, turn, "by an operator's word")
    turn.reply(event.request, operator.Done())


def resume(core: Core, run: Run, turn: Turn) -> None:
    """An unfinished run, in a core that was just loaded."""
    before = run.state.isolation
    if before == "unknown":
        if run.state.phase == "open" and not core.isolation.held(run.id):
            # Played so far by a gateway that asked for no permit.
            kernel = core.isolation.place(run, EVERYWHERE)
            if kernel is not None:
                row = PermitRow(run=run.id, boot_id=kernel, granted_at=turn.now)
                core.isolation.restore(row, run.family)
                turn.persist(row)
    elif before != "shared" and not core.isolation.on:
        run.change(turn, isolation="shared")
