"""A coordinator for the fault tests: the real process, with short timings and the same keys for every run, so that runs
on it can be compared byte for byte (random actions and policies' generators are seeded from a run's key)."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path

import msgspec

from evopolicy_common.cli.conventions import setup_logging
from evopolicy_common.records.blobs import write_atomically
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.server import process, run_requests

SETTINGS = CoreSettings(
    lease_ttl_s=3.0,
    heartbeat_s=0.5,
    liveness_grace_s=1.0,
    adoption_s=1.5,
    retry_base_s=0.1,
    avoid_s=0.5,
)


async def serve(state: Path, ready_file: Path, listen: tuple[str, ...]) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)

    def on_ready(ready: process.ReadyCluster) -> None:
        write_atomically(ready_file, msgspec.json.encode(ready), mode=0o600)

    # Of coordinators on one database.
    store, key = os.environ.get("FAULTS_STORE"), os.environ.get("FAULTS_SEAL_KEY")
    options = process.CoordinatorOptions(
        state=state,
        listen=listen,
        insecure_tcp=True,
        core=SETTINGS,
        store=store,
        blobs=os.environ.get("FAULTS_BLOBS"),
        seal_key=None if key is None else Path(key),
    )
    await process.run(options, stop, on_ready)


if __name__ == "__main__":
    setup_logging("info")
    run_requests.run_secret = lambda state, key: b"fault" * 6  # type: ignore[attr-defined]
    asyncio.run(serve(Path(sys.argv[1]), Path(sys.argv[2]), tuple(sys.argv[3:])))
