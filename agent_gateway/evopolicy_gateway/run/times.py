"""How long a run's train side has taken, over all commands that have played it; on disk while the run is open.

The agent's wall limit and the phases in `run.json` cover the whole run, so interruptions give a run no extra time.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, StorageError
from evopolicy_common.records.run_record import AgentResources
from evopolicy_gateway.run_folder.layout import save


class Times(msgspec.Struct, frozen=True, kw_only=True):
    """Seconds so far."""

    agent_s: float = 0.0
    """Used of the agent's wall limit; the clock stops while the agent's provider is away."""
    open_s: float = 0.0
    """The agent's side was open."""
    in_flight_s: float = 0.0
    """A submit was in flight."""
    feedback_s: float = 0.0
    """From the last episode's result to the submit's answer."""
    held_s: float = 0.0
    """Submits waited because hidden episodes used the machines; not counted in `agent_s`."""
    permit_s: float = 0.0
    """The agent's start waited for hidden episodes on its machine; not counted in any other field."""
    resources: AgentResources | None = None
    """The agent's use of its machine."""

    def __add__(self, more: Times) -> Times:
        """With the seconds that another process has counted; waits are counted by the coordinator."""
        return msgspec.structs.replace(
            self,
            agent_s=self.agent_s + more.agent_s,
            open_s=self.open_s + more.open_s,
            in_flight_s=self.in_flight_s + more.in_flight_s,
            feedback_s=self.feedback_s + more.feedback_s,
            resources=more.resources.after(self.resources) if more.resources else self.resources,
        )


Process = Literal["agent", "gateway"]


class Stopwatch:
    """Adds up the reports of a run's processes."""

    def __init__(self, path: Path, now: Callable[[], float] = time.monotonic) -> None:
        """`path`: file with the times of earlier commands; may be missing."""
        self._path = path
        self._now = now
        self._base = Times()
        with contextlib.suppress(OSError, *DECODE_ERRORS):
            self._base = msgspec.json.decode(path.read_bytes(), type=Times)
        self._reported: dict[Process, Times] = {}
        """The reports of the present processes, which count from zero."""
        self._opened: float | None = None

    @property
    def times(self) -> Times:
        open_s = 0.0 if self._opened is None else self._now() - self._opened
        return sum(self._reported.values(), self._base + Times(open_s=open_s))

    def opened(self) -> None:
        self._opened = self._now()

    def closed(self) -> None:
        self._base, self._opened, self._reported = self.times, None, {}
        self.keep()

    def begins(self, process: Process) -> None:
        self._base += self._reported.pop(process, Times())

    def reported(self, process: Process, counts: Times) -> None:
        """Sets the counts of a present process; saves those of an agent."""
        self._reported[process] = counts
        if process == "agent":
            self.keep()

    def held_reported(self, held_s: float, permit_s: float = 0.0) -> float:
        """Sets `held_s`, which never decreases, and adds to `permit_s`; returns the stored `held_s`."""
        base = self._base
        held_s, permit_s = max(base.held_s, held_s), base.permit_s + permit_s
        self._base = msgspec.structs.replace(base, held_s=held_s, permit_s=permit_s)
        return held_s

    def keep(self) -> None:
        """Saves the times. Ignores a disk error, since other, more important writes report it."""
        with contextlib.suppress(StorageError, OSError):
            save(self._path, self.times)
