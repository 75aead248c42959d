"""The simulated world: one clock, one source of randomness, a network that loses, delays, duplicates and reorders
messages.

Every event is one call at a simulated time; calls at the same time run in the order they were scheduled, so the seed
determines everything.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from typing import Any

from sim_faults import Faults


class World:
    """Clock, randomness and the network."""

    def __init__(self, seed: int, faults: Faults) -> None:
        self.seed = seed
        self.faults = faults
        self.now = 1000.0
        self.chance = random.Random(seed)
        self.calls = 0
        self.trace: list[str] | None = None
        self.calm_at = self.now + faults.until_s
        """No fault starts after this."""
        self._heap: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = 0
        self._cut: dict[str, float] = {}
        """Endpoint to the end of its partition."""

    def after(self, delay_s: float, call: Callable[..., None], *args: Any) -> None:
        self._count += 1
        heapq.heappush(self._heap, (self.now + delay_s, self._count, call, args))

    def run(self, until: float, done: Callable[[], bool]) -> bool:
        """Process events until `done` or `until`; returns whether it is `done`."""
        while self._heap and self._heap[0][0] <= until:
            at, _, call, args = heapq.heappop(self._heap)
            self.now = max(self.now, at)
            self.calls += 1
            call(*args)
            if done():
                return True
        return done()

    def note(self, text: str) -> None:
        if self.trace is not None:
            self.trace.append(f"{self.now:10.3f} {text}")

    # ---- network ----

    def send(self, endpoint: str, deliver: Callable[..., None], *args: Any) -> None:
        """Deliver a message between `endpoint` and the coordinator, subject to the network's faults."""
        faults, chance = self.faults, self.chance
        stormy = self.now < self.calm_at
        if self._cut.get(endpoint, 0.0) > self.now or (stormy and chance.random() < faults.loss):
            self.note(f"lost: {endpoint}")
            return
        copies = 2 if stormy and chance.random() < faults.duplicate else 1
        for _ in range(copies):
            delay_s = 0.001 + chance.random() * 0.004
            if stormy and chance.random() < faults.delay:
                delay_s += chance.random() * faults.delay_s
            self.after(delay_s, deliver, *args)

    def cut(self, endpoint: str, seconds: float) -> None:
        self._cut[endpoint] = self.now + seconds
        self.note(f"cut off for {seconds:.1f} s: {endpoint}")
