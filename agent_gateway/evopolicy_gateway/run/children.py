"""The gateway and the supervised agent of an open run: child processes, each of which is started again when it dies."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec

from evopolicy_common.errors import EvopolicyError, StorageError
from evopolicy_common.processes import child_process, proc
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_record import AgentLimits
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.jail.jail import JailOrder
from evopolicy_gateway.processes import child_messages as messages
from evopolicy_gateway.processes.child_messages import AgentEnded, Child, Ready, RelayAddress, TrainProgress
from evopolicy_gateway.relay.limits import read_ledger
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.times import Stopwatch, Times
from evopolicy_gateway.run.watch import RunsView
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.run_folder.listener import TOKEN_VARIABLE, place_notice
from evopolicy_gateway.workspace import staging as workspace


class RunContext(msgspec.Struct, frozen=True, kw_only=True):
    plan: Plan
    run: str
    """Its id at the cluster."""
    stopwatch: Stopwatch
    watch: RunsView
    operations: Operations
    gateway: Credentials
    """Of the gateway's role; the jail hides their files."""
    served: asyncio.Future[Ready]
    """Gets its result when the gateway serves the agent for the first time."""

    @property
    def folder(self) -> RunFolder:
        return self.plan.folder

    def note(self, text: str) -> None:
        self.watch.note(self.plan.name, text)


_QUICK_DEATH_S = 5.0
_MAX_QUICK_DEATHS = 5
_USAGE_ERROR = 2


class RestartedChild:
    """A part of an open run, over all its processes, of which one is alive at a time."""

    def __init__(self, run: RunContext) -> None:
        self._run = run
        self._child: Child | None = None

    async def tell(self, order: messages.ToChild) -> None:
        """Sends an order to the present process, if there is one."""
        if self._child is not None:
            await self._child.tell(order)

    async def end(self, grace_s: float) -> None:
        """Ends the process; an agent's supervisor ends its agent."""
        if self._child is not None:
            await self._child.end(grace_s)

    async def _start(self, module: str, *arguments: str) -> Child:
        program = [sys.executable, "-P", "-m", module, *arguments]
        self._child = await Child.start(program, self._run.folder.harness_log, talks=True)
        return self._child


class GatewayProcess(RestartedChild):
    def __init__(self, run: RunContext, on_progress: Callable[[TrainProgress], Awaitable[None]]) -> None:
        super().__init__(run)
        self._on_progress = on_progress
        self.closed = False
        """Whether the coordinator has closed the run."""
        self._close: messages.CloseGateway | None = None

    @property
    def is_closing(self) -> bool:
        """Whether the run is closed, or its closing was requested."""
        return self._close is not None or self.closed

    async def keep(self) -> None:
        """Runs the gateway until it has closed the run. Raises EvopolicyError when it cannot serve."""
        run, log = self._run, self._run.folder.harness_log
        quick_deaths = 0
        while True:
            started = time.monotonic()
            run.stopwatch.begins("gateway")
            child = await self._start("evopolicy_gateway.cli.serve", str(run.folder.root))
            async for event in child.events():
                await self._on_event(event)
            code = await child.ended()
            if code == 0:
                self.closed = True
                return
            quick_deaths = quick_deaths + 1 if time.monotonic() - started < _QUICK_DEATH_S else 0
            if code == _USAGE_ERROR or quick_deaths > _MAX_QUICK_DEATHS:
                words = child_process.last_words(log)
                raise EvopolicyError(f"the gateway cannot serve (exit status {code}): {words}; see {log}")
            run.note(f"the gateway ended with status {code}; starting it again")
            await asyncio.sleep(0.1 * 2**quick_deaths)

    async def close(self, order: messages.CloseGateway) -> None:
        self._close = order
        await self.tell(order)

    async def _on_event(self, event: object) -> None:
        run = self._run
        match event:
            case messages.Waits():
                run.watch.run_held(run.plan.name, event.waits_for)
            case Ready():
                run.stopwatch.held_reported(event.held_s, event.permit_s)
                if not run.served.done():
                    for text in (*event.notes, *_place_notes(run, event)):
                        run.note(text)
                    run.served.set_result(event)
                if self._close is not None:
                    await self.close(self._close)
            case TrainProgress():
                await self._on_progress(event)


def _place_notes(run: RunContext, ready: Ready) -> list[str]:
    """Facts about the agent's place: for a remote agent, those that the operator passes on to it."""
    if run.plan.listener is None:
        until = "until then no hidden case that this run shares is played while its agent lives"
        return [] if proc.boot_id() else [f"{proc.NO_BOOT_ID}; {until}"]
    return [
        place_notice(run.plan.settings.agent_host, run.folder.root),
        f"the agent is served at {ready.variables['EVOPOLICYGYM_SUBMIT_URL']}",
        f"its bearer token is in {run.folder.bearer}; it finds it in {TOKEN_VARIABLE}",
        f"its workspace is {run.folder.workspace}; the rules are in AGENTS.md there",
        f"when it is done before its budget is spent: evopolicy finish {run.folder.root}",
    ]


_MAX_SUPERVISOR_DEATHS = 5
_SURVIVORS_PAUSE_S = 1.0
_ENDLESS = 1 << 62
"""Bytes that a remote agent's workspace may take: its files may be elsewhere, and are its operator's."""


class SupervisedAgent(RestartedChild):
    """The agent of one run below its supervisor."""

    def __init__(self, run: RunContext) -> None:
        super().__init__(run)
        self._terms = run.plan.harness().model
        self.survivors: list[int] = []
        """Process ids of the agent that survive being killed."""
        self._submits = messages.SubmitsSeen(asked=0, running=False)
        """As last reported by the gateway, with the run's `held_s`."""
        self._held_before = 0.0
        """`held_s` of the run when the supervisor was started."""

    @property
    def has_begun(self) -> bool:
        return self._child is not None

    async def keep(self, ready: Ready, relay: RelayAddress | None, spent: asyncio.Event) -> AgentEnded:
        """Runs the agent to its end; again after its supervisor's death, unless the budget is `spent`."""
        for _ in range(_MAX_SUPERVISOR_DEATHS):
            ended = await self._keep_once(ready, relay)
            if ended is not None:
                return ended
            if spent.is_set():
                break
            self._run.note("the agent's supervisor died; starting it again, and the agent with it")
        known = self._run.plan.harness().known_facts()
        return AgentEnded(reason="agent_failed", detail="its agent supervisor died", facts=known)

    async def note_submits(self, submits: messages.SubmitsSeen) -> None:
        """Passes them on; the agent's clock gets back the time for which they waited for hidden episodes."""
        self._submits = submits
        held_s = max(0.0, submits.held_s - self._held_before)
        await self.tell(msgspec.structs.replace(submits, held_s=held_s))

    def tell_survivors(self) -> None:
        pids = ", ".join(map(str, self.survivors))
        self._run.note(
            f"processes of the agent survive being killed ({pids}): the run stays open, and no hidden case"
            " that it shares is played on this machine, before they are gone"
        )

    async def _keep_once(self, ready: Ready, relay: RelayAddress | None) -> AgentEnded | None:
        """Returns how the agent ended; None when its supervisor died."""
        run, plan = self._run, self._run.plan
        run.stopwatch.begins("agent")
        self._held_before = run.stopwatch.times.held_s
        child = await self._start("evopolicy_gateway.agent_supervisor.supervisor")
        await child.tell(self._start_order(ready, relay))
        await self.note_submits(self._submits)
        ended: AgentEnded | None = None
        async for event in child.events():
            match event:
                case messages.AgentTurn():
                    run.watch.turn(plan.name, event.turn, event.text)
                case messages.AgentDoing():
                    if relay is not None:
                        event = msgspec.structs.replace(event, tokens=None)  # the relay's count is the run's
                    run.watch.doing(plan.name, event)
                case messages.AgentUsed():
                    resources = event.resources if plan.listener is None else None
                    run.stopwatch.reported("agent", Times(agent_s=event.used_s, resources=resources))
                    if plan.settings.profile == "own":
                        self._keep_left()
                case messages.AgentSurvives():
                    self.survivors = list(event.pids)
                    self.tell_survivors()
                case AgentEnded():
                    ended = event
        await child.ended()
        # Processes that outlived their supervisor have become our children.
        while survivors := await messages.end_orphans():
            if survivors != self.survivors:
                self.survivors = survivors
                self.tell_survivors()
            await asyncio.sleep(_SURVIVORS_PAUSE_S)
        self.survivors = []
        return ended

    def _keep_left(self) -> None:
        """Writes what `/info` tells of the agent's limits. A full disk keeps the earlier values."""
        run, terms = self._run, self._terms
        left = {"wall_time_s": round(max(0.0, run.plan.wall_limit_s - run.stopwatch.times.agent_s))}
        if terms is not None and run.folder.model_requests.exists():
            used = read_ledger(run.folder.model_requests).usage.total
            left["model_tokens"] = max(0, terms.limits.max_tokens - used)
        with contextlib.suppress(StorageError):
            write_atomically(run.folder.left, msgspec.json.encode(left))

    def _start_order(self, ready: Ready, relay: RelayAddress | None) -> messages.StartAgent:
        plan, folder, config = self._run.plan, self._run.folder, self._run.plan.known_config
        # A replayed agent sees the recorded run's paths.
        shown = folder if plan.replays is None else RunFolder(plan.replays.root)
        jail = None
        if plan.jail.mode != "none":
            jail = JailOrder(
                settings=plan.jail,
                private=str(folder.agent),
                hidden=self._hidden(),
                shown="" if plan.replays is None else str(shown.workspace),
            )
        return messages.StartAgent(
            agent=plan.agent,
            folder=str(folder.root),
            urls=ready.variables,
            variables=workspace.variables(shown),
            started_in=str(plan.started_in),
            wall_limit_s=max(1.0, plan.wall_limit_s - self._run.stopwatch.times.agent_s),
            silence_s=plan.silence_s,
            tells_left=plan.settings.profile == "own",
            prompts=msgspec.to_builtins(plan.texts.prompts),
            inputs=plan.texts.inputs,
            config=None if config is None else msgspec.to_builtins(config),
            relay=relay,
            jail=jail,
            limits=plan.limits if plan.listener is None else AgentLimits(disk_bytes=_ENDLESS),
        )

    def _hidden(self) -> tuple[str, ...]:
        """Folders that the jail never shows: the runs, and the states of the clusters."""
        known = self._run.gateway
        hidden = [self._run.plan.runs.absolute(), credentials.default_state_dir()]
        sockets = [endpoint.partition("/") for endpoint in known.endpoints]
        hidden += [Path(path).parent.resolve() for kind, _, path in sockets if kind == "unixsock-stream"]
        if known.tls is not None:
            hidden.append(Path(known.tls.private_key).parent)
        return tuple(map(str, hidden))
