"""A sweep on this host: begins runs as the limits allow, keeps its claims on them, and the index up to date.

Rules:
- A run is played only while this host holds its claim at the coordinator. A claim that another host has meanwhile ends
  the run here, and its folder stays as it is.
- Cancelled, it leaves runs open and gives no claim back: the same host goes on with them, and another takes them over
  once their time is up.
- A run takes a place (`parallel`) until its agent is gone: the next one begins while it is scored.
- A provider that is away holds back further runs with it; those that go on wait by themselves.
- A cap that is used up holds back all further runs, and leaves those of coding agents open as a cancelled sweep does.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import socket
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.operator import ClaimState
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.run_record import RunRecord, decode_run_record
from evopolicy_common.records.suite_folder import PAUSED
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway import harnesses
from evopolicy_gateway.harnesses import session
from evopolicy_gateway.operator.child_messages import AgentDoing
from evopolicy_gateway.operator.locks import alone
from evopolicy_gateway.operator.operations import Operations
from evopolicy_gateway.operator.runs import why_failed
from evopolicy_gateway.run.layout import OpenedRun, RunFolder, saved
from evopolicy_gateway.run.lifecycle import RunLifecycle
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.suite import suite_index
from evopolicy_gateway.suite.decisions import Decision, Found, side_by_side
from evopolicy_gateway.suite.suite_file import SuiteFile, SuiteRun
from evopolicy_gateway.suite.suite_index import FINISHED, Entry, Index
from evopolicy_gateway.suite.suite_view import SuiteView

_ASK_AGAIN_S = 5.0
_LOOK_S = 1.0
_MAX_SCORED = 256
"""Runs without an agent that are followed at once, beside those that have a place: each is a question to the coordinator."""
ATTEMPTS = ".attempts"


class _TakenOverError(Exception):
    """Another host took the run's claim and cancelled the run at the cluster."""


class Sweep:
    """Plays the decisions."""

    def __init__(
        self,
        suite: SuiteFile,
        root: Path,
        started_in: Path,
        index: Index,
        operations: Operations,
        gateway: Credentials,
        view: SuiteView,
    ) -> None:
        self._suite = suite
        self._root = root.absolute()
        self._started_in = started_in
        self._index = index
        self._operations = operations
        self._gateway = gateway
        self._view = view
        self._host = socket.gethostname()
        # A host is a machine and a folder: two sweeps of one machine in different folders are two hosts.
        self._holder = f"{self._host}:{hashlib.sha256(str(self._root).encode()).hexdigest()[:12]}"
        self._active: dict[str, asyncio.Task[None]] = {}
        self._plays: dict[str, RunLifecycle] = {}
        self._not_before: dict[str, float] = {}
        self._paused_until: dict[str, float] = {}
        self._ending: set[str] = set()
        """Runs that have been cancelled and are not done with it."""
        self._scored: set[str] = set()
        """Runs whose agent is gone."""
        self._moved = asyncio.Event()
        """An agent has gone."""
        self._unsaved = False
        self._paused = False
        view.on_doing = self._on_doing

    async def play(self, decisions: Sequence[Decision]) -> None:
        """All of them to their end, or as far as caps and other hosts' runs allow."""
        todo = [one for one in decisions if one.kind != "keep"]
        by_name = {one.run.name: one for one in decisions}
        renewing = asyncio.create_task(self._renew(by_name))
        try:
            while todo or self._active:
                if renewing.done():
                    # Claims that nobody renews go to another host while their runs go on here.
                    renewing.result()
                for decision in self._startable(todo, by_name):
                    if await self._begin(decision, by_name):
                        todo.remove(decision)
                self._stop_at_the_cap(by_name)
                waiting = list(self._active.values())
                if not waiting and todo and (why := self._used_up()) is not None:
                    self._view.say(f"{len(todo)} runs are left as they are: {why}")
                    return
                if waiting:
                    await self._wait(waiting)
                elif todo:
                    await asyncio.sleep(1.0)
                for name, task in list(self._active.items()):
                    if task.done():
                        del self._active[name]
                        self._ending.discard(name)
                        self._scored.discard(name)
                        taken_over = not task.cancelled() and isinstance(task.exception(), _TakenOverError)
                        if task.cancelled() or taken_over:
                            # Another host has it, whose result is asked for in time; or a cap is used up.
                            if taken_over:
                                by_name[name] = _anew(by_name[name])
                            self._not_before[name] = time.monotonic() + _ASK_AGAIN_S
                            self._view.waits(name)
                            todo.append(by_name[name])
                        else:
                            task.result()
        finally:
            renewing.cancel()
            for task in self._active.values():
                task.cancel()
            await asyncio.gather(renewing, *self._active.values(), return_exceptions=True)
            with contextlib.suppress(EvopolicyError):
                self._save()

    async def _wait(self, waiting: list[asyncio.Task[None]]) -> None:
        """Until a run has ended, an agent has gone, or it is time to look again."""
        moved = asyncio.ensure_future(self._moved.wait())
        await asyncio.wait([*waiting, moved], timeout=_LOOK_S, return_when=asyncio.FIRST_COMPLETED)
        moved.cancel()
        self._moved.clear()

    def _startable(self, todo: list[Decision], by_name: dict[str, Decision]) -> list[Decision]:
        """Runs that the limits let begin now; none while the sweep is paused."""
        was_paused, self._paused = self._paused, (self._root / PAUSED).exists()
        if self._paused:
            if not was_paused:
                self._view.say(f"paused: no further run begins while {self._root / PAUSED} is there")
            return []
        limits = self._suite.parallel
        under_way = [by_name[name].run for name in self._active]
        placed = [by_name[name].run for name in self._active if name not in self._scored]
        if self._used_up() is not None or len(self._scored) >= _MAX_SCORED:
            return []
        # What is only finished has no agent, and so needs no place.
        found = [one for one in todo if one.kind == "finish" and self._is_time(one.run)]
        left = [one for one in todo if one.kind != "finish"]
        while len(placed) < limits.machine:
            fitting = (one for one in side_by_side(left, under_way) if self._fits(one.run, placed))
            decision = next(fitting, None)
            if decision is None:
                break
            left.remove(decision)
            found.append(decision)
            placed.append(decision.run)
            under_way.append(decision.run)
        return found

    def _fits(self, run: SuiteRun, placed: list[SuiteRun]) -> bool:
        """Whether the limits let a run begin beside those that have a place."""
        limits = self._suite.parallel
        same_agent = sum(other.agent == run.agent for other in placed)
        same_provider = sum(other.provider == run.provider for other in placed)
        most = run.parallel or limits.agent
        return (
            (most is None or same_agent < most)
            and same_provider < limits.providers.get(run.provider, limits.machine)
            and self._is_time(run)
        )

    def _is_time(self, run: SuiteRun) -> bool:
        now = time.monotonic()
        waits_until = max(self._not_before.get(run.name, 0.0), self._paused_until.get(run.provider, 0.0))
        return waits_until <= now

    def _agent_gone(self, name: str) -> None:
        self._scored.add(name)
        self._moved.set()

    def _stop_at_the_cap(self, by_name: dict[str, Decision]) -> None:
        """Interrupts what still uses tokens once a cap of the sweep is used up."""
        why = self._used_up()
        for name, task in self._active.items() if why is not None else ():
            play = self._plays.get(name)
            if by_name[name].run.config is not None and play is not None and play.agent_at_work:
                self._end(name, task, f"interrupted: {why}; it goes on where it was once the cap is raised")

    def _end(self, name: str, task: asyncio.Task[None], why: str) -> None:
        """Ends a run here and leaves it open; once, as a second time would break the ending off."""
        if name not in self._ending:
            self._ending.add(name)
            self._view.note(name, why)
            task.cancel()

    async def _begin(self, decision: Decision, by_name: dict[str, Decision]) -> bool:
        """Claims the run and starts it; False when another host has it at the moment."""
        run = decision.run
        claim = await self._ask(run)
        if claim.result is not None:
            entry = msgspec.structs.replace(msgspec.convert(claim.result, Entry), directory="")
            self._put(entry)
            self._view.finished(run.name, entry)
            return True
        if not claim.granted:
            self._not_before[run.name] = time.monotonic() + _ASK_AGAIN_S
            self._view.elsewhere(run.name, claim.holder.partition(":")[0])
            return False
        if claim.previous:
            self._view.note(run.name, f"taken over from {claim.previous.partition(':')[0]}")
            if claim.run:
                await self._forget(claim.run)
            decision = by_name[run.name] = _anew(decision)
        self._active[run.name] = asyncio.create_task(self._play(decision))
        return True

    async def _play(self, decision: Decision) -> None:
        run = decision.run
        folder = run.folder(self._root)
        entry = Entry(
            name=run.name,
            agent=run.agent,
            env=run.settings.env,
            repeat=run.settings.repeat,
            digest=run.digest,
            state="running",
            attempt=decision.attempt,
            directory=str(folder.root.relative_to(self._root)),
            host=self._host,
            settings=msgspec.to_builtins(run.defining),
            **self._used_before(run.name, decision),
        )
        self._put(entry)
        self._view.started(run.name, decision.attempt)
        try:
            if decision.kind in ("restart", "new"):
                with alone(folder.lock, folder.root):
                    await self._put_aside(folder, decision.attempt - 1)
            record = await self._played(decision)
            if record.outcome.status == "cancelled" and await self._is_taken_over(run):
                self._view.note(run.name, "another host has it now and has cancelled it here")
                raise _TakenOverError
            done = suite_index.entry_of(
                run,
                record,
                self._root,
                folder.root,
                digest=run.digest,
                host=self._host,
                run=self._run_of(run),
                settings=entry.settings,
                earlier=entry.earlier,
            )
        except _TakenOverError:
            raise
        except Exception as error:
            why, known = why_failed(error, folder.harness_log), self._index.runs[run.name].tokens
            done = msgspec.structs.replace(entry, state="error", error=why, tokens=known)
        finally:
            self._plays.pop(run.name, None)
        self._put(done)
        self._view.finished(run.name, done)
        if done.state in FINISHED:
            await self._ask(run, result=msgspec.to_builtins(done))
        else:
            await self._ask(run, ttl_s=0.0)

    async def _played(self, decision: Decision) -> RunRecord:
        run = decision.run
        plan = Plan(
            settings=msgspec.structs.replace(run.settings, attempt=decision.attempt),
            agent=run.harness,
            runs=self._root,
            started_in=self._started_in,
            wall_limit_s=run.wall_s,
            silence_s=run.silence_s,
            config=run.config,
            jail=run.jail,
        )
        play = RunLifecycle(
            plan,
            self._operations,
            self._gateway,
            self._view,
            name=run.name,
            stays_open=True,
            on_agent_gone=partial(self._agent_gone, run.name),
        )
        self._plays[run.name] = play
        return await (play.resume() if decision.kind in ("resume", "finish") else play.play())

    async def _is_taken_over(self, run: SuiteRun) -> bool:
        claim = await self._ask(run)
        return claim.result is not None or not claim.granted

    async def _renew(self, by_name: dict[str, Decision]) -> None:
        """Keeps the claims of what goes on here, and tells soon which run of the cluster is played for each."""
        every_s = self._suite.parallel.claim_ttl_s / 4
        told: dict[str, tuple[str, float]] = {}
        while True:
            await asyncio.sleep(min(_LOOK_S, every_s))
            if self._unsaved:
                # Claims are renewed whatever the disk says.
                with contextlib.suppress(EvopolicyError):
                    self._save()
            for name, task in list(self._active.items()):
                run = by_name[name].run
                known, at = told.get(name, ("", 0.0))
                fresh = self._run_of(run) == known and time.monotonic() - at < every_s
                if fresh or name in self._ending:
                    continue
                with contextlib.suppress(EvopolicyError):
                    told[name] = (self._run_of(run), time.monotonic())
                    claim = await self._ask(run)
                    if not claim.granted and claim.holder != self._holder and not task.done():
                        # That host has ended our run at the cluster.
                        by_name[name] = _anew(by_name[name])
                        self._end(name, task, f"another host has it now ({claim.holder}): ended here")

    async def _ask(
        self, run: SuiteRun, ttl_s: float | None = None, result: dict[str, Any] | None = None
    ) -> ClaimState:
        # With other settings it is another run, whatever has become of the one before.
        name = f"{run.name}@{run.digest}"
        return await self._operations.claim(
            self._suite.name,
            name,
            self._holder,
            self._suite.parallel.claim_ttl_s if ttl_s is None else ttl_s,
            self._run_of(run),
            result,
        )

    async def _put_aside(self, folder: RunFolder, attempt: int) -> None:
        """Keeps what there is of an earlier attempt, and ends its run at the cluster."""
        if not folder.root.exists():
            return
        await self._operations.drop(folder)
        kept = self._root / ATTEMPTS / folder.root.relative_to(self._root)
        target = kept.with_name(f"{kept.name}.{max(attempt, 1)}")
        while target.exists():
            target = target.with_name(f"{target.name}+")
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_tree(folder.state)
        folder.root.rename(target)

    async def _forget(self, run: str) -> None:
        with contextlib.suppress(EvopolicyError):
            await self._operations.cancel(run)

    def _run_of(self, run: SuiteRun) -> str:
        play = self._plays.get(run.name)
        return "" if play is None else play.run

    def _used_before(self, name: str, decision: Decision) -> dict[str, Any]:
        """What a run that is gone on with, or the attempts before it, have used."""
        entry = self._index.runs.get(name)
        if entry is None:
            return {}
        if decision.kind in ("resume", "finish"):
            return {"tokens": entry.tokens, "earlier": entry.earlier}
        return {"earlier": suite_index.added(entry.earlier, entry.tokens)}

    def _on_doing(self, name: str, doing: AgentDoing) -> None:
        entry = self._index.runs.get(name)
        if entry is not None and doing.tokens is not None:
            # Written with the next look: a stream may tell it many times a second.
            self._index.runs[name] = msgspec.structs.replace(entry, tokens=doing.tokens)
            self._unsaved = True
        if doing.provider:
            self._paused_until[doing.provider] = time.monotonic() + doing.paused_s

    def _used_up(self) -> str | None:
        caps = self._suite.caps
        tokens, cost = suite_index.used(self._index)
        if caps.max_tokens is not None and tokens >= caps.max_tokens:
            return f"{tokens} of {caps.max_tokens} tokens are used"
        if caps.max_cost is not None and cost >= caps.max_cost:
            return f"{cost:.2f} of {caps.max_cost:.2f} dollars are spent"
        return None

    def _put(self, entry: Entry) -> None:
        self._index.runs[entry.name] = entry
        self._save()

    def _save(self) -> None:
        suite_index.save(self._root, self._index)
        self._unsaved = False


def _anew(decision: Decision) -> Decision:
    """What becomes of a run that another host has had meanwhile."""
    return msgspec.structs.replace(decision, kind="restart", attempt=decision.attempt + 1)


async def look(run: SuiteRun, root: Path, started_in: Path, index: Index, operations: Operations) -> Found:
    """What there is of a run."""
    folder = run.folder(root)
    status: str | None = None
    with contextlib.suppress(OSError, EvopolicyError):
        status = suite_index.state_of(decode_run_record(folder.run_json.read_bytes()))
    opened = status is None and folder.opened.exists() and folder.credentials.exists()
    phase: str | None = None
    has_session = False
    if opened:
        identity = saved(folder.opened, OpenedRun).run
        phase = await operations.phase(identity)
        resumable = harnesses.make(run.harness, started_in, run.config).resumable
        has_session = resumable and session.load(folder.session).session is not None
    return Found(
        entry=index.runs.get(run.name), status=status, opened=opened, phase=phase, has_session=has_session
    )
