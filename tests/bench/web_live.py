"""What the live view costs a real coordinator: its process's CPU time without a view, with one, and with two.

A coordinator process on a state folder of its own lists 2,000 workers and 500 open runs. They registered once over
Zenoh and are silent since, so that all further work is the view's. Each view is a process of `evopolicy web` whose
pages 100 browsers follow.

    PYTHONPATH=tests/support python tests/bench/web_live.py [--workers 2000] [--runs 500] [--browsers 100] [--seconds
    60]
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from urllib.parse import urlsplit

import frame
from coordinator_harness import Coordinator, InstantWorker, operator_of

from evopolicy_common.wire.transport import connect

AT_ONCE = 50
CORE_SHARE = 0.02


async def filled(coordinator: Coordinator, workers: int, runs: int) -> None:
    """Registers workers and creates runs."""
    async with connect(coordinator.credentials("worker")) as link, operator_of(coordinator) as operator:
        work = [InstantWorker(link, f"w-{n}", slots=2).register for n in range(workers)]
        for at in range(0, workers, AT_ONCE):
            await asyncio.gather(*(register() for register in work[at : at + AT_ONCE]))
        for n in range(runs):
            await operator.create(f"run-{n}", exp_id=f"run-{n}", n_validation=1, n_heldout=1)
        # A worker that is silent for a time to live is lost, and listed for an hour.
        while any(each.state != "lost" for each in (await operator.status()).workers):
            await asyncio.sleep(2.0)


async def share(pid: int, seconds: float) -> float:
    """Share of one core that a process uses now."""
    before = frame.cpu_s(pid)
    await asyncio.sleep(seconds)
    return (frame.cpu_s(pid) - before) / seconds


async def browser(port: int, token: str, page: str, seen: list[int]) -> None:
    """Follows a page's updates, and counts them in `seen`."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=16 << 20)
    head = f"GET /events/{page} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nAuthorization: Bearer {token}\r\n\r\n"
    writer.write(head.encode())
    with contextlib.closing(writer):
        while line := await reader.readline():
            seen[0] += line.startswith(b"event: update")


@contextlib.asynccontextmanager
async def viewed(coordinator: Coordinator, folder: Path, n: int) -> AsyncIterator[list[int]]:
    """A view with `n` browsers; yields the number of updates that they have got so far."""
    seen = [0]
    address, tokens = folder / "address", folder / "tokens"
    folder.mkdir()
    program = [sys.executable, "-m", "evopolicy_gateway.cli", "web", str(folder), "--http", "127.0.0.1:0"]
    program += ["--credentials", str(coordinator.ready["credentials"]["operator"])]
    view = subprocess.Popen(
        [*program, "--url-file", str(address), "--token-file", str(tokens)], stdout=subprocess.DEVNULL
    )
    browsers: list[asyncio.Task[None]] = []
    try:
        while not address.exists():
            await asyncio.sleep(0.1)
        port, token = urlsplit(address.read_text()).port or 0, json.loads(tokens.read_text())["read"]
        browsers = [
            asyncio.create_task(browser(port, token, "cluster" if number % 2 else "runs", seen))
            for number in range(n)
        ]
        yield seen
    finally:
        for each in browsers:
            each.cancel()
        await asyncio.gather(*browsers, return_exceptions=True)
        view.terminate()
        view.wait()


async def measure(options: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory() as folder:
        coordinator = Coordinator(Path(folder) / "s")
        pid = coordinator.process.pid
        try:
            await filled(coordinator, options.workers, options.runs)
            without = await share(pid, options.seconds)
            print(
                f"{options.workers:,} workers, {options.runs} runs, no view: {100 * without:.2f} % of one core"
            )
            async with viewed(coordinator, Path(folder) / "one", options.browsers) as seen:
                await asyncio.sleep(10.0)
                before = seen[0]
                one = await share(pid, options.seconds) - without
                rate = (seen[0] - before) / options.seconds / options.browsers
                print(
                    f"one view, {options.browsers} browsers with {rate:.2f} updates a second each: {100 * one:.2f} %"
                    " more"
                )
                async with viewed(coordinator, Path(folder) / "two", options.browsers):
                    await asyncio.sleep(10.0)
                    two = await share(pid, options.seconds) - without
                    print(f"two views, {2 * options.browsers} browsers: {100 * two:.2f} % more")
        finally:
            coordinator.stop()
    print(f"wanted: under {100 * CORE_SHARE:g} %")
    return int(max(one, two) > CORE_SHARE)


def main() -> int:
    options = frame.options(
        __doc__,
        workers=(2000, "of the cluster"),
        runs=(500, "open runs"),
        browsers=(100, "of each view"),
        seconds=(60.0, "of each measurement"),
    )
    return asyncio.run(measure(options))


if __name__ == "__main__":
    sys.exit(main())
