"""Throughput of the coordinator: `python tests/bench/throughput.py [--json FILE]`. Prints a table, asserts nothing.

Rows, each with a coordinator process of its own on a state folder of its own, over Zenoh on a unix socket. `--stores
sqlite,postgresql,standby` plays each with its rows in SQLite, in a PostgreSQL server on this machine, and in two with
synchronous replication (`remote_apply`), of which all wait for the disk.
- `slots`: one real worker with two slots and sandboxes on `toy/line`; short episodes, train splits.
- `one by one`, `batches`: workers that answer at once, taking one lease at a time or sixteen. Every episode is
  committed for itself, durably, and read back by the gateway that submitted it.
And the time from a submit's acceptance to its first lease, seen by the clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import frame
import msgspec
from commands import worker_of
from coordinator_harness import (
    Coordinator,
    GatewayClient,
    InstantWorker,
    bundle_of,
    gateway_of,
    operator_of,
    play,
    working,
)

from evopolicy_common.messages.episode import EpisodeOutcome, EpisodeSpec, Job
from evopolicy_common.wire.transport import connect

PER_SUBMIT = 128
POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta): pass
    def reset(self, episode_index): pass
    def act(self, obs): return 1
"""
TARGETS = {
    "one by one": {"episodes_per_s": 500},
    "batches": {"episodes_per_s": 2000, "coordinator_us": 250},
    "latency": {"median_ms": 5, "p99_ms": 25},
}


def playing(wall_s: float) -> Callable[[Job, EpisodeSpec], EpisodeOutcome]:
    """`play` whose episodes claim to have taken so long: by that the coordinator decides how many it hands out at
    once."""
    return lambda job, spec: msgspec.structs.replace(play(job, spec), wall_s=wall_s)


async def evaluate(coordinator: Coordinator, n: int, source: str = "policy") -> dict[str, float]:
    """`n` train episodes in submits of `PER_SUBMIT`, one submit after another, after one to warm everything up."""
    submits = -(-n // PER_SUBMIT)
    async with operator_of(coordinator) as operator:
        budget = (submits + 1) * PER_SUBMIT
        created = await operator.create(
            budget=budget, max_episodes_per_submit=PER_SUBMIT, n_validation=1, n_heldout=1
        )
        async with gateway_of(coordinator, created) as gateway:
            await submit(gateway, source, 0)
            cpu = frame.cpu_s(coordinator.process.pid)
            started = time.monotonic()
            for number in range(1, submits + 1):
                await submit(gateway, source, number)
            wall_s = time.monotonic() - started
            cpu = frame.cpu_s(coordinator.process.pid) - cpu
    episodes = submits * PER_SUBMIT
    return {
        "episodes": episodes,
        "episodes_per_s": round(episodes / wall_s, 1),
        "coordinator_us": round(1e6 * cpu / episodes, 1),
    }


async def submit(gateway: GatewayClient, source: str, number: int) -> None:
    ids = tuple(index % 16 for index in range(PER_SUBMIT))
    await gateway.submit(bundle_of(source), ids, f"k{number}")
    episodes, done = await gateway.results(number)
    assert done.status == "ok"
    assert len(episodes) == PER_SUBMIT


async def slots_row(coordinator: Coordinator, n: int) -> dict[str, float]:
    with worker_of(coordinator, "--env", "toy/line"):
        return await evaluate(coordinator, n, POLICY)


async def instant_row(
    coordinator: Coordinator, n: int, workers: int, slots: int, wall_s: float
) -> dict[str, float]:
    async with contextlib.AsyncExitStack() as stack:
        instant = [
            await stack.enter_async_context(
                working(coordinator, f"w-{number}", slots=slots, play=playing(wall_s))
            )
            for number in range(workers)
        ]
        row = await evaluate(coordinator, n)
    jobs = sum(len(each.jobs) for each in instant)
    return {**row, "leases_a_batch": round(jobs / sum(each.batches for each in instant), 1)}


class Stopwatch(InstantWorker):
    """Notes when leases come."""

    async def lease(self, n: int, wait_s: float = 1.0) -> Any:
        leases = await super().lease(n, wait_s)
        self.times += [time.monotonic()] * len(leases)
        return leases

    times: list[float]


async def latency_row(coordinator: Coordinator, n: int) -> dict[str, float]:
    """Milliseconds from a submit's sending, and from its answer, to its first lease; one submit of one episode at a
    time. Sender and worker are one process here: a lease that arrives before the answer counts as 0."""
    sent_ms: list[float] = []
    taken: list[float] = []
    async with operator_of(coordinator) as operator, connect(coordinator.credentials("worker")) as link:
        created = await operator.create(budget=n + 1, n_validation=1, n_heldout=1)
        watch = Stopwatch(link, "w-0", slots=1)
        watch.times = []
        task = asyncio.create_task(watch.work())
        async with gateway_of(coordinator, created) as gateway:
            for number in range(n + 1):
                before = len(watch.times)
                sent = time.monotonic()
                await gateway.submit(bundle_of("policy"), (0,), f"k{number}")
                accepted = time.monotonic()
                await gateway.results(number)
                if number:
                    taken.append(1000 * max(0.0, watch.times[before] - accepted))
                    sent_ms.append(1000 * (watch.times[before] - sent))
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    taken.sort()
    sent_ms.sort()
    return {
        "submits": n,
        "from_sending_median_ms": round(statistics.median(sent_ms), 2),
        "from_sending_p99_ms": round(sent_ms[int(0.99 * (n - 1))], 2),
        "median_ms": round(statistics.median(taken), 2),
        "p99_ms": round(taken[int(0.99 * (n - 1))], 2),
    }


def on_fresh_coordinator(store: str, row: Any, *args: Any) -> dict[str, float]:
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="evopolicy-bench-"))
        chosen: tuple[str, ...] = ()
        if store != "sqlite":
            from machines.postgres import Server

            server = Server(durable=True)
            stack.callback(server.close)
            if store == "standby":
                stack.callback(Server(durable=True, follows=server).close)
            os.environ["PGPASSFILE"] = str(server.passfile)
            chosen = ("--store", server.new())
        coordinator = Coordinator(Path(folder) / "state", "--log-level", "warning", *chosen)
        stack.callback(coordinator.stop)
        return asyncio.run(row(coordinator, *args))


def verdict(name: str, row: dict[str, Any]) -> str:
    """Which of the row's targets are met, in words."""
    words = []
    for key, target in TARGETS.get(name, {}).items():
        met = row[key] >= target if key == "episodes_per_s" else row[key] <= target
        words.append(
            f"{key} {'≥' if key == 'episodes_per_s' else '≤'} {target}: {'met' if met else 'missed'}"
        )
    return "; ".join(words)


def main() -> None:
    options = frame.options(
        __doc__,
        episodes=(4096, "episodes in a row of workers that answer at once"),
        rows=("slots,one by one,batches,latency", "rows, comma separated"),
        stores=("sqlite", "where the rows are, comma separated: sqlite, postgresql, standby"),
        json=(Path, "also write all numbers to this file"),
    )
    makers: dict[str, tuple[Any, ...]] = {
        "slots": (slots_row, options.episodes // 8),
        "one by one": (instant_row, options.episodes, 8, 1, 2.0),
        "batches": (instant_row, 2 * options.episodes, 4, 16, 2.0),
        "latency": (latency_row, 200),
    }
    rows: dict[str, dict[str, Any]] = {}
    for store, name in itertools.product(options.stores.split(","), options.rows.split(",")):
        found = rows[name if store == "sqlite" else f"{name}, {store}"] = on_fresh_coordinator(
            store, *makers[name]
        )
        line = "  ".join(f"{key} {value}" for key, value in found.items())
        print(f"{store:<12}{name:<12}{line}  {verdict(name, found)}", flush=True)
    frame.save(options.json, rows)


if __name__ == "__main__":
    main()
