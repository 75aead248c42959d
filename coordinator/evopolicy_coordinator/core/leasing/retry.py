"""What to do about a job that was not finished: a decision as a value, made in one place.

Rules that this module owns:
- Only what is our own fault is retried, without limit. A policy's failure is a result, and never comes here.
- Being given back (drained, preempted, cancelled) is nobody's fault: no delay, no blame.
- A lost worker makes suspects of the jobs that ran on it: they rerun alone. Those that waited behind them just go back.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from evopolicy_coordinator.core.settings import CoreSettings

JobFailure = Literal["returned", "unlisted", "failed", "worker_lost", "overdue"]
"""returned: given back unplayed. unlisted: its worker lives but does not know of it, the lease never arrived. failed: the
worker's own trouble. worker_lost: its worker went silent. overdue: it was played for longer than any episode may take."""


class Retry(NamedTuple):
    """How a job goes back into the queue."""

    delay_s: float
    avoid: bool
    """Keep it from the same worker for a while."""
    alone: bool
    """It is suspected of taking down workers: it reruns with nothing beside it."""
    counted: bool
    """It counts as an infrastructure failure: in the back-off, and in what an operator sees."""


def backoff_s(settings: CoreSettings, failures: int) -> float:
    """Seconds to wait after the `failures`-th infrastructure failure (from 1): doubles, up to a bound."""
    return min(settings.retry_max_s, settings.retry_base_s * 2.0 ** min(failures - 1, 30))


def decide(settings: CoreSettings, failure: JobFailure, *, failures: int, ran: bool) -> Retry:
    """The retry of a job after `failure`; `failures` counts this one, `ran` tells whether it was being played."""
    if failure == "returned":
        return Retry(0.0, avoid=False, alone=False, counted=False)
    if failure == "unlisted" or (failure == "worker_lost" and not ran):
        return Retry(0.0, avoid=False, alone=False, counted=True)
    delay_s = backoff_s(settings, failures)
    return Retry(delay_s, avoid=True, alone=failure == "worker_lost", counted=True)
