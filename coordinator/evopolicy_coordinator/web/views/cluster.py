"""The cluster's page: workers, queue, and problems."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from evopolicy_common.messages.status import DiskUse, StatusReply, WorkerStatus
from evopolicy_common.terminal import duration, short
from evopolicy_coordinator.web.content.cluster import ShownCluster
from evopolicy_coordinator.web.content.remarks import remarks, served_by
from evopolicy_coordinator.web.content.rendering import PAGE_ROWS, Words, ident, paged, part
from evopolicy_coordinator.web.content.run_folders import RunFacts, ShownRuns
from evopolicy_results.html import Notice, PageView
from evopolicy_results.reading.environments import title_of

_NOTICE_LINES = 5
"""Lines of a notice; tables have the rest."""
_UNKNOWN = StatusReply(
    cluster="", version="", uptime_s=0.0, episodes_done=0, episodes_per_s=0.0, workers=(), runs=()
)
"""Before the first answer."""


def cluster_view(cluster: ShownCluster, words: Words, runs: ShownRuns, roots: Sequence[Path]) -> PageView:
    """Workers, queue, and problems."""
    status = cluster.status or _UNKNOWN
    view = PageView("worker-rows", "open-rows")
    classes = {worker.fingerprint: worker.versions for worker in status.workers}
    by_run = {run.run: run for run in runs.by_key.values() if run.run}
    names = {run.run: f"{run.entry} on {title_of(run.env)}" for run in status.runs}
    workers = sorted(status.workers, key=lambda one: (one.state == "active", one.worker))
    shown, pages = paged(workers, words, _row_texts, "worker")
    view.parts |= {
        "facts": part("facts", facts=_cluster_facts(status) if cluster.status else []),
        "notices": part("notices", notices=_cluster_notices(cluster, status)),
        "queue": part("queue", rows=status.queue[:PAGE_ROWS], left_out=len(status.queue[PAGE_ROWS:])),
        "disks": part("disks", disks=_disks(status.disk, roots)),
        "classes": part("classes", classes=sorted(classes.items())),
        "worker-pages": pages,
    }
    for worker in shown:
        plays = _plays(worker, names, by_run)
        ident_of = ident("worker", worker.worker)
        view.row("worker-rows", ident_of, part("worker_row", ident=ident_of, worker=worker, plays=plays))
    for run in status.runs[:PAGE_ROWS]:
        key = by_run[run.run].key if run.run in by_run else ""
        name = ident("open", run.run)
        view.row("open-rows", name, part("open_row", ident=name, run=run, key=key))
    return view


def _row_texts(one: WorkerStatus) -> tuple[str, ...]:
    return one.worker, one.host, one.state, one.fingerprint, *one.environments


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
        ("coordinator", served_by(status)),
    ]


def _cluster_notices(cluster: ShownCluster, status: StatusReply) -> list[Notice]:
    silent = "The coordinator does not answer" + (
        "; this is the last that is known." if cluster.status else "."
    )
    why = cluster.trouble or ("" if cluster.status else "It has not answered yet.")
    notices: list[Notice] = []
    for title, lines in {silent: [why], **remarks(status)}.items():
        if texts := [line for line in lines if line]:
            more = [f"… and {len(texts) - _NOTICE_LINES} more"] if len(texts) > _NOTICE_LINES else []
            notices.append(Notice(title, texts[:_NOTICE_LINES] + more))
    return notices


def _disks(of_coordinator: DiskUse | None, roots: Sequence[Path]) -> list[tuple[str, str, DiskUse]]:
    """Machine, folder and space of the disks that fill up while runs are played."""
    disks = [] if of_coordinator is None else [("coordinator", "its state folder", of_coordinator)]
    for root in roots:
        with contextlib.suppress(OSError):  # the page of all runs names a folder that cannot be read
            disk = shutil.disk_usage(root)
            disks.append(("this host", str(root), DiskUse(database=0, free=disk.free, total=disk.total)))
    return disks


def _plays(
    worker: WorkerStatus, names: Mapping[str, str], by_run: Mapping[str, RunFacts]
) -> list[tuple[str, str, int]]:
    """Name, page and number of jobs of each run that a worker plays."""
    return [
        (names.get(run, run), by_run[run].key if run in by_run else "", n)
        for run, n in sorted(worker.playing.items(), key=lambda one: -one[1])[:4]
    ]
