"""The live view at scale: what pages weigh, what browsers are sent, and what the coordinator spends on it.

The cluster's state is the real core's, under the simulated load of `tests/simulation/scale.py`: 2,000 workers that
poll, beat and hand in, 500 open runs. Its status is encoded as on the wire and decoded by the view. Browsers are the
view's own event streams, read in one process; a slow one is never read to its end.

    python tests/bench/web_bench.py [--workers 2000] [--runs 500] [--browsers 200] [--seconds 20]
"""

from __future__ import annotations

import argparse
import asyncio
import gzip
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "simulation"))
sys.path.insert(1, str(Path(__file__).parents[1] / "support"))

import frame
import msgspec
from invented.web_site import site_of, status
from scale import Load

from evopolicy_common.messages.status import StatusReply
from evopolicy_common.wire import codec
from evopolicy_coordinator.server.reason_texts import words as reason_words
from evopolicy_coordinator.web.content import cluster as polling
from evopolicy_coordinator.web.content import rendering
from evopolicy_coordinator.web.content.feeds import LEAST_PAUSE_S
from evopolicy_coordinator.web.content.rendering import Words

FIRST_PAGE_BYTES, FIRST_PAGE_S, CORE_SHARE = 100_000, 1.0, 0.02


class Cluster:
    """The real core under load, a few simulated seconds at a time."""

    def __init__(self, workers: int, runs: int) -> None:
        self.load = Load(workers, 10**9, memory=False)
        self.load._runs = runs
        self.load.start()
        self.status_s: list[float] = []

    def go_on(self, jobs: int) -> None:
        """Plays so many further jobs."""
        self.load.jobs = self.load.done + jobs
        self.load.run()

    def status(self) -> bytes:
        """What the coordinator does for one question: looks, and encodes."""
        began = time.process_time()
        data = codec.encode(self.load.core.status(self.load.now, reason_words))
        self.status_s.append(time.process_time() - began)
        return data


_replies = msgspec.msgpack.Decoder(StatusReply)


def decoded(data: bytes) -> StatusReply:
    """As the view reads it."""
    return codec.decode(_replies, data)


def page(site: object, name: str, template: str) -> tuple[str, float]:
    """A first page, and how long it took to make."""
    began = time.perf_counter()
    view = site.view_of(name, Words())()  # type: ignore[attr-defined]
    html = rendering.page(
        template, view=view, live=f"/events/{name}", cursor="x.1", words=Words(), title=name, here=name,
        has_cluster=True, has_report=False,
    )  # fmt: skip
    return html, time.perf_counter() - began


async def watch(options: argparse.Namespace) -> int:
    cluster = Cluster(options.workers, options.runs)
    cluster.go_on(4 * options.workers)
    with tempfile.TemporaryDirectory() as folder:
        site = site_of(Path(folder), cluster=status())
        assert site.cluster is not None
        site.cluster.take(decoded(cluster.status()))
        await site.refresh()
        failed = []
        for name, template in (("runs", "runs.html.j2"), ("cluster", "cluster.html.j2")):
            page(site, name, template)
            html, took = page(site, name, template)
            packed = len(gzip.compress(html.encode(), 6))
            print(
                f"first page {name:8s} {took * 1e3:6.0f} ms {len(html.encode()):8,} bytes {packed:8,} packed"
            )
            if took > FIRST_PAGE_S or packed > FIRST_PAGE_BYTES:
                failed.append(name)

        feeds = {
            name: site.feeds.of(name, make)
            for name in ("runs", "cluster")
            if (make := site.view_of(name, Words(), may_act=False))
        }
        for feed, make in list(site.feeds._feeds.values()):
            feed.update(make())
        n_events, n_bytes, stopped = 0, 0, asyncio.Event()

        async def browser(number: int) -> None:
            nonlocal n_events, n_bytes
            feed = feeds["cluster" if number % 2 else "runs"]
            async for event in feed.events(feed.cursor):
                if event.startswith(b"id:"):
                    n_events, n_bytes = n_events + 1, n_bytes + len(event)
                if stopped.is_set():
                    return
                if number % 20 == 0:
                    await asyncio.sleep(10**6)  # a browser that sleeps

        browsers = [asyncio.create_task(browser(number)) for number in range(options.browsers)]
        began, busy_s, updates = time.monotonic(), 0.0, 0
        while time.monotonic() - began < options.seconds:
            cluster.go_on(20)
            data = cluster.status()
            mark = time.process_time()
            site.cluster.take(decoded(data))
            await site.refresh()
            for feed, make in site.feeds.watched():
                feed.update(make())
            busy_s += time.process_time() - mark
            updates += 1
            await asyncio.sleep(LEAST_PAUSE_S)
        lasted = time.monotonic() - began
        stopped.set()
        for task in browsers:
            task.cancel()
        await asyncio.gather(*browsers, return_exceptions=True)
    cost = sorted(cluster.status_s)[len(cluster.status_s) // 2]
    pause = max(polling._LEAST_PAUSE_S, polling._SHARE * cost)
    share = cost / (cost + pause)
    rate = n_events / lasted / max(1, options.browsers)
    print(
        f"status of {options.workers:,} workers, {options.runs} runs: {cost * 1e3:.1f} ms of the coordinator,"
        f" {len(data):,} bytes"
    )
    print(
        f"views ask every {pause:.1f} s: {100 * share:.2f} % of one core for any number of them"
        f" (wanted: under {100 * CORE_SHARE:g} %)"
    )
    print(
        f"{options.browsers} browsers: {rate:.2f} updates a second each, {n_bytes / max(1, n_events):,.0f} bytes an"
        " update"
    )
    print(
        f"the view's own process: {1e3 * busy_s / max(1, updates):.0f} ms an update of both pages, whatever the"
        " browsers"
    )
    frame.save(options.json, {"status_ms": 1e3 * cost, "share": share, "updates_per_s": rate})
    return int(bool(failed) or share > CORE_SHARE or rate > 2.0)


def main() -> int:
    options = frame.options(
        __doc__,
        workers=(2000, "of the cluster"),
        runs=(500, "open runs"),
        browsers=(200, "of each view"),
        seconds=(20.0, "of updates"),
        json=(Path, "also write all numbers to this file"),
    )
    return asyncio.run(watch(options))


if __name__ == "__main__":
    sys.exit(main())
