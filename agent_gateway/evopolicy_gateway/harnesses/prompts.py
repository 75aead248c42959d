"""Prompts for agents, by turn. The rules themselves are in the workspace's `AGENTS.md`."""

from __future__ import annotations

FIRST = (
    "Read AGENTS.md in the current directory. It says what to improve, how to submit and what is allowed."
    " Its rules are binding, above all the rule of the budget where it has one: no local environments, no other simulators,"
    " no copied dynamics or rewards; what you learn of the environment comes from submits."
    " Work until the episode budget is spent or, where AGENTS.md lets you stop earlier, you cannot improve the policy any further."
)


def go_on(left: int) -> str:
    """Prompt for an agent that stopped with budget left."""
    return (
        f"You stopped, and {left} episodes of the budget are left. Unspent episodes are lost, and every submit is one more"
        " candidate for selection. Go on improving the policy and submit again; the rules in AGENTS.md still hold."
    )


def warned(warning: str | None) -> str:
    """Addition to a prompt if the policy failed in the last submit."""
    return f" In your last submit {warning}" if warning else ""


def interrupted(left: int | None) -> str:
    """Prompt for an agent whose session resumes after a failure that was not its own."""
    remaining = (
        "Ask /info for the budget that is left."
        if left is None
        else f"{left} episodes of the budget are left."
    )
    return (
        "Your session was interrupted by a technical failure and goes on here. A submit that was under way was not lost:"
        f" look at feedback/ before you submit anything again. {remaining} Go on where you were."
    )
