"""How an unfinished job is retried: a decision as a value, made in one place.

Rules that this module owns:
- Only infrastructure failures are retried, without limit. A policy's failure is a result and never handled here.
- Only an environment that keeps ending the same job is given up: after `FAULTS_MAX` attempts in at least
  `CoreSettings.environment_wait_s`, on two machines if two can play it, so that no machine's word alone ends a run.
- A job that is given back (drained, cancelled) has not failed: no delay, no blame.
- The jobs that ran on a lost worker become suspects and rerun alone. The jobs that waited there behind them just return
  to the queue.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.tables.model import EnvironmentFaults

FAULTS_MAX = 5

JobFailure = Literal["returned", "unlisted", "failed", "worker_lost", "overdue"]
"""returned: given back unfinished, without a failure. unlisted: its worker is alive but does not know the lease,
which never arrived. failed: the worker's own fault. worker_lost: its worker went silent. overdue: played for longer
than any episode may take."""


class Retry(NamedTuple):
    """How a job goes back into the queue."""

    delay_s: float
    avoid: bool
    """Keep it from the same worker for a while."""
    alone: bool
    """It is suspected of crashing workers: it reruns with no other job beside it."""
    counted: bool
    """It counts as an infrastructure failure: in the back-off, and in the operator's figures."""


def backoff_s(settings: CoreSettings, failures: int) -> float:
    """Returns the back-off in seconds after the `failures`-th infrastructure failure (from 1): doubles,
    up to `retry_max_s`."""
    return min(settings.retry_max_s, settings.retry_base_s * 2.0 ** min(failures - 1, 30))


def in_vain(settings: CoreSettings, faults: EnvironmentFaults, able: set[str], now: float) -> bool:
    """Whether another attempt at a job would only meet the same fault of its environment. `able`: machines that can
    play it."""
    lasted = now - faults.since >= settings.environment_wait_s
    return faults.n >= FAULTS_MAX and lasted and len(faults.on) >= min(2, len(able))


def decide(settings: CoreSettings, failure: JobFailure, *, failures: int, ran: bool) -> Retry:
    """Returns the retry of a job after `failure`. `failures` includes this one; `ran`: whether the
    job was being played."""
    if failure == "returned":
        return Retry(0.0, avoid=False, alone=False, counted=False)
    if failure == "unlisted" or (failure == "worker_lost" and not ran):
        return Retry(0.0, avoid=False, alone=False, counted=True)
    delay_s = backoff_s(settings, failures)
    return Retry(delay_s, avoid=True, alone=failure == "worker_lost", counted=True)
