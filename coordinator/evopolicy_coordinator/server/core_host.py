"""Keeps one core loaded: its clock and deadlines, its outbox, and its reloading after a failure.

Rules that this module owns:
- When the store refuses to write, the host drops the core and all undelivered effects, and loads a new core from disk
  as soon as the disk allows. It does the same after a bug in the core, or a row that the store does not accept, but
  only a few times in a row.
- A failure that it cannot recover from (a store that cannot be loaded for another reason, a failure that recurs after
  each load, a failure of the service itself) ends the process with the reason. Its supervisor restarts it from the
  state on disk. See `failed`.
- `now` is Unix time at the start, but no earlier than the latest time on disk, advanced by the monotonic clock. A
  change of the wall clock has no effect.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from math import inf

from evopolicy_common.errors import DamagedStoreError, LeadLostError, PartFailedError, StorageError
from evopolicy_common.logs import log
from evopolicy_coordinator.core.contract.effects import Effect
from evopolicy_coordinator.core.contract.events import AnyEvent
from evopolicy_coordinator.core.contract.records import latest_time
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.storage.sealing import SharedFiles
from evopolicy_coordinator.storage.store import Store
from evopolicy_coordinator.storage.writer import EffectQueue, Writer

_FIRST_PAUSE_S = 0.2
_LONGEST_PAUSE_S = 5.0
_LOADS_MAX = 5
"""Maximum number of reloads after consecutive failures that are not the disk's, each within `_SOON_S` of the one
before."""
_SOON_S = 60.0
LEAD_S = 5.0
"""A coordinator answers nothing when the database has not confirmed its lead for this long, seconds. A server ends the
session of a lost machine later than that."""
_CONFIRM_S = 1.0
_STANDBY_S = 10.0
"""A standby asks for the lock again and again; between two attempts the database does not know of it."""


class CoreHost:
    """The loaded core of one service, on an event loop."""

    def __init__(
        self,
        settings: CoreSettings,
        writer: Writer,
        carry_out: Callable[[Effect], None],
        dropped: Callable[[], None],
    ) -> None:
        """`carry_out` receives the effects of the core, except `Persist`. `dropped` is called when the core is dropped:
        no query that waits for it will be answered."""
        self._settings = settings
        self._writer = writer
        self._carry_out = carry_out
        self._dropped = dropped
        self._loop = asyncio.get_running_loop()
        self._outbox: EffectQueue | None = None
        self.core: Core | None = None
        self.last_core: Core | None = None
        """While the store cannot be written: the core that it refused, for reading."""
        self.incarnation = 0
        """Of the loaded core, or the last one."""
        self.storage_error = ""
        """Why the store cannot be written; empty while it can."""
        self.stopping = False
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._reloading: asyncio.Task[None] | None = None
        self._reload_pause_s = _FIRST_PAUSE_S
        self._n_failures = 0
        """Failures of the core, each within `_SOON_S` of the one before."""
        self._failed_at = 0.0
        self.failed: asyncio.Future[None] = self._loop.create_future()
        """Ends with PartFailedError and the reason when a part of the service cannot continue, with LeadLostError when
        another coordinator leads."""
        self.shared: SharedFiles | None = None
        """The secrets that the coordinators of a database share."""
        self.store_latency_s: float | None = None
        """How long the database took to confirm the lead, seconds; None in a state folder of its own."""
        self._standbys: dict[str, float] = {}
        """Machines that wait for the lead, and the monotonic time when the database last said so."""
        self.leads_until = inf
        """Monotonic time after which nothing is answered unless the database confirms the lead again."""
        self._unconfirmed: list[tuple[Callable[[], None], Callable[[], None]]] = []
        self._confirming: asyncio.Task[None] | None = None
        self._unix_offset = time.time() - self._loop.time()

    def now(self) -> float:
        """Unix time in seconds; never goes back."""
        return self._unix_offset + self._loop.time()

    @property
    def writing_s(self) -> float:
        """Age of the transaction in flight, seconds; 0.0 when there is none."""
        return 0.0 if self._outbox is None else self._outbox.writing_s

    @property
    def idle(self) -> bool:
        """Whether all that the core has decided is durable."""
        return self._outbox is not None and self._outbox.idle

    # Start and end.

    async def start(self) -> None:
        """Loads the core from the store.

        Raises StorageError when the store cannot be read or its incarnation cannot be incremented, and
        PartFailedError when the store can be read but no core can be built from it.
        """
        try:
            await self._load()
        except StorageError:
            raise
        except Exception as error:
            raise self.fail("loading the state", error) from error

    def stop(self) -> None:
        """Loads no further core and acts on no deadline any more. `settle` finishes the steps that were taken."""
        self.stopping = True
        self._cancel_timer()
        if self._reloading is not None:
            self._reloading.cancel()

    async def settle(self) -> None:
        """After `stop`: returns when all effects are durable and carried out, and nothing loads a core."""
        if self._reloading is not None:
            await asyncio.gather(self._reloading, return_exceptions=True)
        while self._outbox is not None and not self._outbox.idle:
            # Returns after all work submitted before it, including the flush that this work triggers.
            await self._writer.call(lambda store: None)
        if self._confirming is not None:
            await asyncio.gather(self._confirming, return_exceptions=True)

    def fail(self, part: str, error: BaseException) -> PartFailedError:
        """Stops serving, as the process must end. The state on disk stays, and the next process starts from it."""
        log.error("a part of the coordinator failed", part=part, exc_info=error)
        failed = PartFailedError(f"{part} failed: {type(error).__name__}: {error}")
        if not self.failed.done():
            self.failed.set_exception(failed)
            self.failed.exception()  # mark as retrieved: nothing may await it, as during the start
        self._forget()
        return failed

    def step_down(self, error: LeadLostError) -> None:
        """Drops all that is not durable, and answers nothing any more."""
        self._forget()
        self.leads_until, self.storage_error, self.last_core = 0.0, "", None
        if not self.failed.done():
            self.failed.set_exception(error)
            self.failed.exception()  # mark as retrieved, as in `fail`

    async def watch_lead(self) -> None:
        """Has the database confirm every second that this coordinator leads; otherwise steps down."""
        self.leads_until = time.monotonic() + LEAD_S
        while not self.failed.done():
            began = time.monotonic()
            try:
                async with asyncio.timeout(max(0.0, self.leads_until - began)):
                    self.store_latency_s = await self._writer.call(Store.confirm)
                self.leads_until = began + LEAD_S
                await self.share()
                self._standbys |= dict.fromkeys(await self._writer.call(Store.standbys), time.monotonic())
            except LeadLostError as error:
                self.step_down(error)
            except (StorageError, TimeoutError) as error:
                if not self.leads:
                    why = str(error) or "no answer"
                    self.step_down(
                        LeadLostError(f"the database has not confirmed the lead for {LEAD_S:g} s: {why}")
                    )
            await asyncio.sleep(_CONFIRM_S)

    @property
    def standbys(self) -> tuple[str, ...]:
        """Machines whose coordinators wait for the lead."""
        since = time.monotonic() - _STANDBY_S
        return tuple(sorted(name for name, seen in self._standbys.items() if seen > since))

    async def share(self) -> None:
        """Makes changed secrets known to the other coordinators. Raises StorageError."""
        if self.shared is not None:
            await self._writer.call(self.shared.push)

    def confirmed(self, then: Callable[[], None], otherwise: Callable[[], None]) -> None:
        """Calls `then` once the database has confirmed the lead, and `otherwise` if it does not.

        A refusal is final for a client. A coordinator that does not know yet that another leads must send none.
        """
        if self.leads_until == inf:
            then()
            return
        self._unconfirmed.append((then, otherwise))
        if self._confirming is None or self._confirming.done():
            self._confirming = self._loop.create_task(self._confirm())

    async def _confirm(self) -> None:
        while batch := self._unconfirmed:
            self._unconfirmed, confirmed = [], False
            try:
                if self.leads:
                    await self._writer.call(Store.confirm)
                    confirmed = True
            except LeadLostError as error:
                self.step_down(error)
            except StorageError as error:
                log.warning("the lead is not confirmed; refusals are not sent", error=str(error))
            for then, otherwise in batch:
                (then if confirmed else otherwise)()

    @property
    def leads(self) -> bool:
        """Whether requests may be answered."""
        return time.monotonic() < self.leads_until

    # Steps.

    def handle(self, event: AnyEvent) -> None:
        """Lets the core handle an event; `flush` sends its effects on their way."""
        self._advance(lambda core: core.handle(event, self.now()))

    def flush(self) -> None:
        """Writes and carries out what the last steps brought, and sets the timer to the core's next deadline."""
        try:
            if self._outbox is not None:
                self._outbox.flush()
            self._set_timer()
        except Exception as error:
            self.fail("the outbox", error)

    def _advance(self, step: Callable[[Core], list[Effect]]) -> None:
        core, outbox = self.core, self._outbox
        if core is None or outbox is None:
            return
        try:
            effects = step(core)
        except Exception as error:
            # A bug. The core's state in memory may be half changed; the state on disk is not.
            self._core_failed(error)
            return
        outbox.put(effects)

    def _set_timer(self) -> None:
        deadline = None if self.core is None or self.stopping else self.core.next_deadline()
        if deadline is None:
            self._cancel_timer()
            return
        at = deadline - self._unix_offset
        if self._timer is not None:
            if self._timer_at <= at:
                # The old timer fires early, finds nothing due and is set again: cheaper than resetting it for each
                # event.
                return
            self._timer.cancel()
        self._timer_at = at
        self._timer = self._loop.call_at(at, self._on_timer)

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _on_timer(self) -> None:
        self._timer = None
        # If it fires too early, it only sets itself again.
        now = self.now()
        self._advance(lambda core: core.handle_deadline(now) if (core.next_deadline() or inf) <= now else [])
        self.flush()

    # Loading and dropping.

    async def _load(self) -> None:
        snapshot = await self._writer.call(Store.load)
        self.incarnation = snapshot.incarnation
        # The clock may have been set back while no coordinator ran. Nothing may end before it started.
        self._unix_offset += max(0.0, latest_time(snapshot) - self.now())
        self.core, effects = Core.load(self._settings, snapshot, self.now())
        self._outbox = EffectQueue(self._writer, self._carry_out, self._on_write_failure)
        self._outbox.put(effects)
        self.storage_error, self.last_core = "", None
        log.info("loaded", incarnation=snapshot.incarnation, runs=len(snapshot.runs))
        self.flush()

    def _core_failed(self, error: Exception) -> None:
        """Reloads the core, unless the last reloads did not help."""
        now = self._loop.time()
        self._n_failures = self._n_failures + 1 if now - self._failed_at < _SOON_S else 1
        self._failed_at = now
        if self._n_failures > _LOADS_MAX:
            self.fail(f"the core, {self._n_failures} times in a row,", error)
            return
        log.error("the core failed; reloading it from the store", n=self._n_failures, exc_info=error)
        self._drop()

    def _on_write_failure(self, error: BaseException) -> None:
        if isinstance(error, DamagedStoreError):
            self._core_failed(error)
            return
        if not isinstance(error, StorageError):
            self.fail("writing the store", error)
            return
        if isinstance(error, LeadLostError):
            self.step_down(error)
            return
        self.storage_error, self.last_core = str(error), self.core
        self._drop()
        log.error("the store cannot write; requests are refused until it can", error=str(error))

    def _drop(self) -> None:
        """Drops all state that is not on disk and starts reloading."""
        if self._outbox is not None and self._outbox.commits:
            self._reload_pause_s = _FIRST_PAUSE_S
        self._forget()
        if not self.stopping:
            self._reloading = self._loop.create_task(self._reload())

    def _forget(self) -> None:
        if self._outbox is not None:
            self._outbox.discard()
        self.core = None
        self._outbox = None
        self._cancel_timer()
        self._dropped()

    async def _reload(self) -> None:
        while True:
            await asyncio.sleep(self._reload_pause_s)
            self._reload_pause_s = min(_LONGEST_PAUSE_S, 2 * self._reload_pause_s)
            try:
                await self._load()
            except DamagedStoreError as error:
                self.fail("loading the state", error)
                return
            except LeadLostError as error:
                self.step_down(error)
                return
            except StorageError as error:
                log.error("the store still cannot write", error=str(error))
                self.storage_error = str(error)
            except Exception as error:
                self.fail("loading the state", error)
                return
            else:
                log.info("the store writes again")
                return
