"""The core's numbers: times to live, back-off, batching. The defaults suit a single machine and a fleet."""

from __future__ import annotations

from typing import Literal

import msgspec


class CoreSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers that the rules decide by. Units are in the names."""

    lease_ttl_s: float = 15.0
    """A lease expires when no heartbeat has named it for this long."""
    heartbeat_s: float = 2.0
    """Heartbeat interval that workers are given; well below `lease_ttl_s`."""
    liveness_grace_s: float = 5.0
    """After its liveliness token disappears, a worker has this long to send a request."""
    adoption_s: float = 4.0
    """After a restart, jobs that may be running somewhere wait this long for a heartbeat that names them."""
    late_s: float = 1.0
    """A deadline served later than this means that the loop was blocked: then no lease expires for one time to live."""
    silence_s: float = 7.5
    """After this long without a request from its worker, a limit verdict or a slot's death may be caused by the
    silence: it does not count and the job is played again."""
    standstill_s: float = 5.0
    """The same holds for jobs that were leased before the coordinator's own loop was blocked for this long."""
    doubts_max: int = 8
    """After this many failures of a job, a limit verdict counts despite a silence or a blocked loop."""
    retry_base_s: float = 0.5
    """First back-off after an infrastructure failure; it doubles with each further one."""
    retry_max_s: float = 60.0
    environment_wait_s: float = 900.0
    """An environment that ends every attempt at a job for at least this long is given up, and its run ends with an
    error."""
    avoid_s: float = 5.0
    """A retried job is kept from the worker that it failed on for this long after its back-off, so that
    another may take it."""
    batch_s: float = 0.1
    """Leases are granted in batches of about so much play time per slot."""
    batch_max: int = 32
    """Most leases that a slot may hold in advance, however short its episodes."""
    warm_bonus_s: float = 2.0
    """How far a run may exceed its fair share, in slot seconds, on a worker that has its environment or bundle warm."""
    job_deadline_s: float = 3600.0
    """Longest that one episode may be played, apart from the policy's limits; after that it counts as hung."""
    stall_s: float = 60.0
    """Waits longer than this are listed among the stalls."""
    fingerprint_cpu: bool = False
    """Whether a worker's fingerprint class includes the CPU's features, besides packages and code."""
    hidden_isolation: Literal["related", "strict", "off"] = "related"
    """Which agents and train jobs keep hidden jobs from a kernel: of runs that share a hidden case, all, or none."""
    hidden_wait_s: float = 60.0
    """After hidden jobs of closed runs were barred from all kernels for this long, one kernel is reserved for them."""
    agent_wait_s: float = 7 * 86_400.0
    """An agent that keeps hidden jobs of closed runs from a reserved kernel is stopped, and its run cancelled, this
    long after its permit was granted. Must be longer than any agent's wall limit."""
    silent_bar_s: float = 60.0
    """After this time, a silent worker has surely stopped its hidden jobs. Well above `lease_ttl_s`, the time after
    which the worker stops them itself."""
    max_wait_s: float = 60.0
    """Upper bound on any long poll."""
