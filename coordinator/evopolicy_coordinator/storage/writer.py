"""The thread that writes the database, so that no fsync blocks the event loop.

Rules that this module owns:
- Work runs in the order of its submission; its results are reported on the event loop, in the same order.
- Group commit: `EffectQueue` submits all waiting rows as one transaction and meanwhile collects the next.
- Effects leave the outbox in the order of their arrival, and none before every `Persist` ahead of it is durable.
- Any exception of the work is reported like a result: the thread does not end before it is closed.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from evopolicy_coordinator.core.contract.effects import Effect, Persist
from evopolicy_coordinator.core.contract.records import Row
from evopolicy_coordinator.storage.store import Store

T = TypeVar("T")


class Writer:
    """Runs work on a store in a thread of its own. Construct it on the event loop that receives the results."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._loop = asyncio.get_running_loop()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="store-writer")

    def call(self, do: Callable[[Store], T]) -> asyncio.Future[T]:
        """Returns the future result of `do(store)`, run after all work submitted before."""
        return self._loop.run_in_executor(self._thread, do, self._store)

    async def close(self) -> None:
        """Ends the thread once all submitted work is done."""
        await asyncio.to_thread(self._thread.shutdown)


class EffectQueue:
    """Outgoing effects in order, with at most one transaction in flight."""

    def __init__(
        self,
        writer: Writer,
        carry_out: Callable[[Effect], None],
        on_failure: Callable[[BaseException], None],
    ) -> None:
        """`carry_out` receives every effect except `Persist`. `on_failure` is called once, with a
        StorageError when the store refuses, or a bug's exception; the outbox then drops everything."""
        self._writer = writer
        self._carry_out = carry_out
        self._on_failure = on_failure
        self._effects: deque[Effect] = deque()
        self._rows: list[Row] = []
        self._n_waiting = 0
        """Number of persists whose rows are in `_rows`."""
        self._n_in_flight = 0
        self._n_durable = 0
        """Number of persists that are durable and still in `_effects`."""
        self._dead = False
        self._writing_since = 0.0
        self.commits = 0

    def put(self, effects: list[Effect]) -> None:
        """Appends effects; `flush` processes them."""
        for effect in effects:
            if isinstance(effect, Persist):
                self._rows.extend(effect.rows)
                self._n_waiting += 1
            self._effects.append(effect)

    def flush(self) -> None:
        """Carries out the effects that no persist holds back; submits waiting rows, one write at a time."""
        if self._dead:
            return
        self._drain()
        if self._n_in_flight or not self._n_waiting:
            return
        rows, self._rows = self._rows, []
        self._n_in_flight, self._n_waiting = self._n_waiting, 0
        self._writing_since = time.monotonic()
        self._writer.call(lambda store: store.write(rows)).add_done_callback(self._ended)

    def discard(self) -> None:
        """Drops all waiting effects and rows for good."""
        self._dead = True
        self._effects.clear()
        self._rows.clear()

    @property
    def writing_s(self) -> float:
        """Age of the transaction in flight, seconds; 0.0 when there is none."""
        return time.monotonic() - self._writing_since if self._n_in_flight else 0.0

    @property
    def idle(self) -> bool:
        """Whether all effects are carried out and durable."""
        return not self._effects and not self._n_in_flight

    def _ended(self, write: asyncio.Future[None]) -> None:
        error = write.exception()
        if self._dead:
            return
        if error is not None:
            self.discard()
            self._on_failure(error)
            return
        self.commits += 1
        self._n_durable += self._n_in_flight
        self._n_in_flight = 0
        self.flush()

    def _drain(self) -> None:
        effects = self._effects
        while effects:
            if isinstance(effects[0], Persist):
                if not self._n_durable:
                    return
                self._n_durable -= 1
                effects.popleft()
            else:
                self._carry_out(effects.popleft())
