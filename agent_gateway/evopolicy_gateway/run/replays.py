"""`replays/heldout_NNN/video.mp4`: videos of the selected checkpoint's held-out episodes, recorded by workers.

- The run's option `replays` (off, first, all), or else `video`, selects the episodes.
- NNN is the position in the split, from 0; the case's seed appears nowhere.
- Recordings are optional: one that a worker could not make, or that the cluster no longer has, is left out, and nothing
  else of the run depends on it.
- Videos that are already in place are not fetched again.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.records.blobs import digest_of, write_atomically
from evopolicy_common.records.run_record import Replay
from evopolicy_gateway.run.operations import Operations


async def fetch(root: Path, finished: RunFinished, operations: Operations) -> tuple[Replay, ...]:
    """Writes the recordings below the run directory `root`; returns one `Replay` each, in the split's order."""
    index = finished.best_submit_index
    if finished.settings.recorded_heldout == "off" or index is None:
        return ()
    recordings: list[Replay] = []
    async for outcome in operations.recorded(finished.run, "heldout", index):
        if outcome.video is None:
            continue
        path = f"replays/heldout_{outcome.index:03d}/video.mp4"
        target = root / path
        data = await asyncio.to_thread(target.read_bytes) if target.is_file() else b""
        if digest_of(data) != outcome.video.digest:
            try:
                data = await operations.fetch(outcome.video)
            except RefusedError:
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            await asyncio.to_thread(write_atomically, target, data)
        known: dict[str, Any] = {"episode_return": outcome.episode_return, "length": outcome.length}
        recordings.append(
            Replay(path=path, split="heldout", episode=outcome.index, submit_index=index, **known)
        )
    return tuple(sorted(recordings, key=lambda replay: replay.episode))
