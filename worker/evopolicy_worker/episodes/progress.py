"""How far a slot's running job is, for the thread that hears of its cancellation."""

from __future__ import annotations

import threading
from collections.abc import Callable

from evopolicy_worker.episodes.policy_process import PolicyProcess
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slot_protocol.begun import Begun


class CancelledJobError(Exception):
    """The job was cancelled while it ran."""


class Progress:
    """How far the running job is; written by the loop, read by the monitor's thread."""

    def __init__(self) -> None:
        self.episodes_done = 0
        self.steps = 0
        self.cancelled = False
        self.policy: PolicyProcess | None = None
        self._begun: tuple[int, Begun] | None = None
        self._given_up = False
        self._lock = threading.Lock()

    def begins(self, place: int, begun: Begun) -> None:
        """Starts the job's episode at this index; `begun` is reported when the job is stopped."""
        self._begun = place, begun

    def give_up(self, send: Callable[[messages.Message], None] | None) -> None:
        """Reports the started episode, once; the report is sent when this returns. With None, nothing more is
        reported."""
        with self._lock:
            if self._given_up:
                return
            self._given_up = True
            if send is not None and self._begun is not None:
                place, begun = self._begun
                send(messages.Begun(place=place, begun=begun.packed()))

    def cancel(self) -> None:
        """Ends the running job at the next step, and the policy at once."""
        self.cancelled = True
        policy = self.policy
        if policy is not None:
            policy.kill()
