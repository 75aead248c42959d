"""One run from its opening to `run.json`, in the operator's process: the phases of `PHASES` in order.

| phase   | does                                        | ends by                  | durable before the next |
|---------|---------------------------------------------|--------------------------|-------------------------|
| `claim` | empties the folder; opens the run first     | a refusal: the earlier   | `intended.json`: the    |
|         | where an earlier one would be lost          | run stays                | request and its key     |
| `open`  | opens the run, or finds it again by its key | a refusal: a new folder  | `intended.json`: the    |
|         |                                             | is removed               | run; its capability     |
| `agent` | keeps gateway, relay and agent alive until  | the agent, its budget,   | the closed run, at the  |
|         | the gateway has closed the run              | its limits, cancellation | coordinator             |
| `score` | waits for the scores of the hidden cases,   | the run's result         | the result, at the      |
|         | which only this process receives            |                          | coordinator             |
| `write` | writes the finished run's files             | a disk or folder that    | `run.json`, in place of |
|         |                                             | refuses                  | the gateway's folder    |

A command that resumes a run begins at the first phase whose result is not durable. The permit begins before
the agent, and ends with the closing of the run, after the agent and all that it started. `agent_side.py` plays
the phase `agent`: a gateway that dies is restarted on the same port while the agent continues; an agent
supervisor that dies is restarted with its agent. When this process is killed, its children end.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import uuid
from collections.abc import Callable
from typing import Literal

import msgspec

from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.messages.operator import CreateRun, RunFinished
from evopolicy_common.processes import child_process
from evopolicy_common.processes.left_files import keep_to_owner
from evopolicy_common.processes.preflight import LOOPBACK
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.http.server import Address
from evopolicy_gateway.processes.child_messages import Ready
from evopolicy_gateway.run import record
from evopolicy_gateway.run.agent_side import AgentSide
from evopolicy_gateway.run.children import RunContext
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run.plan import Plan, find_start, stage_start
from evopolicy_gateway.run.times import Stopwatch
from evopolicy_gateway.run.watch import RunsView
from evopolicy_gateway.run_folder.layout import save, saved
from evopolicy_gateway.run_folder.listener import agent_place
from evopolicy_gateway.run_folder.locks import alone

Leaves = Literal["nothing", "ended", "all"]
"""The runs that a cancelled command leaves to be resumed: `ended`, those whose agent has ended."""
GIVE_UP_TIMEOUT_S = 10.0
"""Limit for reporting a given-up run to the coordinator, whose failure may be the reason for giving up."""


class RunLifecycle:
    """Plays one plan, once."""

    def __init__(
        self,
        plan: Plan,
        operations: Operations,
        gateway: Credentials,
        watch: RunsView,
        leaves: Leaves = "nothing",
        on_agent_gone: Callable[[], None] = lambda: None,
    ) -> None:
        """`gateway`: credentials of the gateway role, without a run's capability.

        `leaves`: whether cancelling this leaves the run to be resumed. `on_agent_gone` is called once the
        agent's side is over; the rest of the run needs no slot for an agent.
        """
        self._plan = plan
        self._folder = plan.folder
        self._operations = operations
        self._credentials = gateway
        self._watch = watch
        self._leaves = leaves
        self._on_agent_gone = on_agent_gone
        self.run = ""
        """The cluster's id of the run, once it is open."""
        self.served: asyncio.Future[Ready] = asyncio.get_running_loop().create_future()
        """Done when the gateway serves the agent for the first time."""
        self._new = False
        """Whether this command claims the folder."""
        self._put_aside: Callable[[], None] | None = None
        self._stopwatch: Stopwatch
        """Set when the run is open: the folder is new then, or holds the times of earlier commands."""
        self._side: AgentSide | None = None
        """Set when the run is open."""
        self._finished: RunFinished | None = None
        self._record: RunRecord

    @property
    def agent_at_work(self) -> bool:
        """Whether the agent has begun, and the run's closing was not requested yet."""
        return self._side is not None and self._side.agent_at_work

    async def play_run(self, put_aside: Callable[[], None] | None = None) -> RunRecord:
        """Plays the run to `run.json`, also when this is cancelled, which cancels it. Raises EvopolicyError.

        `put_aside` moves the folder's earlier run away, which is deleted without it; a refused run leaves it.
        """
        self._new, self._put_aside = True, put_aside
        with alone(self._folder.lock, self._folder.root):
            return await self._run_phases()

    async def go_on(self) -> RunRecord:
        """Plays a new run, resumes an open one, or returns a finished one's record: as the folder has it."""
        with alone(self._folder.lock, self._folder.root):
            if not self._folder.run_json.exists():
                return await self._run_phases()
            # The command may have been killed before it removed the gateway's folder.
            remove_tree(self._folder.state)
            done, how = read_record(self._folder.root), "it is finished, and this is its result"
            if await self._operations.end_lost(done.run) != "finished":
                how += (
                    f"; the cluster has no result of run {done.run}, so that nothing of it can be verified or"
                    " re-scored there (another cluster played it, or the state is of an earlier backup); --overwrite"
                    " plays it anew"
                )
            self._note(how)
            return done

    async def _run_phases(self) -> RunRecord:
        for phase, leave in PHASES:
            try:
                await phase(self)
            except BaseException as error:
                await leave(self, error)
                raise
        return self._record

    # The phases.

    async def _claim(self) -> None:
        plan, folder = self._plan, self._folder
        if not self._new and folder.intended.exists():
            return
        self._new = True
        # Checking starts programs that try the jail, which another run's search would take for orphans.
        async with child_process.starting():
            plan.check_held()
        replays = plan.replays
        wanted = CreateRun(
            key=uuid.uuid4().hex,
            settings=plan.settings,
            replay_key="" if replays is None else replays.key,
        )
        if folder.root.exists() or folder.asked.exists():
            wanted = await self._ask(wanted)
        await self._operations.drop(folder)
        if self._put_aside is not None:
            self._put_aside()
        async with child_process.starting():
            plan.claim()
        folder.state.mkdir(mode=0o700)
        if plan.start_from:
            await asyncio.to_thread(stage_start, find_start(plan.start_from, plan.started_in), folder)
        save(folder.intended, wanted)
        folder.asked.unlink(missing_ok=True)
        if replays is not None:
            save(folder.service, Address(host=LOOPBACK, port=replays.port, token=replays.token))
        if plan.listener is not None:
            save(folder.listener, plan.listener)

    async def _ask(self, wanted: CreateRun) -> CreateRun:
        """Opens the run and returns the request for it while the folder has its earlier run, which a refusal keeps.

        The request is kept beside the folder, so that a command that is killed meanwhile finds the run again.
        """
        folder = self._folder
        if folder.asked.exists():
            before = saved(folder.asked, CreateRun)
            if before.settings == wanted.settings:
                wanted = before
            else:
                with contextlib.suppress(EvopolicyError):
                    await self._operations.cancel((await self._operations.create(before)).run)
        save(folder.asked, wanted)
        try:
            self.run = (await self._operations.create(wanted)).run
        except EvopolicyError:
            folder.asked.unlink()
            raise
        return wanted

    async def _withdraw(self, error: BaseException) -> None:
        if self.run:
            with contextlib.suppress(EvopolicyError):
                await self._operations.cancel(self.run)
            self._folder.asked.unlink(missing_ok=True)
            self.run = ""

    async def _open(self) -> None:
        folder = self._folder
        wanted = saved(folder.intended, CreateRun)
        if wanted.run:
            self.run, token = wanted.run, credentials.read_credentials(folder.credentials).token
        else:
            created = await self._operations.create(wanted)
            self.run, token = created.run, created.capability
        credentials.write(msgspec.structs.replace(self._credentials, token=token), folder.credentials)
        phase: str | None = "open"
        if wanted.run:
            phase = await self._operations.phase_of(folder)
            if phase is None:
                raise ConfigError(
                    f"the cluster does not know run {self.run} of {folder.root}, and cannot open it again: give the"
                    " cluster that it was opened on, or --overwrite to play it anew"
                )
            self._note(f"resumes run {self.run} in {folder.root}")
        else:
            if text := self._plan.texts.agents_md:
                write_atomically(folder.given_agents_md, text.encode(), mode=0o600)
            save(folder.intended, msgspec.structs.replace(wanted, run=self.run))
            self._note(f"run {self.run} in {folder.root}")
        self._operations.watched_by(self.run, (folder.lock, folder.supervisor_lock))
        self._stopwatch = Stopwatch(folder.times)
        opened = RunContext(
            plan=self._plan,
            run=self.run,
            stopwatch=self._stopwatch,
            watch=self._watch,
            operations=self._operations,
            gateway=self._credentials,
            served=self.served,
        )
        self._side = AgentSide(opened, closed=phase != "open")

    async def _remove_new(self, error: BaseException) -> None:
        if self._new:
            remove_tree(self._folder.root)

    async def _agent(self) -> None:
        assert self._side is not None
        await self._side.play_agent()
        if self._side.cancelled:
            await self._tell_gone()
        self._on_agent_gone()

    async def _score(self) -> None:
        async for progress in self._operations.wait(self.run):
            if progress.phase == "open" and self._side is not None and self._side.closed:
                # The coordinator was started on a backup from before the closing.
                await self._side.close_again()
            self._watch.phase(self._plan.name, progress)
        self._finished = progress.finished

    async def _write(self, why: str | None = None) -> None:
        assert self._finished is not None
        root, times = self._folder.root, self._stopwatch.times
        if refused := await asyncio.to_thread(keep_to_owner, root):
            how = f"as root: chown -R {os.getuid()} {root}; chmod -R a-s,o-w {root}"
            kept = "files and folders that the agent left belong to other users and keep their modes"
            self._note(f"{refused} {kept}; {how}")
        known = (self._folder, self._plan, self._finished, self._operations)
        self._record = await record.write(*known, times, self._note, why)

    async def _leave(self, error: BaseException) -> None:
        """Prints how the open run can be continued, or gives it up."""
        side = self._side
        assert side is not None
        if side.agent.survivors:
            side.agent.tell_survivors()
            self._note(
                f"when they are gone, continue with --resume, or run: evopolicy runs agent-gone {self.run}"
            )
        elif self._finished is not None or (
            side.closed and (self._leaves != "nothing" or isinstance(error, Exception))
        ):
            how = f"--resume --exp-id {self._plan.settings.exp_id}, or the suite's command again,"
            self._note(f"its agent has ended: {how} completes the run without starting it")
        elif self._leaves == "all" and isinstance(error, asyncio.CancelledError):
            await self._tell_gone()
        else:
            interrupted = record.INTERRUPTED if isinstance(error, asyncio.CancelledError) else None
            await self._give_up(str(error) if isinstance(error, EvopolicyError) else interrupted)

    async def _give_up(self, why: str | None) -> None:
        """Cancels the run at the coordinator, so that no more is played, and records it in `run.json`."""
        with contextlib.suppress(EvopolicyError, OSError, TimeoutError):
            async with asyncio.timeout(GIVE_UP_TIMEOUT_S):
                await self._operations.cancel(self.run)
                await self._tell_gone()
                await self._score()
                await self._write(why)

    async def _tell_gone(self) -> None:
        """Reports to the coordinator that an open run's agent is gone; resuming the run needs a new permit."""
        if self._plan.listener is not None:
            return  # this machine does not know about a remote agent
        with contextlib.suppress(EvopolicyError, TimeoutError):
            async with asyncio.timeout(GIVE_UP_TIMEOUT_S):
                # Only for this machine: the run may have been resumed elsewhere before this arrives.
                await self._operations.agent_gone(self.run, agent_place(self._folder).boot_id)

    def _note(self, text: str) -> None:
        self._watch.note(self._plan.name, text)


PHASES = (
    (RunLifecycle._claim, RunLifecycle._withdraw),
    (RunLifecycle._open, RunLifecycle._remove_new),
    (RunLifecycle._agent, RunLifecycle._leave),
    (RunLifecycle._score, RunLifecycle._leave),
    (RunLifecycle._write, RunLifecycle._leave),
)
"""Each phase, which returns at once if its result is durable, and the handler of its errors."""
