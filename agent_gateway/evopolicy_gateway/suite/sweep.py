"""Plays the runs of a command on this host within the limits: one loop for `run`, `local` and `suite`.

- A failed run does not stop the others.
- A run occupies a place (`parallel`) until its agent is gone: the next one starts while it is scored.
- Cancelled, the sweep cancels its runs, or leaves those that can be resumed (`leaves`).
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial

from msgspec.structs import replace

from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import Index, SweepRun
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.run.lifecycle import Leaves, RunLifecycle
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.record import why_failed
from evopolicy_gateway.run.watch import RunsView
from evopolicy_gateway.suite.decisions import Decision, side_by_side
from evopolicy_gateway.suite.suite_file import Parallel
from evopolicy_gateway.suite.suite_index import directory_of, waiting

POLL_S = 1.0
MAX_SCORED = 256
"""Limit of agent-less runs followed at once, in addition to those with a place: each polls the coordinator."""


FINISH_AGAIN_S = (1.0, 5.0, 30.0)
"""Pauses before a run whose agent is gone is finished again after an error: on the last one, it is left to
`--resume`."""


class Sweep(ABC):
    leaves: Leaves
    """Which of its runs cancelling this leaves to be resumed."""

    def __init__(
        self, limits: Parallel, index: Index, operations: Operations, gateway: Credentials, watch: RunsView
    ) -> None:
        self._limits, self._index = limits, index
        self._operations, self._gateway, self._watch = operations, gateway, watch
        self._decided: dict[str, Decision] = {}
        """The latest decision for each run."""
        self._todo: list[Decision] = []
        self._active: dict[str, asyncio.Task[None]] = {}
        self._plays: dict[str, RunLifecycle] = {}
        self._scored: set[str] = set()
        """Runs whose agent is gone."""
        self._moved = asyncio.Event()
        """Set when an agent is gone."""

    async def play_runs(self, decisions: Sequence[Decision]) -> None:
        """Plays all runs to their end, or as far as caps and other hosts' runs allow."""
        self._todo = [one for one in decisions if one.kind != "keep"]
        self._decided = {one.run.name: one for one in decisions}
        try:
            while self._todo or self._active:
                for decision in self._startable():
                    if await self._begin(decision):
                        self._todo.remove(decision)
                if self._active:
                    await self._wait(list(self._active.values()))
                elif self._todo:
                    if self._given_up():
                        return
                    await asyncio.sleep(POLL_S)
                for name, task in list(self._active.items()):
                    if task.done():
                        del self._active[name]
                        self._scored.discard(name)
                        self._ended(name, task)
        finally:
            for task in self._active.values():
                # At the loop's end they are being cancelled too. A second time would interrupt their clean-up.
                if not task.cancelling():
                    task.cancel()
            await asyncio.gather(*self._active.values(), return_exceptions=True)

    # Overridden by the kinds of sweep.

    @abstractmethod
    async def _record(self, decision: Decision, begun: SweepRun) -> SweepRun:
        """Plays a run and returns its resulting entry."""

    def _given_up(self) -> bool:
        """Whether no further run will start."""
        return False

    def _may_begin(self, run: Plan) -> bool:
        """Whether a run may start now, apart from the limits."""
        return True

    async def _begin(self, decision: Decision) -> bool:
        """Starts a run; False when it cannot start now."""
        self._active[decision.run.name] = asyncio.create_task(self._play(decision))
        return True

    def _ended(self, name: str, task: asyncio.Task[None]) -> None:
        """Handles the end of a run here; raises unexpected errors."""
        task.result()

    def _put(self, entry: SweepRun) -> None:
        self._index.runs[entry.name] = entry

    def _begun(self, decision: Decision) -> SweepRun:
        run, attempt = decision.run, decision.attempt
        return replace(waiting(run), state="running", attempt=attempt, directory=directory_of(run))

    def _why(self, run: Plan, error: Exception) -> str:
        return why_failed(error, run.folder.harness_log)

    # Internals of the loop.

    async def _wait(self, active: list[asyncio.Task[None]]) -> None:
        """Waits until a run has ended, an agent is gone, or `POLL_S` has passed."""
        moved = asyncio.ensure_future(self._moved.wait())
        await asyncio.wait([*active, moved], timeout=POLL_S, return_when=asyncio.FIRST_COMPLETED)
        moved.cancel()
        self._moved.clear()

    def _startable(self) -> list[Decision]:
        """Runs that the limits allow to start now."""
        under_way = [self._decided[name].run for name in self._active]
        placed = [self._decided[name].run for name in self._active if name not in self._scored]
        if len(self._scored) >= MAX_SCORED:
            return []
        # A run that is only finished has no agent and needs no place.
        able = [one for one in self._todo if self._may_begin(one.run)]
        starting = [one for one in able if one.kind == "finish"]
        waiting = [one for one in able if one.kind != "finish"]
        while len(placed) < self._limits.machine:
            fitting = (one for one in side_by_side(waiting, under_way) if self._fits(one.run, placed))
            if (chosen := next(fitting, None)) is None:
                break
            waiting.remove(chosen)
            starting.append(chosen)
            for runs in (placed, under_way):
                runs.append(chosen.run)
        return starting

    def _fits(self, run: Plan, placed: list[Plan]) -> bool:
        """Whether the limits allow a run beside those that have a place."""
        limits = self._limits
        most, at_provider = run.parallel or limits.agent, limits.providers.get(run.provider, limits.machine)
        same_agent = sum(other.entry == run.entry for other in placed)
        same_provider = sum(other.provider == run.provider for other in placed)
        return (most is None or same_agent < most) and same_provider < at_provider

    def _agent_gone(self, name: str) -> None:
        self._scored.add(name)
        self._moved.set()

    async def _play(self, decision: Decision) -> None:
        before, begun = self._index.runs.get(decision.run.name), self._begun(decision)
        self._put(begun)
        pauses = list(FINISH_AGAIN_S)
        done: SweepRun | None = None
        while done is None:
            try:
                done = await self._record(decision, begun)
            except Exception as error:
                tokens, why = self._index.runs[begun.name].tokens, self._why(decision.run, error)
                if begun.name in self._scored and pauses:
                    decision = replace(decision, kind="finish")
                    await asyncio.sleep(pauses.pop(0))
                else:
                    done = replace(begun, state="error", error=why, tokens=tokens)
                    play = self._plays.get(begun.name)
                    if before is not None and (play is None or not play.run):
                        # The folder still holds the earlier run, if there was one.
                        done = replace(done, digest=before.digest, attempt=before.attempt)
                        done = replace(done, settings=before.settings)
            finally:
                self._plays.pop(begun.name, None)
        self._put(done)

    async def _played(
        self, decision: Decision, plan: Plan, put_aside: Callable[[], None] | None = None
    ) -> RunRecord:
        gone = partial(self._agent_gone, plan.name)
        play = RunLifecycle(plan, self._operations, self._gateway, self._watch, self.leaves, gone)
        self._plays[plan.name] = play
        return await (play.go_on() if decision.kind in ("resume", "finish") else play.play_run(put_aside))
