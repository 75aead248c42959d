"""All faults of the simulation in one record: named, with a rate, off by default, drawn from the seed."""

from __future__ import annotations

import random
from dataclasses import dataclass, fields, replace


@dataclass(frozen=True)
class Faults:
    """Each rate is a probability per message, effect, transaction or job, or a number of events
    per simulated minute."""

    loss: float = 0.0
    """Per message: it is lost."""
    delay: float = 0.0
    """Per message: it takes up to `delay_s` longer; messages then overtake each other."""
    delay_s: float = 3.0
    duplicate: float = 0.0
    """Per message: it arrives twice."""
    partition: float = 0.0
    """Per minute: one endpoint is partitioned for up to 30 s."""
    worker_crash: float = 0.0
    """Per minute: a worker crashes with all its state, and restarts."""
    worker_freeze: float = 0.0
    """Per minute: a worker is frozen for up to 40 s."""
    slow_worker: float = 0.0
    """Probability that a worker plays four times slower."""
    worker_trouble: float = 0.0
    """Per job: it fails through the worker's own fault (disk full, environment crashed)."""
    gateway_crash: float = 0.0
    """Per minute: a gateway crashes and restarts with its durable state."""
    coordinator_crash: float = 0.0
    """Per carried-out effect: the coordinator crashes right after it."""
    crash_before_persist: float = 0.0
    """Per transaction: the coordinator crashes just before it."""
    coordinator_stall: float = 0.0
    """Per minute: the coordinator's loop is blocked for up to 40 s."""
    leader_lost: float = 0.0
    """Per effect, transactions included: another coordinator gets the lock just before it."""
    disk_error: float = 0.0
    """Per transaction: it fails."""
    liveness_flap: float = 0.0
    """Per minute: a worker's liveliness token disappears although the worker is well."""
    until_s: float = 80.0
    """No fault starts later than this."""

    def named(self) -> str:
        """The faults that are on, for a failure's summary."""
        default = Faults()
        on = [
            f"{each.name}={getattr(self, each.name):.3g}"
            for each in fields(self)
            if getattr(self, each.name) != getattr(default, each.name)
        ]
        return ", ".join(on) or "none"


RATES: dict[str, float] = {
    "loss": 0.15,
    "delay": 0.3,
    "duplicate": 0.15,
    "partition": 3.0,
    "worker_crash": 3.0,
    "worker_freeze": 3.0,
    "slow_worker": 0.3,
    "worker_trouble": 0.2,
    "gateway_crash": 2.0,
    "coordinator_crash": 0.03,
    "crash_before_persist": 0.05,
    "coordinator_stall": 1.5,
    "disk_error": 0.05,
    "liveness_flap": 3.0,
}
"""The highest rate of each fault that a seed may draw."""

LEADER_LOST = 0.04
"""The rate of seeds with a standby, in addition to what they draw."""

HARMLESS = ("liveness_flap", "coordinator_stall")
"""Faults that must not cause a single retry."""


def draw(chance: random.Random) -> Faults:
    """Draws the faults of a seed: one in eight has none, one in eight harmless ones, one in four a single
    kind, the others several."""
    kind = chance.random()
    if kind < 0.125:
        return Faults()
    if kind < 0.25:
        chosen = [name for name in HARMLESS if chance.random() < 0.7]
    elif kind < 0.5:
        chosen = [chance.choice(list(RATES))]
    else:
        chosen = [name for name in RATES if chance.random() < 0.35]
    return replace(Faults(), **{name: RATES[name] * chance.uniform(0.2, 1.0) for name in chosen})
