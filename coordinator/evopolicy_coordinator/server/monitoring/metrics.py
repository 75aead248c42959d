"""Metrics in Prometheus' text format: counters from the core's effects, and the status at the time of each scrape.

Names and units follow Prometheus' conventions: a prefix, base units (seconds, bytes), `_total` for counters. No label
names a run, an agent or a worker: their number is unbounded, and hidden results must not appear here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from evopolicy_common.messages.status import StatusReply
from evopolicy_common.messages.worker import Leases
from evopolicy_coordinator.core.contract.effects import Effect, Log, Persist, Reply
from evopolicy_coordinator.core.contract.records import OutcomeRow, SubmitRow
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.storage.disk_use import sizes

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SECONDS = (0.1, 0.3, 1, 3, 10, 30, 60, 180, 600, 1800, 3600, 4 * 3600, 24 * 3600)
_STATES = ("active", "paused", "draining", "lost", "quarantined")
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
        self._episodes = Counter(
            "evopolicy_episodes",
            "Episodes whose result was stored.",
            ("split", "verdict"),
            registry=self.registry,
        )
        self._repeated = Counter(
            "evopolicy_episode_retries",
            "Further attempts that stored episodes had needed.",
            registry=self.registry,
        )
        self._submits = Counter(
            "evopolicy_submits", "Submits that ended, by verdict.", ("verdict",), registry=self.registry
        )
        self._latency = Histogram(
            "evopolicy_submit_duration_seconds",
            "From a submit's acceptance to its verdict.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._wait = Histogram(
            "evopolicy_lease_wait_seconds",
            "From a submit's acceptance to the lease of its first job.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self._leases = Counter("evopolicy_leases", "Leases that were granted.", registry=self.registry)
        self._events = Counter(
            "evopolicy_events",
            "Events of the core, as the log names them.",
            ("event", "level"),
            registry=self.registry,
        )
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
        """All metrics in the text format."""
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
        up = GaugeMetricFamily("evopolicy_up", "1 while the coordinator answers.")
        up.add_metric((), float(status is not None))
        yield up
        if status is None:
            return
        yield InfoMetricFamily(
            "evopolicy_build", "What serves.", {"version": status.version, "cluster": status.cluster}
        )
        yield _gauge("evopolicy_uptime_seconds", "Since the coordinator started.", status.uptime_s)
        total = CounterMetricFamily(
            "evopolicy_cluster_episodes",
            "Episodes that the cluster has played since its coordinator started.",
        )
        total.add_metric((), status.episodes_done)
        yield total
        yield _gauge("evopolicy_episodes_per_second", "Over the last minute.", status.episodes_per_s)
        workers = GaugeMetricFamily("evopolicy_workers", "Workers by state.", labels=("state",))
        slots = GaugeMetricFamily("evopolicy_slots", "Slots of workers by state.", labels=("state",))
        for state in _STATES:
            there = [worker for worker in status.workers if worker.state == state]
            workers.add_metric((state,), len(there))
            slots.add_metric((state,), sum(worker.slots for worker in there))
        yield workers
        yield slots
        yield _gauge(
            "evopolicy_slots_busy", "Slots that play now.", sum(worker.running for worker in status.workers)
        )
        runs = GaugeMetricFamily("evopolicy_open_runs", "Unfinished runs by phase.", labels=("phase",))
        queue = GaugeMetricFamily(
            "evopolicy_queue_jobs", "Jobs that wait, by phase and environment.", labels=("phase", "env")
        )
        for phase in _PHASES:
            runs.add_metric((phase,), sum(run.phase == phase for run in status.runs))
        depth: dict[tuple[str, str], int] = {}
        for run in status.runs:
            depth[run.phase, run.env] = depth.get((run.phase, run.env), 0) + run.queued
        for labels, n in sorted(depth.items()):
            queue.add_metric(labels, n)
        yield runs
        yield queue
        yield _gauge(
            "evopolicy_runs_waiting",
            "Runs that wait for something.",
            sum(bool(run.waits_for) for run in status.runs),
        )
        yield _gauge(
            "evopolicy_stalls", "Jobs and groups that wait longer than they should.", len(status.stalls)
        )
        yield _gauge(
            "evopolicy_quarantined_workers",
            "Workers that audits have put into quarantine.",
            len(status.quarantined),
        )
        audits = GaugeMetricFamily(
            "evopolicy_audits", "Audited episodes of unfinished runs.", labels=("state",)
        )
        for name, n in sorted(status.audits.items()):
            audits.add_metric((name,), n)
        yield audits


class _StoreCollector(Collector):
    """Sizes of the state folder's database and of the free disk space."""

    def __init__(self, state: Path) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        with contextlib.suppress(OSError):
            disk = sizes(self._state)
            yield _gauge(
                "evopolicy_store_database_bytes", "Database files in the state folder.", disk.database
            )
            yield _gauge("evopolicy_store_free_bytes", "Free on the state folder's disk.", disk.free)


def _gauge(name: str, text: str, value: float) -> Metric:
    made = GaugeMetricFamily(name, text)
    made.add_metric((), value)
    return made
