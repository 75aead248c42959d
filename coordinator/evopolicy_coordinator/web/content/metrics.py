"""The cluster's status in Prometheus' text format.

Names and units follow Prometheus' conventions: a prefix, base units (seconds, bytes), `_total` for counters. No label
names a run, an agent or a worker: their number is unbounded, and hidden results must not appear here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from evopolicy_common.messages.status import StatusReply

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_STATES = ("active", "paused", "draining", "lost")
_PHASES = ("open", "validation", "heldout", "random", "finished")


class StatusCollector(Collector):
    """Metrics of a status reply; None: the coordinator does not answer."""

    def __init__(self, status: Callable[[], StatusReply | None]) -> None:
        """`status` is called at every scrape."""
        self._status = status

    def collect(self) -> Iterator[Metric]:
        status = self._status()
        yield GaugeMetricFamily(
            "evopolicy_up", "1 while the coordinator answers.", value=float(status is not None)
        )
        if status is None:
            return
        about = {"version": status.version, "cluster": status.cluster, "host": status.host}
        yield InfoMetricFamily("evopolicy_build", "Version, cluster, and host of the coordinator.", about)
        text = "Episodes that the cluster has played since its coordinator started."
        yield CounterMetricFamily("evopolicy_cluster_episodes", text, status.episodes_done)
        for name, text, value in _gauges(status):
            yield GaugeMetricFamily(f"evopolicy_{name}", text, value=value)
        for name, text, labels, values in _labelled(status):
            family = GaugeMetricFamily(f"evopolicy_{name}", text, labels=labels)
            for each, value in values.items():
                family.add_metric(each, value)
            yield family


def _gauges(status: StatusReply) -> Iterator[tuple[str, str, float]]:
    yield "uptime_seconds", "Since the coordinator started.", status.uptime_s
    yield "episodes_per_second", "Over the last minute.", status.episodes_per_s
    yield "slots_busy", "Slots that play now.", sum(worker.running for worker in status.workers)
    waiting = sum(bool(run.waits_for) for run in status.runs)
    yield "runs_waiting", "Runs that wait for something.", waiting
    yield "stalls", "Jobs and groups that wait longer than they should.", len(status.stalls)
    if status.store_latency_s is not None:
        text = "How long PostgreSQL took to confirm that this coordinator leads."
        yield "store_latency_seconds", text, status.store_latency_s
    if status.disk is not None:
        yield "store_database_bytes", "Size of the database.", status.disk.database
        yield "store_free_bytes", "Free on the state folder's disk.", status.disk.free


def _labelled(
    status: StatusReply,
) -> Iterator[tuple[str, str, tuple[str, ...], Mapping[tuple[str, ...], float]]]:
    workers, slots, phases = Counter[str](), Counter[str](), Counter[str]()
    queued: Counter[tuple[str, ...]] = Counter()
    for worker in status.workers:
        workers[worker.state] += 1
        slots[worker.state] += worker.slots
    for run in status.runs:
        phases[run.phase] += 1
        queued[run.phase, run.env] += run.queued
    yield "workers", "Workers by state.", ("state",), {(state,): workers[state] for state in _STATES}
    yield "slots", "Slots of workers by state.", ("state",), {(state,): slots[state] for state in _STATES}
    yield "open_runs", "Unfinished runs by phase.", ("phase",), {(phase,): phases[phase] for phase in _PHASES}
    yield "queue_jobs", "Jobs that wait, by phase and environment.", ("phase", "env"), queued
    text = "1 for each machine that waits for the lead."
    yield "standby", text, ("host",), {(host,): 1 for host in status.standbys}
