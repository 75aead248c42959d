"""Evaluations on a cluster for the commands on finished runs: requests, outcomes with progress, and the workers'
versions."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable

from evopolicy_common.errors import BrokenEnvironmentError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.operator import DescribeEnvironment, EnvironmentState, Evaluate, Rescore
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.wire.operator_client import DESCRIPTION_S, OperatorClient
from evopolicy_common.wire.transport import Link

Tell = Callable[[int, str], None]
"""Called with the number of finished episodes and what the cluster waits for (empty: nothing)."""
_WORKER_PAUSE_S = 0.3


class Evaluations:
    """Evaluations on one cluster, one at a time."""

    def __init__(self, link: Link, tell: Tell, *, own: bool = False) -> None:
        """`own`: the command started this cluster. An environment that fails on its workers then raises
        BrokenEnvironmentError instead of being waited for."""
        self.ask = OperatorClient(link, own=own)
        self._tell = tell
        self.played = 0
        """Episodes that ended so far."""

    async def outcomes(self, message: Evaluate | Rescore) -> AsyncIterator[EpisodeOutcome]:
        """Yields outcomes as they arrive. Close it to cancel the evaluation."""
        async with contextlib.aclosing(self.ask.evaluate(message)) as outcomes:
            async for outcome, _, waits_for in outcomes:
                self.played += outcome is not None
                self._tell(self.played, waits_for)
                if outcome is not None:
                    yield outcome

    async def recording(self, outcome: EpisodeOutcome) -> Trajectory:
        assert outcome.trajectory is not None
        return decode(await self.ask.fetch(outcome.trajectory))

    async def uploaded(self, actions: bytes) -> BlobRef:
        """The reference of uploaded actions, for `Evaluate.replays`."""
        await self.ask.upload(digest_of(actions), actions)
        return BlobRef(digest=digest_of(actions), size=len(actions))

    async def versions(self, message: DescribeEnvironment, *, wait: bool) -> EnvironmentState:
        """The environment's state, with the versions of the workers that offer it.

        With `wait` until there is a worker, as the first may still be starting, but not for a run that the coordinator
        does not know.
        """
        until = time.monotonic() + DESCRIPTION_S
        while True:
            state = await self.ask.describe(message)
            unknown = message.run and not state.knows_run
            if state.fingerprints or unknown or not wait or time.monotonic() > until:
                return state
            if self.ask.own:
                *_, failed = await self.ask.environments()
                if message.env in failed:
                    raise BrokenEnvironmentError("; ".join(failed[message.env].values()))
            await asyncio.sleep(_WORKER_PAUSE_S)
