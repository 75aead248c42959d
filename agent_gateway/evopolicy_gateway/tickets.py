"""One submit as those who wait for it see it."""

from __future__ import annotations

import asyncio

import msgspec

from evopolicy_common.errors import RequestError
from evopolicy_gateway.formatting import submit_id
from evopolicy_gateway.journal import Accepted, Requested
from evopolicy_gateway.snapshots import Snapshot


class ConflictError(RequestError):
    """The request contradicts one that was taken before: another submit runs, or the key has another body."""

    def __init__(self, index: int, message: str) -> None:
        super().__init__("conflict", message)
        self.index = index
        """Of the submit that it contradicts."""


class Ticket:
    """A submit that passed the checks."""

    def __init__(self, request: Requested, index: int, episode_budget: int) -> None:
        """`index` is the number it will have: this gateway is the only one that submits for its run."""
        self.request = request
        self.index = index
        self.submit_id = submit_id(index, episode_budget)
        """Its folder's name."""
        self.n_done = 0
        """Episodes whose feedback is written."""
        self.waits_for = ""
        self.accepted: Accepted | None = None
        self.decided = asyncio.Event()
        """Set once it is accepted, or never will be."""
        self.done = asyncio.Event()
        """Set once `status` and `summary`, or `error`, are there."""
        self.status: str | None = None
        self.summary: bytes | None = None
        """The bytes of `summary.json`."""
        self.error: RequestError | None = None
        """Why it was not taken after all."""
        self._episode_budget = episode_budget

    def attach(self, taken: Snapshot) -> None:
        """The bundle, or why there is none."""
        self.request = msgspec.structs.replace(self.request, bundle=taken.digest, bundle_error=taken.error)

    def accept(self, accepted: Accepted) -> None:
        """The coordinator has taken it: from now on it has its name."""
        self.accepted = accepted
        self.index = accepted.submit_index
        self.submit_id = submit_id(accepted.submit_index, self._episode_budget)
        self.decided.set()

    def settle(self, status: str, summary: bytes) -> None:
        """It is answered: its feedback is written."""
        self.status, self.summary = status, summary
        self.n_done = len(self.request.env_instances)
        self.waits_for = ""
        self.decided.set()
        self.done.set()

    def fail(self, error: RequestError) -> None:
        """It came to nothing."""
        self.error = error
        self.decided.set()
        self.done.set()
