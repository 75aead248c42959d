"""A real worker process that cheats: `cheating_worker.py HOW OPTIONS…`, the options being the worker's own.

HOW: `honest`; `rewards` adds to every reward that it reports, returns and recordings in accord; `return` to the returns
alone; `old-code` reports another code version and another adapter; `old-protocol` speaks another wire version. All but
the last two tell the same fingerprint, whatever is edited meanwhile.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.rendered import ROWS, Renderer, decode
from evopolicy_common.records.episodes.trajectory import Recorder
from evopolicy_common.wire import codec
from evopolicy_worker import cli
from evopolicy_worker.environments.interface.fingerprint import fingerprint
from evopolicy_worker.slots.slot import Slot

BONUS = 3.0
"""What a forger adds to a reward."""


def forge_rewards(outcome: EpisodeOutcome) -> EpisodeOutcome:
    """The episode as if each step had paid more."""
    ref = outcome.trajectory
    assert ref is not None
    assert ref.inline is not None
    played = decode(ref.inline)
    rows = [json.loads(line) for line in played.files.get(ROWS, b"").splitlines()]
    recorder = (
        Renderer(played.observations, "inline") if rows else Recorder(played.record, played.observations)
    )
    total = 0.0
    for row in played.rows():
        reward = row.reward + BONUS
        obs, info = (rows[row.t]["obs"], rows[row.t]["info"]) if rows else (row.obs, row.info)
        recorder.append(obs, row.action, reward, row.terminated, row.truncated, info)
        total += reward
    data = recorder.finish()
    forged = BlobRef(digest=digest_of(data), size=len(data), inline=data)
    return msgspec.structs.replace(outcome, episode_return=total, trajectory=forged)


def forge_return(outcome: EpisodeOutcome) -> EpisodeOutcome:
    """The episode with a better return than its rewards add up to."""
    return msgspec.structs.replace(outcome, episode_return=math.nextafter(outcome.episode_return, math.inf))


FORGERIES: dict[str, Callable[[EpisodeOutcome], EpisodeOutcome]] = {
    "rewards": forge_rewards,
    "return": forge_return,
}


class CheatingSlot(Slot):
    """Plays, and reports something else."""

    async def play(
        self, job: Job, bundle: Path | None, on_progress: Callable[[int, int], None]
    ) -> tuple[EpisodeOutcome, ...]:
        forge = FORGERIES[HOW]
        return tuple(forge(outcome) for outcome in await super().play(job, bundle, on_progress))


class OldSlot(Slot):
    """Describes environments as an older adapter does."""

    async def describe(self, env_ids: Sequence[str]) -> tuple[EnvironmentDescription, ...]:
        described = await super().describe(env_ids)
        return tuple(msgspec.structs.replace(each, adapter="1.1+old") for each in described)


if __name__ == "__main__":
    HOW = sys.argv.pop(1)
    forged = msgspec.structs.replace(fingerprint(), code_version="old" if HOW == "old-code" else "cheats")
    cli.fingerprint = lambda: forged  # type: ignore[attr-defined]
    if HOW in FORGERIES:
        cli.Slot = CheatingSlot  # type: ignore[attr-defined]
    if HOW == "old-code":
        cli.Slot = OldSlot  # type: ignore[attr-defined]
    if HOW == "old-protocol":
        codec.WIRE_VERSION = 0
    cli.main()
