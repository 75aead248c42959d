"""The replay client of the commands on finished runs: requests, outcomes with progress, workers' versions."""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import NamedTuple

import msgspec

from evopolicy_common.errors import BrokenEnvironmentError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import RANDOM, BlobRef, EpisodeOutcome, Record, ResourceLimits, Tier
from evopolicy_common.messages.operator import (
    DescribeEnvironment,
    EnvironmentState,
    Evaluate,
    PlayedAs,
    Rescore,
)
from evopolicy_common.messages.run_settings import AllConditions
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.wire.operator_client import DESCRIPTION_S, OperatorClient
from evopolicy_common.wire.transport import Link

Tell = Callable[[int, str], None]
"""Called with the number of finished episodes and the reason why the cluster waits (empty: none)."""
_WORKER_PAUSE_S = 0.3


class Cases(msgspec.Struct, frozen=True, kw_only=True):
    """A list of cases that one policy played: a submit's, or a checkpoint's hidden ones."""

    split: Split
    submit_index: int
    """`RANDOM` for the random reference."""
    env_instances: tuple[int, ...]
    """Ids in the split, in order."""
    modulo: int
    """Number of episodes of the policy's own submit."""
    remaining_budget_after: int


class Origin(NamedTuple):
    """The run that played a list."""

    env: str
    conditions: AllConditions
    run: str = ""
    """The coordinator's id, for the policies' random seeds."""
    tier: Tier = "bwrap"
    limits: ResourceLimits | None = None


class Evaluations:
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

    async def replayed(
        self,
        cases: Cases,
        indexes: Sequence[int],
        origin: Origin,
        *,
        actions: Sequence[bytes] = (),
        bundle: Bundle | None = None,
        record: Record = "actions",
    ) -> AsyncIterator[tuple[int, EpisodeOutcome | None]]:
        """Plays some of a list's episodes again, by recorded `actions` (trajectories, one for each index) or
        with the policy of `bundle`. Yields each index with its outcome as it arrives, then those without
        one."""
        for data in actions:
            await self.ask.upload(digest_of(data), data)
        if bundle is not None:
            await self.ask.upload(bundle.digest, bundle.packed)
        how = origin.conditions.conditions
        if cases.submit_index == RANDOM:  # no policy could receive lists: recorded as arrays
            how = msgspec.structs.replace(how, observations="arrays")
        message = Evaluate(
            key=uuid.uuid4().hex,
            env=origin.env,
            bundle=None if bundle is None else bundle.digest,
            split=cases.split,
            cases=tuple(cases.env_instances[index] for index in indexes),
            record=record,
            sandbox_tier=origin.tier,
            limits=origin.limits or ResourceLimits(),
            replays=tuple(BlobRef(digest=digest_of(data), size=len(data)) for data in actions),
            step_limit=origin.conditions.step_limit,
            as_in=PlayedAs(
                run=origin.run,
                submit_index=cases.submit_index,
                env_instances=cases.env_instances,
                indexes=tuple(indexes),
                modulo=cases.modulo,
                remaining_budget_after=cases.remaining_budget_after,
                conditions=how,
            ),
        )
        missing = dict(enumerate(indexes))
        async for outcome in self.outcomes(message):
            yield missing.pop(outcome.index), outcome
        for index in missing.values():
            yield index, None

    async def recording(self, outcome: EpisodeOutcome) -> Trajectory:
        assert outcome.trajectory is not None
        return decode(await self.ask.fetch(outcome.trajectory))

    async def versions(self, message: DescribeEnvironment) -> EnvironmentState:
        """The environment's state, with the versions of the workers that offer it.

        On an own cluster it waits for the first worker, but not for a run that the coordinator does not know.
        """
        until = time.monotonic() + DESCRIPTION_S
        while True:
            state = await self.ask.describe(message)
            unknown = message.run and not state.knows_run
            if state.fingerprints or unknown or not self.ask.own or time.monotonic() > until:
                return state
            *_, failed = await self.ask.environments()
            if message.env in failed:
                raise BrokenEnvironmentError("; ".join(failed[message.env].values()))
            await asyncio.sleep(_WORKER_PAUSE_S)


def unlike(then: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """The versions of two fingerprints that differ, as `numpy 1.0 in the run, 2.0 here`."""
    return [
        f"{name} {then.get(name, 'none')} in the run, {here.get(name, 'none')} here"
        for name in sorted(then.keys() | here.keys())
        if then.get(name) != here.get(name)
    ]


def sample(sizes: Sequence[int], n: int) -> list[tuple[int, tuple[int, ...]]]:
    """Draws `n` episodes from lists of these sizes without replacement (all if there are fewer): the number
    of each list that has some, and their indexes in it."""
    everything = [(k, index) for k, size in enumerate(sizes) for index in range(size)]
    chosen: dict[int, list[int]] = {}
    for k, index in sorted(random.SystemRandom().sample(everything, min(n, len(everything)))):
        chosen.setdefault(k, []).append(index)
    return [(k, tuple(indexes)) for k, indexes in chosen.items()]
