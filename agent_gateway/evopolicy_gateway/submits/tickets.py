"""One submit as those who wait for it see it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import msgspec

from evopolicy_common.errors import RequestError
from evopolicy_gateway.submits.journal import Accepted, Requested
from evopolicy_gateway.submits.names import submit_id
from evopolicy_gateway.submits.snapshots import Snapshot


class ConflictError(RequestError):
    """The request contradicts one that was taken before: another submit runs, or the key has another body."""

    def __init__(self, index: int, message: str) -> None:
        super().__init__("conflict", message)
        self.index = index
        """Of the submit that it contradicts."""


class _Told(msgspec.Struct):
    """What is kept of a summary."""

    mean_return: float | str | None
    policy_failures: int | None = None
    warning: str | None = None


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
        self.held_s = 0.0
        """Seconds for which none of its episodes ran because hidden episodes had the machines."""
        self.accepted: Accepted | None = None
        self.decided = asyncio.Event()
        """Set once it is accepted, or never will be."""
        self.done = asyncio.Event()
        """Set once `status` and the summary, or `error`, are there."""
        self.status: str | None = None
        self.mean: float | None = None
        """Of its returns, once it is settled and has some."""
        self.policy_failures: int | None = None
        """Episodes in which the policy failed; None unless it is ok."""
        self.warning: str | None = None
        """How it failed, for the agent."""
        self.error: RequestError | None = None
        """Why it was not taken after all."""
        self.n_episodes = len(request.env_instances)
        self._episode_budget = episode_budget
        self._load: Callable[[], bytes] | None = None

    def attach(self, taken: Snapshot) -> None:
        """The bundle, or why there is none."""
        self.request = msgspec.structs.replace(
            self.request, bundle=taken.digest, bundle_error=taken.error, kept=taken.kept
        )

    def accept(self, accepted: Accepted) -> None:
        """The coordinator has taken it: from now on it has its name."""
        self.accepted = accepted
        self.index = accepted.submit_index
        self.submit_id = submit_id(accepted.submit_index, self._episode_budget)
        self.decided.set()

    def settle(self, status: str, summary: bytes, load: Callable[[], bytes]) -> None:
        """It is answered: its feedback is written. `load` gives the summary's bytes again.

        What it has of its single episodes is let go of: a run has thousands.
        """
        self.status, self._load = status, load
        told = msgspec.json.decode(summary, type=_Told)
        self.policy_failures, self.warning = told.policy_failures, told.warning
        mean = told.mean_return
        self.mean = mean if isinstance(mean, float | int) and math.isfinite(mean) else None
        self.request = msgspec.structs.replace(self.request, env_instances=())
        self.n_done = self.n_episodes
        self.waits_for = ""
        self.decided.set()
        self.done.set()

    def summary(self) -> bytes | None:
        """The bytes of `summary.json`, read from the disk; None while there is none."""
        return None if self._load is None else self._load()

    def fail(self, error: RequestError) -> None:
        """It came to nothing."""
        self.error = error
        self.decided.set()
        self.done.set()
