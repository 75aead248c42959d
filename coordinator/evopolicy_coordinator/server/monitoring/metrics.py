"""Metrics in Prometheus' text format: counters from the core's effects, and the status at the time of each scrape.
`metrics_server` serves them (`--metrics ADDRESS`) on the coordinator's event loop.

Names and units follow Prometheus' conventions: a prefix, base units (seconds, bytes), `_total` for counters. No label
names a run, an agent or a worker: their number is unbounded, and hidden results must not appear here.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.status import StatusReply
from evopolicy_common.messages.worker import Leases
from evopolicy_common.wire.credentials import host_and_port
from evopolicy_common.wire.http import bound, serving
from evopolicy_coordinator.core.contract.effects import Effect, Log, Persist, Reply
from evopolicy_coordinator.core.contract.records import OutcomeRow, SubmitRow
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.storage.disk_use import sizes

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SECONDS = (0.1, 0.3, 1, 3, 10, 30, 60, 180, 600, 1800, 3600, 4 * 3600, 24 * 3600)
_STATES = ("active", "paused", "draining", "lost")
_PHASES = ("open", "validation", "heldout", "random", "finished")


class Meter:
    """Counts a core's activity from the effects of each step."""

    def __init__(self, state: Path, status: Callable[[], StatusReply | None]) -> None:
        """`state`: the state folder, whose size is reported. `status` is called at every scrape; it returns None
        while no core is loaded."""
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.registry.register(StatusCollector(status))
        self.registry.register(_StoreCollector(state))
        counter = partial(Counter, registry=self.registry)
        histogram = partial(Histogram, buckets=_SECONDS, registry=self.registry)
        self._episodes = counter(
            "evopolicy_episodes", "Episodes whose result was stored.", ("split", "verdict")
        )
        self._repeated = counter(
            "evopolicy_episode_retries", "Further attempts that stored episodes had needed."
        )
        self._submits = counter("evopolicy_submits", "Submits that ended, by verdict.", ("verdict",))
        self._latency = histogram(
            "evopolicy_submit_duration_seconds", "From a submit's acceptance to its verdict."
        )
        self._wait = histogram(
            "evopolicy_lease_wait_seconds", "From a submit's acceptance to the lease of its first job."
        )
        self._leases = counter("evopolicy_leases", "Leases that were granted.")
        text = "Events of the core, as the log names them."
        self._events = counter("evopolicy_events", text, ("event", "level"))
        self._open: set[tuple[str, int]] = set()
        """Submits without a verdict. A submit's row may be stored again after its end, and must count once."""

    def loaded(self, core: Core) -> None:
        """Resets the open submits to those of a newly loaded core."""
        self._open = {
            (run.id, row.submit_index)
            for run in core.state.runs.values()
            for row in run.submits
            if row.status is None
        }

    def observe(self, effects: Iterable[Effect]) -> None:
        """Counts the effects of one step."""
        for effect in effects:
            if isinstance(effect, Persist):
                for row in effect.rows:
                    if isinstance(row, OutcomeRow):
                        self._outcome(row)
                    elif isinstance(row, SubmitRow):
                        self._submit(row)
            elif isinstance(effect, Reply):
                if isinstance(effect.message, Leases):
                    self._leases.inc(len(effect.message.leases))
            elif isinstance(effect, Log):
                self._events.labels(effect.event, effect.level).inc()

    def text(self) -> bytes:
        return generate_latest(self.registry)

    def _outcome(self, row: OutcomeRow) -> None:
        split = row.group.rpartition("/")[2]
        kind = split if split in ("train", "validation", "heldout", "random") else "other"
        failure = row.outcome.failure
        self._episodes.labels(kind, "ok" if failure is None else failure.category).inc()
        if row.attempt > 1:
            self._repeated.inc(row.attempt - 1)

    def _submit(self, row: SubmitRow) -> None:
        key = row.run, row.submit_index
        if row.status is None:
            self._open.add(key)
        elif key in self._open:
            self._open.discard(key)
            self._submits.labels(row.status).inc()
            if row.completed_at is not None:
                self._latency.observe(max(0.0, row.completed_at - row.accepted_at))
            if row.first_leased_at is not None:
                self._wait.observe(max(0.0, row.first_leased_at - row.accepted_at))


class StatusCollector(Collector):
    """Gauges from a status reply."""

    def __init__(self, status: Callable[[], StatusReply | None]) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        status = self._status()
        yield _gauge("evopolicy_up", "1 while the coordinator answers.", status is not None)
        if status is None:
            return
        about = {"version": status.version, "cluster": status.cluster, "host": status.host}
        yield InfoMetricFamily("evopolicy_build", "Version, cluster, and host of the coordinator.", about)
        yield _gauge("evopolicy_uptime_seconds", "Since the coordinator started.", status.uptime_s)
        if status.store_latency_s is not None:
            text = "How long PostgreSQL took to confirm that this coordinator leads."
            yield _gauge("evopolicy_store_latency_seconds", text, status.store_latency_s)
            text, standbys = (
                "1 for each machine that waits for the lead.",
                {(name,): 1 for name in status.standbys},
            )
            yield _gauges("evopolicy_standby", text, ("host",), standbys)
        yield CounterMetricFamily(
            "evopolicy_cluster_episodes",
            "Episodes that the cluster has played since its coordinator started.",
            status.episodes_done,
        )
        yield _gauge("evopolicy_episodes_per_second", "Over the last minute.", status.episodes_per_s)
        workers = {state: [each for each in status.workers if each.state == state] for state in _STATES}
        n_workers = {(state,): len(there) for state, there in workers.items()}
        yield _gauges("evopolicy_workers", "Workers by state.", ("state",), n_workers)
        slots = {(state,): sum(each.slots for each in there) for state, there in workers.items()}
        yield _gauges("evopolicy_slots", "Slots of workers by state.", ("state",), slots)
        busy = sum(worker.running for worker in status.workers)
        yield _gauge("evopolicy_slots_busy", "Slots that play now.", busy)
        phases = {(phase,): sum(run.phase == phase for run in status.runs) for phase in _PHASES}
        yield _gauges("evopolicy_open_runs", "Unfinished runs by phase.", ("phase",), phases)
        depth: dict[tuple[str, ...], int] = {}
        for run in status.runs:
            depth[run.phase, run.env] = depth.get((run.phase, run.env), 0) + run.queued
        text = "Jobs that wait, by phase and environment."
        yield _gauges("evopolicy_queue_jobs", text, ("phase", "env"), dict(sorted(depth.items())))
        waiting = sum(bool(run.waits_for) for run in status.runs)
        yield _gauge("evopolicy_runs_waiting", "Runs that wait for something.", waiting)
        text = "Jobs and groups that wait longer than they should."
        yield _gauge("evopolicy_stalls", text, len(status.stalls))


class _StoreCollector(Collector):
    """Sizes of the database and of the free disk space."""

    def __init__(self, state: Path) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        with contextlib.suppress(OSError):
            disk = sizes(self._state)
            text = "Size of the database."
            yield _gauge("evopolicy_store_database_bytes", text, disk.database)
            yield _gauge("evopolicy_store_free_bytes", "Free on the state folder's disk.", disk.free)


def _gauge(name: str, text: str, value: float) -> Metric:
    return _gauges(name, text, (), {(): value})


def _gauges(name: str, text: str, labels: tuple[str, ...], values: Mapping[Any, float]) -> Metric:
    made = GaugeMetricFamily(name, text, labels=labels)
    for each, value in values.items():
        made.add_metric(each, value)
    return made


@contextlib.asynccontextmanager
async def metrics_server(address: str, meter: Meter, healthy: Callable[[], bool]) -> AsyncIterator[int]:
    """Serves inside the `async with`; yields the port.

    Raises ConfigError for an invalid address, or one that cannot be listened on.
    """
    host, port = host_and_port("--metrics", address, "127.0.0.1:9464")

    async def metrics(_: Request) -> Response:
        return Response(meter.text(), media_type=CONTENT_TYPE)

    async def health(_: Request) -> Response:
        return PlainTextResponse("ok\n") if healthy() else PlainTextResponse("no core is loaded\n", 503)

    app = Starlette(routes=[Route("/metrics", metrics), Route("/healthz", health)])
    try:
        sock = bound(host, port)
    except OSError as error:
        raise ConfigError(
            f"--metrics {address}: {error.strerror or error}; choose another address"
        ) from error
    number: int = sock.getsockname()[1]
    async with serving(app, sock):
        yield number
