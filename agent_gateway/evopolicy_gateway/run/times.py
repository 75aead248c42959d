"""How long a run's train side has taken, over all commands that have played it; on disk while the run is open.

The agent's wall limit and the phases in `run.json` cover the whole run, so interruptions give a run no extra time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

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


class Stopwatch:
    """Adds up the reports of a run's processes, each of which counts from zero."""

    def __init__(self, path: Path, now: Callable[[], float] = time.monotonic) -> None:
        """`path`: file with the times of earlier commands; may be missing."""
        self._path = path
        self._now = now
        self._base = _load(path)
        self._agent_s = self._in_flight_s = self._feedback_s = 0.0
        self._resources: AgentResources | None = None
        self._opened: float | None = None

    @property
    def times(self) -> Times:
        base = self._base
        return Times(
            agent_s=base.agent_s + self._agent_s,
            open_s=base.open_s + (0.0 if self._opened is None else self._now() - self._opened),
            in_flight_s=base.in_flight_s + self._in_flight_s,
            feedback_s=base.feedback_s + self._feedback_s,
            held_s=base.held_s,
            permit_s=base.permit_s,
            resources=self._resources.after(base.resources) if self._resources else base.resources,
        )

    def opened(self) -> None:
        """The agent's side is open from now on."""
        self._opened = self._now()

    def closed(self) -> None:
        """The agent's side is closed from now on."""
        self._base, self._opened = self.times, None
        self._agent_s = self._in_flight_s = self._feedback_s = 0.0
        self._resources = None
        self.keep()

    def agent_begins(self) -> None:
        """A new agent supervisor starts: its agent's clock counts from zero."""
        now = self.times
        self._base = msgspec.structs.replace(self._base, agent_s=now.agent_s, resources=now.resources)
        self._agent_s, self._resources = 0.0, None

    def agent_reported(self, seconds: float) -> None:
        """Sets the clock of the current agent, seconds."""
        self._agent_s = seconds
        self.keep()

    def agent_used(self, resources: AgentResources) -> None:
        """Sets what the current agent has used."""
        self._resources = resources
        self.keep()

    def gateway_begins(self) -> None:
        """A new gateway starts: its counts begin at zero."""
        now = self.times
        self._base = msgspec.structs.replace(
            self._base, in_flight_s=now.in_flight_s, feedback_s=now.feedback_s
        )
        self._in_flight_s = self._feedback_s = 0.0

    def gateway_reported(self, in_flight_s: float, feedback_s: float) -> None:
        """Sets the counts of the current gateway, seconds."""
        self._in_flight_s, self._feedback_s = in_flight_s, feedback_s

    def held_reported(self, seconds: float) -> float:
        """Sets the run's `held_s` as counted by the coordinator; returns the stored value, which never decreases."""
        self._base = msgspec.structs.replace(self._base, held_s=max(self._base.held_s, seconds))
        return self._base.held_s

    def permit_reported(self, seconds: float) -> None:
        """Adds time spent waiting for a permit, seconds."""
        self._base = msgspec.structs.replace(self._base, permit_s=self._base.permit_s + seconds)

    def keep(self) -> None:
        """Saves the times. Ignores a disk error, since other, more important writes report it."""
        try:
            save(self._path, self.times)
        except (StorageError, OSError):
            return


def _load(path: Path) -> Times:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Times)
    except (OSError, *DECODE_ERRORS):
        return Times()
