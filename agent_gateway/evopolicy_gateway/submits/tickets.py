"""The state of one submit, for everyone who waits for it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import msgspec

from evopolicy_common.errors import RequestError
from evopolicy_common.records.open_run import Accepted, Requested
from evopolicy_gateway.run_folder.names import submit_id
from evopolicy_gateway.submits.snapshots import Snapshot


class ConflictError(RequestError):
    """The request contradicts an earlier one: another submit runs, or the key belongs to another body."""

    def __init__(self, index: int, message: str) -> None:
        super().__init__("conflict", message)
        self.index = index
        """Index of the earlier submit."""


class _SummaryPart(msgspec.Struct):
    """The stored fields of a summary."""

    mean_return: float | str | None
    policy_failures: int | None = None
    warning: str | None = None


class Ticket:
    """A submit that passed the checks."""

    def __init__(self, request: Requested, index: int, episode_budget: int) -> None:
        """`index`: its future number, known because this gateway is the run's only submitter."""
        self.request = request
        self.index = index
        self.submit_id = submit_id(index, episode_budget)
        """Its folder's name."""
        self.n_done = 0
        """Episodes whose feedback is written."""
        self.waits_for = ""
        self.held_s = 0.0
        """Seconds in which none of its episodes ran because hidden episodes used the machines."""
        self.accepted: Accepted | None = None
        self.decided = asyncio.Event()
        """Set once it is accepted, or certainly will not be."""
        self.done = asyncio.Event()
        """Set once `status` and the summary, or `error`, are available."""
        self.status: str | None = None
        self.mean: float | None = None
        """Mean of its returns once it is settled; None without returns, or when the mean is not finite."""
        self.policy_failures: int | None = None
        """Episodes in which the policy failed; None unless it is ok."""
        self.warning: str | None = None
        """The warning to the agent about policy failures."""
        self.error: RequestError | None = None
        """The reason for its failure or refusal."""
        self.n_episodes = len(request.env_instances)
        self._episode_budget = episode_budget
        self._load: Callable[[], bytes] | None = None

    def attach(self, taken: Snapshot) -> None:
        """Stores the bundle's digest, or the reason for its absence."""
        self.request = msgspec.structs.replace(
            self.request, bundle=taken.digest, bundle_error=taken.error, kept=taken.kept
        )

    def accept(self, accepted: Accepted) -> None:
        """The coordinator has accepted it; from now on its name is fixed."""
        self.accepted = accepted
        self.index = accepted.submit_index
        self.submit_id = submit_id(accepted.submit_index, self._episode_budget)
        self.decided.set()

    def settle(self, status: str, summary: bytes, load: Callable[[], bytes]) -> None:
        """Its feedback is committed. `load` returns the summary's bytes again.

        Its list of episodes is dropped to save memory: a run has thousands.
        """
        self.status, self._load = status, load
        decoded = msgspec.json.decode(summary, type=_SummaryPart)
        self.policy_failures, self.warning = decoded.policy_failures, decoded.warning
        mean = decoded.mean_return
        self.mean = mean if isinstance(mean, float | int) and math.isfinite(mean) else None
        self.request = msgspec.structs.replace(self.request, env_instances=())
        self.n_done = self.n_episodes
        self.waits_for = ""
        self.decided.set()
        self.done.set()

    def summary(self) -> bytes | None:
        """The bytes of `summary.json`, read from the disk; None before it is settled."""
        return None if self._load is None else self._load()

    def fail(self, error: RequestError) -> None:
        """Ends it with an error."""
        self.error = error
        self.decided.set()
        self.done.set()
