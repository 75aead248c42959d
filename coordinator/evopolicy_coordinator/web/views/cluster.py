"""The cluster's page: workers, queue, history, and problems."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from evopolicy_common.cli.conventions import bytes_text
from evopolicy_common.messages.status import DiskUse, StatusReply, WorkerStatus
from evopolicy_common.terminal import duration
from evopolicy_coordinator.web.content.charts import Line, chart
from evopolicy_coordinator.web.content.cluster import Cluster
from evopolicy_coordinator.web.content.feeds import View
from evopolicy_coordinator.web.content.rendering import part, short
from evopolicy_coordinator.web.content.run_folders import RunFacts, Runs
from evopolicy_coordinator.web.content.tables import PAGE_ROWS, Words, ident, matches, paged
from evopolicy_results.html import notice
from evopolicy_results.reading.environments import title_of

_NOTICE_LINES = 5
"""Lines of a notice; tables have the rest."""


def cluster_view(cluster: Cluster, words: Words, runs: Runs, roots: Sequence[Path], *, acting: bool) -> View:
    """Workers, queue, history, and problems."""
    status = cluster.status
    if status is None:
        why = cluster.trouble or "It has not answered yet."
        parts = {
            "facts": part("facts", facts=[]),
            "notices": part("notices", notices=[notice("The coordinator does not answer.", [why])]),
            "history": part("figure", ident="history", svg="", empty="", title="History", caption=""),
            "queue": part("queue", rows=[], left_out=0),
            "disks": part("disks", disks=_disks(None, roots)),
            "classes": part("classes", classes=[]),
            "worker-pages": part("pages", ident="worker-pages", what="workers", pages=paged([], words)[1]),
        }
        return View(parts=parts, lists={"worker-rows": [], "open-rows": []})
    parts = {
        "facts": part("facts", facts=_cluster_facts(status)),
        "notices": part("notices", notices=_cluster_notices(cluster, status)),
        "history": part(
            "figure", ident="history", svg=Markup(_history(cluster)), title="The last day",
            caption="Episodes per second, and jobs that run and wait; a point a minute.", empty="The history begins now: a point a minute.",  # noqa: E501
        ),
        "queue": part("queue", rows=status.queue[:PAGE_ROWS], left_out=len(status.queue[PAGE_ROWS:])),
        "disks": part("disks", disks=_disks(status.disk, roots)),
        "classes": part("classes", classes=sorted({worker.fingerprint: worker.versions for worker in status.workers}.items())),  # noqa: E501
    }  # fmt: skip
    lists: dict[str, list[str]] = {"worker-rows": [], "open-rows": []}
    by_run = {run.run: run for run in runs.by_key.values() if run.run}
    names = {run.run: f"{run.entry} on {title_of(run.env)}" for run in status.runs}
    kept = [
        worker
        for worker in status.workers
        if matches(
            words.q, worker.worker, worker.host, worker.state, worker.fingerprint, *worker.environments
        )
    ]
    kept.sort(key=lambda worker: (worker.state == "active", worker.worker))
    shown, pages = paged(kept, words)
    parts["worker-pages"] = part("pages", ident="worker-pages", what="workers", pages=pages)
    for worker in shown:
        name = ident("worker", worker.worker)
        lists["worker-rows"].append(name)
        parts[name] = part(
            "worker_row", ident=name, worker=worker, plays=_plays(worker, names, by_run), acting=acting
        )
    for run in status.runs[:PAGE_ROWS]:
        name = ident("open", run.run)
        lists["open-rows"].append(name)
        known = by_run.get(run.run)
        parts[name] = part("open_row", ident=name, run=run, key="" if known is None else known.key)
    return View(parts=parts, lists=lists)


def _cluster_facts(status: StatusReply) -> list[tuple[str, str]]:
    active = [worker for worker in status.workers if worker.state == "active"]
    slots, busy = sum(worker.slots for worker in active), sum(worker.running for worker in status.workers)
    return [
        ("workers active", f"{len(active)} of {len(status.workers)}"),
        ("slots busy", f"{busy} of {slots}"),
        ("queued", short(sum(run.queued for run in status.runs))),
        ("open runs", str(len(status.runs))),
        ("episodes a second", f"{status.episodes_per_s:.1f}"),
        ("episodes done", short(status.episodes_done)),
        ("up", duration(status.uptime_s)),
        ("version", status.version),
    ]


def _cluster_notices(cluster: Cluster, status: StatusReply) -> list[dict[str, Any]]:
    workers = status.workers
    told: tuple[tuple[str, Iterable[str]], ...] = (
        ("The coordinator does not answer; this is the last that is known.", [cluster.trouble]),
        ("The coordinator accepts no changes; this is the last state", [status.trouble]),
        (
            "Abandoned runs, without a gateway for an hour",
            (f"{run.run}: evopolicy runs cancel {run.run} ends it" for run in status.runs if run.abandoned),
        ),
        ("Quarantined workers", (f"{name}: {why}" for name, why in status.quarantined.items())),
        ("Disputes of audits", status.disputes),
        (
            "Turned away",
            (
                f"{one.worker} of {one.host}, {duration(one.ago_s)} ago: {one.why}"
                for one in status.turned_away
            ),
        ),
        ("Waits longer than it should", status.stalls),
        (
            "Workers that get no work of some runs",
            (f"{one.worker}: {why} ({run})" for one in workers for run, why in one.refused.items()),
        ),
        (
            "Workers without a sandbox tier",
            (f"{one.worker}: {tier}: {why}" for one in workers for tier, why in one.missing_tiers.items()),
        ),
        (
            "Environments that failed on a worker",
            (
                f"{one.worker}: {env}: {why}"
                for one in workers
                for env, why in one.failed_environments.items()
            ),
        ),
        (
            "Workers that play no hidden episodes now",
            (f"{one.worker}: {one.hidden_bar}" for one in workers if one.hidden_bar),
        ),
    )
    notices: list[dict[str, Any]] = []
    for title, lines in told:
        if found := [line for line in lines if line]:
            more = [f"… and {len(found) - _NOTICE_LINES} more"] if len(found) > _NOTICE_LINES else []
            notices.append(notice(title, found[:_NOTICE_LINES] + more))
    if status.audit_share or status.audits:
        stand = ", ".join(f"{n} {state.replace('_', ' ')}" for state, n in sorted(status.audits.items()))
        text = f"Audits: {status.audit_share:g} of the episodes of new runs; now {stand or 'none'}."
        notices.append(notice(text))
    return notices


def _disks(of_coordinator: DiskUse | None, roots: Sequence[Path]) -> list[dict[str, Any]]:
    """Size and free space of the disks that fill up while runs are played."""
    found = [] if of_coordinator is None else [("coordinator", "its state folder", of_coordinator)]
    for root in roots:
        with contextlib.suppress(OSError):  # the page of all runs names a folder that cannot be read
            disk = shutil.disk_usage(root)
            found.append(("this host", str(root), DiskUse(database=0, free=disk.free, total=disk.total)))
    return [
        {
            "where": where,
            "folder": folder,
            "database": bytes_text(disk.database) if disk.database else "",
            "free": bytes_text(disk.free),
            "total": bytes_text(disk.total),
            "share": 1.0 - disk.free / max(1, disk.total),
        }
        for where, folder, disk in found
    ]


def _plays(
    worker: WorkerStatus, names: Mapping[str, str], by_run: Mapping[str, RunFacts]
) -> list[tuple[str, str, int]]:
    """Name, page and number of jobs of each run that a worker plays."""
    return [
        (names.get(run, run), by_run[run].key if run in by_run else "", n)
        for run, n in sorted(worker.playing.items(), key=lambda one: -one[1])[:4]
    ]


def _history(cluster: Cluster) -> str:
    if len(cluster.history) < 2:
        return ""
    now = time.time()
    hours = [(sample.at - now) / 3600 for sample in cluster.history]

    def line(name: str, field: str) -> Line:
        return Line(
            name, [(x, float(getattr(one, field))) for x, one in zip(hours, cluster.history, strict=True)]
        )

    rate = line("episodes a second", "episodes_per_s")
    jobs = [line(name, name) for name in ("running", "queued", "slots")]
    return chart("Episodes a second over the last day", "hours", [rate]) + chart(
        "Jobs over the last day", "hours", jobs
    )
