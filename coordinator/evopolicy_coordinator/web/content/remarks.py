"""Remarks on a cluster for its operator, in words for terminals and pages. Imports nothing of the web."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from evopolicy_common.messages.status import RunStatus, StatusReply, WorkerStatus
from evopolicy_common.terminal import duration


def served_by(reply: StatusReply) -> str:
    """The coordinator's machine, and for a database of its own its latency and the standbys' machines."""
    latency = reply.store_latency_s
    if latency is None:
        return reply.host
    return f"{reply.host} (database {1000 * latency:.0f} ms, standby: {', '.join(reply.standbys) or 'none'})"


def remarks(reply: StatusReply) -> Mapping[str, Iterable[str]]:
    """Whole sentences by heading; some have none."""
    workers = reply.workers
    refused = (
        f"{one.worker} gets no work of {run}: {why}" for one in workers for run, why in one.refused.items()
    )
    barred = (
        f"{one.worker} plays no hidden episodes now: {one.hidden_bar}" for one in workers if one.hidden_bar
    )
    trouble = [f"{reply.trouble}; what follows is the last state"] if reply.trouble else []
    return {
        "The coordinator accepts no changes": trouble,
        "Abandoned runs, without a gateway for an hour": abandoned(reply.runs),
        "Workers that get no work of some runs": refused,
        "Workers that lack a sandbox tier or an environment": (
            text for one in workers for text in lacks(one)
        ),
        "Workers that play no hidden episodes now": barred,
        "Waits longer than it should": reply.stalls,
    }


def abandoned(runs: Iterable[RunStatus]) -> Iterator[str]:
    """How to end each abandoned run."""
    for run in runs:
        if run.abandoned:
            yield (
                f"{run.run} has had no gateway for {duration(run.silent_s)}: give its command again with"
                f" --resume, or end it with evopolicy runs cancel {run.run}"
            )


def lacks(worker: WorkerStatus) -> Iterator[str]:
    """Sandbox tiers and environments that it should have, with the reasons."""
    for tier, why in worker.missing_tiers.items():
        yield f"{worker.worker} has no sandbox tier {tier}: {why}"
    for env, why in worker.failed_environments.items():
        yield f"{worker.worker} does not offer {env}: {why}"
