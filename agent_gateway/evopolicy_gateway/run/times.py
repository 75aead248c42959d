"""How long a run's train side has taken, over every command that has played it: on disk while the run is open.

The agent's wall limit and `run.json`'s phases are of the whole run, so a run that was interrupted ten times has no more time
than one that was not.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, StorageError
from evopolicy_gateway.run.layout import save


class Times(msgspec.Struct, frozen=True, kw_only=True):
    """Seconds so far."""

    agent_s: float = 0.0
    """Of the agent's wall limit: its clock stands still while its provider is away."""
    open_s: float = 0.0
    """The agent's side was open."""
    in_flight_s: float = 0.0
    """A submit was in flight."""
    feedback_s: float = 0.0
    """From the last episode's result to the submit's answer."""
    held_s: float = 0.0
    """Submits waited because hidden episodes had the machines; not in `agent_s`."""
    permit_s: float = 0.0
    """The agent's start waited for hidden episodes that its machine played; in no other figure."""


class Stopwatch:
    """Adds up what the processes of a run tell, each of which begins at nought."""

    def __init__(self, path: Path, now: Callable[[], float] = time.monotonic) -> None:
        """`path`: where earlier commands have left theirs, if there were any."""
        self._path = path
        self._now = now
        self._base = _load(path)
        self._agent_s = self._in_flight_s = self._feedback_s = 0.0
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
        )

    def opened(self) -> None:
        """The agent's side is open from now on."""
        self._opened = self._now()

    def closed(self) -> None:
        """It no longer is."""
        self._base, self._opened = self.times, None
        self._agent_s = self._in_flight_s = self._feedback_s = 0.0
        self.keep()

    def agent_begins(self) -> None:
        """An agent supervisor is started: its agent's clock begins anew."""
        self._base = msgspec.structs.replace(self._base, agent_s=self.times.agent_s)
        self._agent_s = 0.0

    def agent_told(self, seconds: float) -> None:
        """How far the clock of the agent that runs now is."""
        self._agent_s = seconds
        self.keep()

    def gateway_begins(self) -> None:
        """A gateway is started: its counts begin anew."""
        now = self.times
        self._base = msgspec.structs.replace(
            self._base, in_flight_s=now.in_flight_s, feedback_s=now.feedback_s
        )
        self._in_flight_s = self._feedback_s = 0.0

    def gateway_told(self, in_flight_s: float, feedback_s: float) -> None:
        """The counts of the gateway that runs now."""
        self._in_flight_s, self._feedback_s = in_flight_s, feedback_s

    def held_told(self, seconds: float) -> float:
        """The run's `held_s` so far, as the coordinator counts it; returns it, which never falls."""
        self._base = msgspec.structs.replace(self._base, held_s=max(self._base.held_s, seconds))
        return self._base.held_s

    def permit_told(self, seconds: float) -> None:
        """A permit was waited for, so long."""
        self._base = msgspec.structs.replace(self._base, permit_s=self._base.permit_s + seconds)

    def keep(self) -> None:
        """Writes it down; what the disk refuses is told by something that matters more."""
        try:
            save(self._path, self.times)
        except (StorageError, OSError):
            return


def _load(path: Path) -> Times:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Times)
    except (OSError, *DECODE_ERRORS):
        return Times()
