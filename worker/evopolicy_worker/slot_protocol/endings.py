"""How a slot's processes can end, and who is responsible: a table, without I/O.

Rule: an ending that a policy's process can cause by itself is the policy's result. An ending that it provably cannot
cause is an infrastructure failure, and the episode is played again. The proof is the seal (`sandbox.seccomp`): it
refuses a policy all signals to others, and SIGKILL and stop signals to itself. So a SIGKILL that no limit explains came
from outside.
"""

from __future__ import annotations

import os
import signal
from typing import Literal, NamedTuple

from evopolicy_common.errors import SandboxError
from evopolicy_common.messages.episode import FailureCategory, PolicyFailure

First = Literal["policy", "sandbox", "environment", "supervisor"]
"""Which process ended first. `sandbox`: bubblewrap or the zygote, whose end also ends the policy's process.
`supervisor`: the worker."""
How = Literal["exit", "fault", "signal", "SIGKILL", "stop", "pipe", "frame", "overrun"]
"""`exit`: with a status. `fault`: by a signal that a process's own error causes (`FAULTS`). `signal`: by any other
signal but SIGKILL. `stop`: stopped and not resumed. `pipe`: it closed its pipe but is alive. `frame`: it sent an
invalid frame. `overrun`, of the environment: a call took too long, or its memory was too large, and it was ended."""

AGAIN = 3
"""If an environment has ended so many attempts at a job, and overruns once more after a policy's actions, the actions
are the cause."""

FAULTS = frozenset(
    {
        *(signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE, signal.SIGABRT),
        *(signal.SIGSYS, signal.SIGTRAP),
    }
)


class EndedFromOutsideError(SandboxError):
    """A process of the slot was ended or stopped, and the policy cannot have caused it."""


class Ending(NamedTuple):
    first: First
    how: How
    limit: FailureCategory | None = None
    """Category of the limit that explains it; None when none does."""
    began: bool = True
    """For the policy: whether any code of its bundle had run. For the environment: whether an action of the policy had
    reached it in this episode."""
    held: bool = True
    """Whether the policy's process cannot have killed or stopped itself: it is sealed, and has no CPU limit of the
    system."""
    again: bool = False
    """For the environment: whether it overran on the policy's actions, and has ended `AGAIN` earlier attempts at the
    job."""


class EndingRule(NamedTuple):
    """A kind of ending and its verdict. None in a condition matches anything."""

    name: str
    first: First
    how: tuple[How, ...] | None
    verdict: FailureCategory | Literal["limit", "outside"]
    """The policy's failure; `limit`: the category of that limit. `outside`: an infrastructure failure, to be played
    again."""
    limit: bool | None = None
    began: bool | None = None
    held: bool | None = None
    again: bool | None = None

    def fits(self, ending: Ending) -> bool:
        wanted = (self.first, self.limit, self.began, self.held, self.again)
        facts = (ending.first, ending.limit is not None, ending.began, ending.held, ending.again)
        known = all(want in (None, fact) for want, fact in zip(wanted, facts, strict=True))
        return known and (self.how is None or ending.how in self.how)


_KILLED: tuple[How, ...] = ("SIGKILL", "stop")
_CRASH: tuple[How, ...] = ("exit", "fault")
_FROM_OUTSIDE: tuple[How, ...] = (*_KILLED, "signal", "pipe", "frame")
_SEALED = "killed or stopped, sealed, and no limit explains it"
_OPEN = "killed or stopped where it can signal itself"
_OVERRAN_AGAIN = "the environment overran on its actions, as in earlier attempts"
TABLE: tuple[EndingRule, ...] = (
    EndingRule("a policy's process before the bundle's code", "policy", None, "outside", began=False),
    EndingRule("a limit was passed", "policy", None, "limit", limit=True, began=True),
    EndingRule("it exited", "policy", ("exit",), "killed", limit=False, began=True),
    EndingRule("it crashed", "policy", ("fault",), "killed", limit=False, began=True),
    EndingRule("a signal that it can send itself", "policy", ("signal",), "killed", limit=False, began=True),
    EndingRule("it closed its pipe", "policy", ("pipe",), "killed", limit=False, began=True),
    EndingRule("it broke the pipes' rules", "policy", ("frame",), "killed", limit=False, began=True),
    EndingRule(_OPEN, "policy", _KILLED, "killed", limit=False, began=True, held=False),
    EndingRule(_SEALED, "policy", _KILLED, "outside", limit=False, began=True, held=True),
    EndingRule("bubblewrap or the zygote", "sandbox", None, "outside"),
    EndingRule("the environment crashed on its actions", "environment", _CRASH, "killed", began=True),
    EndingRule("the environment crashed before any", "environment", _CRASH, "outside", began=False),
    EndingRule(_OVERRAN_AGAIN, "environment", ("overrun",), "killed", again=True),
    EndingRule("the environment overran", "environment", ("overrun",), "outside", again=False),
    EndingRule("the environment was killed or stopped", "environment", _FROM_OUTSIDE, "outside"),
    EndingRule("the worker", "supervisor", None, "outside"),
)
"""Every ending fits exactly one row."""


BROKE_DOWN = PolicyFailure(
    category="killed",
    step_index=None,
    message=(
        "the environment broke down on the policy's actions; the episode was played again from its first step with"
        " random actions"
    ),
)
"""The policy's failure when the environment's process ends on its actions."""


def verdict(ending: Ending) -> FailureCategory | None:
    """The category of the policy's failure; None for an infrastructure failure, which is played again."""
    (row,) = [row for row in TABLE if row.fits(ending)]
    if row.verdict == "outside":
        return None
    return ending.limit if row.verdict == "limit" else row.verdict


def how(status: int) -> How:
    """How a process ended, from its waitpid status."""
    if not os.WIFSIGNALED(status):
        return "exit"
    number = os.WTERMSIG(status)
    return "SIGKILL" if number == signal.SIGKILL else "fault" if number in FAULTS else "signal"
