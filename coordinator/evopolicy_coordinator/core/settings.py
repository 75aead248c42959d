"""The core's numbers: times to live, back-off, batching. All have defaults that suit one machine and a fleet alike."""

from __future__ import annotations

from typing import Literal

import msgspec


class CoreSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers the core decides by. Units are in the names."""

    lease_ttl_s: float = 15.0
    """A lease that no heartbeat has named for so long is given up."""
    heartbeat_s: float = 2.0
    """What workers are told to beat at; well below `lease_ttl_s`."""
    liveness_grace_s: float = 5.0
    """After its liveliness token went, a worker has so long to be heard from."""
    adoption_s: float = 4.0
    """After a restart, jobs that may be running somewhere wait so long for a heartbeat that names them."""
    late_s: float = 1.0
    """A deadline served later than this means the loop stood still: then nothing expires for one time to live."""
    silence_s: float = 7.5
    """After so long without a word from its worker, a verdict about a limit, or a slot's death, may be the silence's fault:
    it does not count and the job is played again."""
    standstill_s: float = 5.0
    """The same holds for jobs that were leased before the coordinator's own loop stood still for so long."""
    doubts_max: int = 8
    """A job that failed so often is taken at its word all the same."""
    retry_base_s: float = 0.5
    """First back-off after an infrastructure failure; doubles with each."""
    retry_max_s: float = 60.0
    avoid_s: float = 5.0
    """How long a retried job is kept from the worker it failed on, so that another may take it."""
    batch_s: float = 0.1
    """Leases are handed out in batches of about so much play time per slot."""
    batch_max: int = 32
    """Most leases a slot may hold ahead, however short its episodes."""
    warm_bonus_s: float = 2.0
    """How far a run may get ahead of its fair share, in slot seconds, on a worker that has its environment warm."""
    preemptions_max: int = 3
    """A hidden job of a closed run is stopped at most so often for the sake of train jobs."""
    job_deadline_s: float = 3600.0
    """Longest that one episode may be played, limits of the policy aside; then it is taken to hang."""
    stall_s: float = 60.0
    """What waits longer is listed among the stalls."""
    fingerprint_cpu: bool = False
    """Count the CPU's features into a worker's fingerprint class too, not only packages and code."""
    audit_share: float = 0.0
    """Share of the episodes of new runs, 0 to 1, whose recorded actions are played again on another worker."""
    audit_wait_s: float = 300.0
    """A run that is done otherwise waits for its audits at most so long."""
    hidden_isolation: Literal["related", "strict", "off"] = "related"
    """Which agents and train jobs keep hidden jobs from a kernel: those of runs that share a hidden case, all, or none."""
    hidden_wait_s: float = 60.0
    """When hidden jobs of closed runs have been kept waiting for so long, they go first on one kernel."""
    silent_bar_s: float = 60.0
    """A silent worker has stopped whatever hidden it played after so long: well above `lease_ttl_s`, after which it does."""
    max_wait_s: float = 60.0
    """Upper bound on any long poll."""
