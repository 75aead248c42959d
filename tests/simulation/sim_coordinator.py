"""The simulated coordinator: the production core, a loop that can block, a disk that can fail, a process that can
crash.

Effects are carried out as the contract requires, in order and a little later than the core requests them, while the
core takes in more events: it runs ahead of its disk. The process may crash before any transaction and after any effect.
Before any of both, a standby may get the lock: the old leader goes on beside it until it notices.
"""

from __future__ import annotations

import copy
import zlib
from collections.abc import Callable
from math import inf
from typing import Any

from rigs.asking import asked
from sim_checkers import Checkers
from sim_store import Disk
from sim_world import World

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import (
    Effect,
    Log,
    Persist,
    ReadEvaluation,
    ReadFinished,
    ReadResults,
    Refuse,
    Reply,
)
from evopolicy_coordinator.core.contract.records import evaluation_group, submit_done, submit_group
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.server.reason_texts import message

PAGE = 5
"""Most episodes in a page."""
FLUSH_S = 0.004
CONFIRM_S = 1.0
"""Longest time that a leader does not notice that it has lost the lock."""


class Page:
    """A results or evaluation page, read from the disk."""

    def __init__(self, rows: list[Any], cursor: int, done: Any) -> None:
        self.rows, self.cursor, self.done = rows, cursor, done


class SimCoordinator:
    """Carries out a core's effects in the simulated world."""

    def __init__(self, world: World, disk: Disk, checkers: Checkers, settings: CoreSettings) -> None:
        self.world, self.disk, self.checkers, self.settings = world, disk, checkers, settings
        self.core: Core | None = None
        self.life = 0
        self._asks: dict[int, tuple[str, Callable[[Any], None], wire.Message]] = {}
        self._handles = 0
        self._queue: list[Effect] = []
        self._flushing = False
        self._stalled_until = 0.0
        self._woken_at: float | None = None
        self._term = 0
        self._leads_until = inf
        self._deposed: SimCoordinator | None = None
        """The last leader; half of the clients ask it as long as it serves."""
        self.start()

    # ---- life ----

    def start(self) -> None:
        self.life += 1
        self.disk.incarnation += 1
        self._term = self.disk.incarnation
        self._asks = {}
        self._queue = []
        self._flushing = False
        self._woken_at = None
        core, effects = Core.load(self.settings, self.disk.snapshot(), self.world.now)
        self.core = core
        self.checkers.loaded(core)
        self._take(effects)

    def crash(self, why: str) -> None:
        """Lose all state that is not on disk; another process takes over later."""
        if self.core is not None:
            self._end(f"dies: {why}", 0.5 + self.world.chance.random() * 5.0)

    def _end(self, why: str, again_s: float) -> None:
        """Discards the core; it is loaded again, unless another coordinator leads."""
        self.world.note(f"coordinator {self._term} {why}")
        self.core = None
        self.life += 1
        self._queue = []
        if self._leads_until == inf:
            self.world.after(again_s, self.start)

    def _lose_lead(self, effects: list[Effect]) -> None:
        """The lock goes to a standby, which loads the rows at once or later. The old leader still has these effects to
        carry out, and may be paused."""
        world = self.world
        world.note(f"coordinator {self._term} loses the lock")
        old = copy.copy(self)
        old._queue, old._flushing, old._woken_at = effects, False, None
        old._leads_until = world.now + CONFIRM_S * world.chance.random()
        if world.chance.random() < 0.3:
            old.stall(world.chance.random() * 40.0)
        old._take([])
        world.after(old._leads_until - world.now, old._step_down, old.life)
        self._deposed = old
        self.core = None
        self.life += 1
        self._asks, self._queue = {}, []
        world.after(world.chance.choice((0.0, world.chance.random() * 2.0)), self.start)

    def _step_down(self, life: int) -> None:
        if life == self.life and not self._later(self._step_down, life):
            self._end("notices that it does not lead", inf)

    def stall(self, seconds: float) -> None:
        self.world.note(f"coordinator stands still for {seconds:.1f} s")
        self._stalled_until = self.world.now + seconds

    def _later(self, call: Callable[..., None], *args: Any) -> bool:
        """Postpone a call while the loop is blocked; returns whether it was postponed."""
        if self.world.now < self._stalled_until:
            self.world.after(self._stalled_until - self.world.now, call, *args)
            return True
        return False

    # ---- in ----

    def receive(
        self,
        endpoint: str,
        kind: type[wire.Message | events.LivenessLost],
        fields: dict[str, Any],
        answer: Callable[[Any], None],
        arrived: float | None = None,
    ) -> None:
        """A request arrives, or arrived at `arrived` and is read now; `answer` delivers the reply."""
        arrived = self.world.now if arrived is None else arrived
        old = self._deposed
        if old is not None and old.core is not None and zlib.crc32(f"{endpoint} {old._term}".encode()) % 2:
            old.receive(endpoint, kind, fields, answer, arrived)
            return
        if self._later(self.receive, endpoint, kind, fields, answer, arrived):
            return
        if self.world.now > self._leads_until:
            return
        if kind is wire.LeaseRequest:
            fields = {**fields, "waited_s": self.world.now - arrived}
        if self.core is None:
            return
        self._handles += 1
        stimulus = f"{kind.__name__}-{self._handles}"
        if issubclass(kind, wire.Message):
            event = asked(kind, request=self._handles, stimulus_id=stimulus, **fields)
            self._asks[self._handles] = (endpoint, answer, event.message)
        else:
            event = kind(stimulus_id=stimulus, **fields)
        self.world.note(f"{endpoint} → {event}")
        self.checkers.asking(event)
        self._take(self.core.handle(event, self.world.now))  # type: ignore[arg-type]
        self.checkers.stepped(self.core)

    def _wake(self, life: int) -> None:
        if life != self.life or self.core is None or self._later(self._wake, life):
            return
        self._woken_at = None
        due = self.core.next_deadline()
        if due is not None and due <= self.world.now:
            self._take(self.core.handle_deadline(self.world.now))
            self.checkers.stepped(self.core)
        self._set_alarm()

    def _set_alarm(self) -> None:
        assert self.core is not None
        due = self.core.next_deadline()
        if due is not None and (self._woken_at is None or due < self._woken_at):
            self._woken_at = due
            self.world.after(max(0.0, due - self.world.now), self._wake, self.life)

    # ---- out ----

    def _take(self, effects: list[Effect]) -> None:
        self._queue += effects
        if self._queue and not self._flushing:
            self._flushing = True
            self.world.after(FLUSH_S * self.world.chance.random(), self._flush, self.life)
        self._set_alarm()

    def _flush(self, life: int) -> None:
        """Carry out the queued effects in order; a crash may interrupt it anywhere."""
        if life != self.life or self._later(self._flush, life):
            return
        world, faults = self.world, self.world.faults
        stormy = world.now < world.calm_at
        self._flushing = False
        effects, self._queue = self._queue, []
        for place, effect in enumerate(effects):
            may_lose = stormy and faults.leader_lost and self._leads_until == inf
            if may_lose and world.chance.random() < faults.leader_lost:
                self._lose_lead(effects[place:])
                return
            if isinstance(effect, Log):
                world.note(f"log {effect.event} {effect.fields}")
                self.checkers.logged(effect)
            elif isinstance(effect, Persist):
                if stormy and world.chance.random() < faults.crash_before_persist:
                    self.crash("before a transaction")
                    return
                if stormy and world.chance.random() < faults.disk_error:
                    self._end("has a disk that refuses", 0.2)
                    return
                if not self.disk.admits(self._term):
                    self._end("has lost its term", inf)
                    return
                self.checkers.committing(effect.rows)
                self.disk.write(effect.rows)
            else:
                if isinstance(effect, Refuse) and not self.disk.admits(self._term):
                    self._end("has lost its term", inf)
                    return
                self._carry_out(effect)
                if stormy and world.chance.random() < faults.coordinator_crash:
                    self.crash("after an effect")
                    return

    def _carry_out(self, effect: Reply | Refuse | ReadResults | ReadEvaluation | ReadFinished) -> None:
        who = self._asks.pop(int(effect.request), None)
        if who is None:
            return
        endpoint, answer, request = who
        message = self._message(effect)
        self.world.note(f"{endpoint} ← {message}")
        self.checkers.answering(request, message, self._term)
        self.world.send(endpoint, answer, message)

    def _message(self, effect: Reply | Refuse | ReadResults | ReadEvaluation | ReadFinished) -> Any:
        match effect:
            case Reply() | Refuse():
                return message(effect)
            case ReadFinished():
                return self.disk.finished[effect.run]
            case ReadResults():
                row = self.disk.submits[effect.run, effect.submit_index]
                upto = row.released if effect.upto is None or row.status is not None else effect.upto
                rows = self.disk.page(
                    submit_group(effect.run, effect.submit_index, "train"), effect.cursor, upto, PAGE
                )
                cursor = rows[-1].seq + 1 if rows else effect.cursor
                return Page(rows, cursor, submit_done(row) if cursor >= upto else None)
            case ReadEvaluation():
                rows = self.disk.page(evaluation_group(effect.evaluation), effect.cursor, effect.upto, PAGE)
                cursor = rows[-1].seq + 1 if rows else effect.cursor
                return Page(rows, cursor, effect.finished and cursor >= effect.upto)
