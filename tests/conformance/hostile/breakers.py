"""The corpus's breakers: policies that misbehave at step 3 of an episode or before its first, and their verdicts
(`breakers.toml`).

Three ways in which one is seen to succeed undefended: under a higher limit, in a process that is not sealed, or in the
environment's own process (`undefended.py`).

Attacks, each with its defence:
- returns an array of zero bytes that becomes four billion lists, or large actions in every step, to overload
  the gateway: both sides bound the axes, numbers, and empty lists of an action, and an episode's total beyond
  the action space.
"""

from __future__ import annotations

import platform
import tomllib
from pathlib import Path
from textwrap import indent
from typing import Any

import msgspec
from slots import QUICK, misbehaving

from evopolicy_common.messages.episode import ResourceLimits

PATIENT = msgspec.structs.replace(QUICK, act_wall_s=50.0, init_wall_s=50.0, episode_wall_s=100.0, cpu_s=100.0)
"""Where the verdict is none of time, a busy machine shall not make it one."""


class Breaker(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Code that misbehaves, and its verdict."""

    name: str
    act: str = "pass"
    reset: str = "pass"
    init: str = "pass"
    verdict: str | None = None
    """The failure's category; None when the episode goes on unharmed."""
    limits: ResourceLimits = PATIENT
    off: ResourceLimits | None = None
    """Limits under which the same code succeeds; None when the defence is not a limit."""
    unsealed: bool = False
    """Whether it succeeds when the policy's process is not sealed (its numbers are bounded, so the machine is safe)."""
    packages: tuple[str, ...] = ()
    """Packages besides numpy that it imports."""
    machine: str = ""
    """The only processors that have the calls that it makes; empty: all."""
    needs: str = "/proc"
    """A path that the kernel shows where it has these calls."""
    harmless_anywhere: bool = False
    """Whether there is nothing to defend against, as the corpus is to show."""

    @property
    def in_process(self) -> bool:
        """Whether it is seen to succeed in the environment's own process."""
        return self.off is None and not self.unsealed and not self.harmless_anywhere

    @property
    def possible(self) -> bool:
        """Whether this machine's kernel has the calls that it makes, so that it can be seen to succeed."""
        return Path(self.needs).exists()

    @property
    def source(self) -> str:
        codes = {"init": self.init, "reset": self.reset, "act": self.act}
        return misbehaving(**{place: indent(code, " " * 12).strip() for place, code in codes.items()})


def _breaker(row: dict[str, Any]) -> Breaker:
    changed = {
        name: msgspec.structs.replace(PATIENT, **row.pop(name)) for name in ("limits", "off") if name in row
    }
    return msgspec.structs.replace(msgspec.convert(row, Breaker), **changed)


_ROWS = tomllib.loads((Path(__file__).parent / "breakers.toml").read_text())["breaker"]
BREAKERS = tuple(each for each in map(_breaker, _ROWS) if each.machine in ("", platform.machine()))
