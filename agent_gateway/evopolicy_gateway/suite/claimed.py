"""A suite's sweep on this host: renews the claims on the runs that it plays, and keeps the index up to date.

Rules, in addition to those of every sweep:

- A run is played only while this host holds its claim at the coordinator. If another host has taken the claim, the run
  ends here and its folder stays unchanged. A host that takes a claim cancels the run that an earlier holder played for
  it.
- A coordinator that was started anew, perhaps on an earlier backup, is told all results of this host again.
- Cancelled, the sweep leaves runs open and keeps its claims: the same host can resume them, and others can take them
  over once the claims expire.
- A provider that is away also holds back further runs of that provider; running ones wait by themselves.
- A used-up cap holds back all further runs, and leaves those of coding agents open as a cancelled sweep does.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from evopolicy_common.errors import EvopolicyError, StorageError
from evopolicy_common.local.cluster import unless_failed
from evopolicy_common.messages.operator import Claim, ClaimState
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.suite_folder import FINISHED, INDEX, PAUSED, Index, SweepRun
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.harnesses.coding_agents import session
from evopolicy_gateway.processes.child_messages import AgentDoing
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.suite import suite_index, sweep
from evopolicy_gateway.suite.decisions import Decision, Facts
from evopolicy_gateway.suite.suite_file import SuiteFile
from evopolicy_gateway.suite.suite_view import SuiteView
from evopolicy_gateway.suite.sweep import Sweep

_ASK_AGAIN_S = 5.0
ATTEMPTS = ".attempts"
HOLDER = ".holder"
"""File with the random name of a sweep's folder, which tells hosts of equal names apart."""
_ID_LENGTH = 64


class ClaimedSweep(Sweep):
    """Plays a suite's decisions together with the other hosts of the sweep."""

    leaves = "all"

    def __init__(
        self, suite: SuiteFile, root: Path, index: Index, *known: *tuple[Operations, Credentials, SuiteView]
    ) -> None:
        """`known`: the further arguments of `Sweep`."""
        super().__init__(suite.parallel, index, *known)
        self._suite = suite
        self._view = known[-1]
        self._root = root.absolute()
        self._host = socket.gethostname()
        # A host is a machine and a folder: two sweeps of one machine in different folders are two hosts, and so are
        # folders of one path on machines of one name.
        self._holder = f"{self._host}:{_id_of(self._root)}"
        self._not_before: dict[str, float] = {}
        self._paused_until: dict[str, float] = {}
        self._ending: set[str] = set()
        """Cancelled runs that have not ended yet."""
        self._unsaved = False
        self._coordinator = self._told = ""
        """The coordinator's process, as its last reply named it, and the one that was told all results of this host."""
        self._view.on_doing = self._on_doing

    async def play_runs(self, decisions: Sequence[Decision]) -> None:
        self._decided = {one.run.name: one for one in decisions}
        await self._tell_results()
        renewing = asyncio.create_task(self._renew())
        try:
            # Unrenewed claims would pass to another host while their runs continue here.
            await unless_failed(asyncio.create_task(super().play_runs(decisions)), renewing)
        finally:
            renewing.cancel()
            await asyncio.gather(renewing, return_exceptions=True)
            self._save()

    def _startable(self) -> list[Decision]:
        """As in `Sweep`; empty while the sweep is paused."""
        paused = (self._root / PAUSED).exists()
        if self._view.is_new("", "paused", paused) and paused:
            self._view.say(f"paused: no further run begins while {self._root / PAUSED} is there")
        return [] if paused else super()._startable()

    def _given_up(self) -> bool:
        if (why := self._used_up()) is not None:
            self._view.say(f"{len(self._todo)} runs are left as they are: {why}")
        return why is not None

    def _may_begin(self, run: Plan) -> bool:
        waits_until = max(self._not_before.get(run.name, 0.0), self._paused_until.get(run.provider, 0.0))
        return waits_until <= time.monotonic() and self._used_up() is None

    async def _wait(self, active: list[asyncio.Task[None]]) -> None:
        """As in `Sweep`; once a cap is used up, first interrupts the runs that still use tokens."""
        why = self._used_up()
        for name, task in self._active.items() if why is not None else ():
            play = self._plays.get(name)
            if self._decided[name].run.config is not None and play is not None and play.agent_at_work:
                self._end(name, task, f"interrupted: {why}; it can be resumed once the cap is raised")
        await super()._wait(active)

    def _end(self, name: str, task: asyncio.Task[None], why: str) -> None:
        """Ends a run here and leaves it open; only once, since a second cancellation would abort its shutdown."""
        if name not in self._ending:
            self._ending.add(name)
            self._view.note(name, why)
            task.cancel()

    def _ended(self, name: str, task: asyncio.Task[None]) -> None:
        self._ending.discard(name)
        if not task.cancelled():
            task.result()
            return
        # Another host has the run, and its result is requested later; or a cap is used up.
        self._not_before[name] = time.monotonic() + _ASK_AGAIN_S
        self._view.waits(name)
        self._todo.append(self._decided[name])

    async def _begin(self, decision: Decision) -> bool:
        """Claims the run and starts it; False when another host currently holds it."""
        run = decision.run
        claim = await self._ask(run)
        if claim.result is not None:
            entry = msgspec.convert(claim.result | {"directory": ""}, SweepRun)
            self._put(entry)
            self._view.finished(run.name, entry)
            return True
        if not claim.granted:
            self._not_before[run.name] = time.monotonic() + _ASK_AGAIN_S
            self._view.elsewhere(run.name, self._named(claim.holder))
            return False
        others = bool(claim.run) and claim.run != _opened(run)
        if others:
            with contextlib.suppress(EvopolicyError):
                await self._operations.cancel(claim.run)
        if claim.previous:
            self._view.note(run.name, f"taken over from {self._named(claim.previous)}")
        if decision.kind in ("resume", "finish"):
            taken = bool(claim.previous) or (others and not claim.kept)
            # A folder with the request alone gets its run when it resumes, from the coordinator or anew.
            if taken or (run.folder.run and await self._operations.phase_of(run.folder) is None):
                decision = self._anew(run.name)
        elif claim.previous:
            decision = self._anew(run.name)
        return await super()._begin(decision)

    def _begun(self, decision: Decision) -> SweepRun:
        settings = msgspec.to_builtins(decision.run.defining)
        tokens, earlier = self._used_before(decision)
        begun = super()._begun(decision)
        return replace(begun, host=self._host, settings=settings, tokens=tokens, earlier=earlier)

    async def _play(self, decision: Decision) -> None:
        await super()._play(decision)
        entry = self._index.runs[decision.run.name]
        self._view.finished(entry.name, entry)
        result = msgspec.to_builtins(entry) if entry.state in FINISHED else None
        await self._ask(decision.run, None if result else 0.0, result)

    async def _record(self, decision: Decision, begun: SweepRun) -> SweepRun:
        run = decision.run
        if decision.kind == "finish":
            await self._check_held(run, "another host has it now: its files are not written here")
        self._view.started(run.name, decision.attempt)
        settings = replace(run.settings, attempt=decision.attempt)
        is_new = decision.kind in ("restart", "new")
        aside = partial(self._put_aside, run.folder, decision.attempt - 1) if is_new else None
        plan = replace(run, settings=settings, overwrite=is_new)
        record = await self._played(decision, plan, aside)
        if record.outcome.status == "cancelled":
            await self._check_held(run, "another host has it now and has cancelled it here")
        entry = replace(suite_index.entry_of(run, record), host=self._host, run=self._run_of(run))
        return replace(entry, settings=begun.settings, earlier=begun.earlier)

    async def _check_held(self, run: Plan, otherwise: str) -> None:
        """Ends the run here, with a note, if another host has taken its claim."""
        claim = await self._ask(run)
        if claim.result is not None or not claim.granted:
            self._view.note(run.name, otherwise)
            self._anew(run.name)
            raise asyncio.CancelledError

    async def _renew(self) -> None:
        """Renews the claims of active runs, and reports soon which run of the cluster belongs to each."""
        every_s = self._limits.claim_ttl_s / 4
        renewed: dict[str, tuple[str, float]] = {}
        while True:
            await asyncio.sleep(min(sweep.POLL_S, every_s))
            if self._unsaved:
                self._save()
            if self._coordinator != self._told:
                await self._tell_results()
            for name, task in list(self._active.items()):
                run = self._decided[name].run
                known, at = renewed.get(name, ("", 0.0))
                fresh = self._run_of(run) == known and time.monotonic() - at < every_s
                if fresh or name in self._ending:
                    continue
                with contextlib.suppress(EvopolicyError):
                    renewed[name] = (self._run_of(run), time.monotonic())
                    claim = await self._ask(run)
                    if not claim.granted and claim.holder != self._holder and not task.done():
                        # That host has cancelled our run at the cluster, if it knew of it.
                        await self._operations.cancel(self._run_of(run))
                        self._anew(name)
                        self._end(
                            name, task, f"another host has it now ({self._named(claim.holder)}): ended here"
                        )

    async def _ask(
        self, run: Plan, ttl_s: float | None = None, result: dict[str, object] | None = None
    ) -> ClaimState:
        # By its digest, a run with other settings is another run, and an earlier result does not count for it.
        name, holder, ours = f"{run.name}@{run.digest}", self._holder, self._run_of(run)
        ttl_s = self._limits.claim_ttl_s if ttl_s is None else ttl_s
        wanted = Claim(suite=self._suite.name, name=name, holder=holder, ttl_s=ttl_s, run=ours, result=result)
        claim = await self._operations.claim(wanted)
        self._coordinator = claim.coordinator
        self._told = self._told or claim.coordinator
        return claim

    async def _tell_results(self) -> None:
        """Settles the claims of this host's finished runs again, and ends what a restored coordinator has of them."""
        told = self._coordinator
        for name, entry in list(self._index.runs.items()):
            decision = self._decided.get(name)
            ours = entry.state in FINISHED and entry.directory and name not in self._active
            if decision is None or not ours or entry.digest != decision.run.digest:
                continue
            with contextlib.suppress(EvopolicyError):
                claim = await self._ask(decision.run, None, msgspec.to_builtins(entry))
                if claim.granted and claim.run not in ("", entry.run):
                    await self._operations.cancel(claim.run)
                await self._operations.end_lost(entry.run)
        self._told = told or self._told

    def _put_aside(self, folder: RunFolder, attempt: int) -> None:
        """Keeps the files of an earlier attempt."""
        if not folder.root.exists():
            return
        kept = self._root / ATTEMPTS / folder.root.relative_to(self._root)
        target = kept.with_name(f"{kept.name}.{max(attempt, 1)}")
        while target.exists():
            target = target.with_name(f"{target.name}+")
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_tree(folder.state)
        folder.root.rename(target)

    def _anew(self, name: str) -> Decision:
        """The new decision for a run that another host has taken over meanwhile: a restart as a new attempt."""
        before = self._decided[name]
        self._decided[name] = replace(before, kind="restart", attempt=before.attempt + 1)
        return self._decided[name]

    def _named(self, holder: str) -> str:
        """A host's name for people."""
        host = holder.partition(":")[0]
        return f"another folder or machine of the name {host}" if host == self._host else host

    def _run_of(self, run: Plan) -> str:
        play = self._plays.get(run.name)
        return "" if play is None else play.run

    def _used_before(self, decision: Decision) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
        """Tokens used before: by the resumed run itself, and by its earlier attempts."""
        entry = self._index.runs.get(decision.run.name)
        if entry is None:
            return None, None
        if decision.kind in ("resume", "finish"):
            return entry.tokens, entry.earlier
        return None, suite_index.added(entry.earlier, entry.tokens)

    def _on_doing(self, name: str, doing: AgentDoing) -> None:
        entry = self._index.runs.get(name)
        if entry is not None and doing.tokens is not None:
            # Saved with the next renewal: a stream may report tokens many times a second.
            self._index.runs[name] = replace(entry, tokens=doing.tokens)
            self._unsaved = True
        if doing.provider:
            self._paused_until[doing.provider] = time.monotonic() + doing.paused_s

    def _used_up(self) -> str | None:
        caps = self._suite.caps
        tokens, cost, requests = suite_index.used(self._index)
        for used, most, form in (
            (requests, caps.max_requests, "{} of {} requests are made"),
            (tokens, caps.max_tokens, "{} of {} tokens are used"),
            (cost, caps.max_cost, "{:.2f} of {:.2f} dollars are spent"),
        ):
            if most is not None and used >= most:
                return form.format(used, most)
        return None

    def _put(self, entry: SweepRun) -> None:
        super()._put(entry)
        self._save()

    def _save(self) -> None:
        """Saves the index. Runs and claims continue when the disk refuses: the next start reads each `run.json`."""
        try:
            suite_index.save(self._root, self._index)
        except (StorageError, OSError) as error:
            if self._view.is_new("", "unwritable", str(error)):
                self._view.say(f"{INDEX} is not up to date, and is written again later: {error}")
            self._unsaved = True
        else:
            self._view.is_new("", "unwritable", "")
            self._unsaved = False


def _id_of(root: Path) -> str:
    """The name of a sweep's folder, made on first use."""
    path = root / HOLDER
    if not path.exists():
        root.mkdir(parents=True, exist_ok=True)
        write_atomically(path, secrets.token_hex(6).encode())
    return path.read_text()[:_ID_LENGTH]


def _opened(run: Plan) -> str:
    """The cluster's id of the run in the run's folder; empty for none."""
    with contextlib.suppress(OSError, EvopolicyError):
        return run.folder.run or read_record(run.folder.root).run
    return ""


async def facts_of(run: Plan, index: Index, operations: Operations) -> Facts:
    """Collects the known facts about a run. Raises ConfigError when its folder holds another's."""
    run.check_owner()
    folder, entry = run.folder, index.runs.get(run.name)
    with contextlib.suppress(OSError, EvopolicyError):
        return Facts(entry=entry, status=suite_index.state_of(read_record(folder.root)))
    if folder.run and folder.credentials.exists():
        phase = await operations.phase(folder.run)
        harness = run.harness()
        has_session = harness.continues or (
            harness.resumable and session.load(folder.session).session is not None
        )
        closing = folder.closing.exists()
        return Facts(entry=entry, opened=True, phase=phase, closing=closing, has_session=has_session)
    intended = run.intended()
    settings = replace(run.settings, attempt=1 if entry is None else entry.attempt)
    return Facts(entry=entry, intended=intended is not None and intended.settings == settings)
