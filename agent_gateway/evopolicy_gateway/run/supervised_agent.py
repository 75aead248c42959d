"""The run's agent below its supervisor, a child process: both are started again when the supervisor dies."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import msgspec

from evopolicy_common.records.run_record import AgentLimits
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.jail.jail import JailOrder
from evopolicy_gateway.processes import child_messages, child_rpc
from evopolicy_gateway.processes.child_messages import AgentEnded, Order, Ready, StartAgent, SubmitsSeen
from evopolicy_gateway.processes.child_rpc import Child
from evopolicy_gateway.run.model_relay import ModelRelay
from evopolicy_gateway.run.open_run import OpenRun
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.workspace import staging as workspace

_MAX_SUPERVISOR_DEATHS = 5
_SURVIVORS_PAUSE_S = 1.0
_ENDLESS = 1 << 62
"""Bytes that a remote agent's workspace may take: its files may be elsewhere, and are its operator's."""


class SupervisedAgent:
    """The agent of one run, over all its supervisors."""

    def __init__(self, run: OpenRun, gateway: Credentials) -> None:
        """`gateway`: credentials whose files the jail hides."""
        self._run = run
        self._credentials = gateway
        self.survivors: list[int] = []
        """Process ids of the agent that survive being killed."""
        self._submits = SubmitsSeen(asked=0, running=False)
        """As last reported by the gateway."""
        self._held_before = 0.0
        """`held_s` of the run when the supervisor was started."""
        self._child: Child | None = None

    @property
    def has_begun(self) -> bool:
        return self._child is not None

    async def keep(self, ready: Ready, relay: ModelRelay | None, spent: asyncio.Event) -> AgentEnded:
        """Runs the agent to its end. An agent whose supervisor dies, our failure, resumes its session if it has one,
        else begins anew in its workspace, unless the budget is `spent`."""
        for _ in range(_MAX_SUPERVISOR_DEATHS):
            ended = await self._keep_once(ready, relay)
            if ended is not None:
                return ended
            if spent.is_set():
                break
            self._run.note("the agent's supervisor died; starting it again, and the agent with it")
        known = self._run.plan.harness().known()
        return AgentEnded(reason="agent_failed", detail="its agent supervisor died", facts=known)

    async def tell(self, order: Order) -> None:
        if self._child is not None:
            await self._child.tell(order)

    async def note_held(self, held_s: float) -> None:
        """Gives time for which submits waited for hidden episodes back to the agent's clock; `held_s` of the run."""
        await self.tell(child_messages.HeldTime(seconds=held_s - self._held_before))

    async def note_submits(self, submits: SubmitsSeen) -> None:
        self._submits = submits
        await self.tell(submits)

    async def end(self, grace_s: float) -> None:
        """Ends the supervisor, which ends its agent."""
        if self._child is not None:
            await self._child.end(grace_s)

    def tell_survivors(self) -> None:
        """Prints which processes of the agent survive."""
        pids = ", ".join(map(str, self.survivors))
        self._run.note(
            f"processes of the agent survive being killed ({pids}): the run stays open, and no hidden case"
            " that it shares is played on this machine, before they are gone"
        )

    async def _keep_once(self, ready: Ready, relay: ModelRelay | None) -> AgentEnded | None:
        """Returns how the agent ended; None when its supervisor died."""
        run, plan = self._run, self._run.plan
        run.stopwatch.begins("agent")
        self._held_before = run.stopwatch.times.held_s
        program = [sys.executable, "-P", "-m", "evopolicy_gateway.agent_supervisor.supervisor"]
        self._child = await Child.start(program, run.folder.harness_log, talks=True)
        await self._child.tell(self._start_order(ready, relay))
        await self._child.tell(self._submits)
        ended: AgentEnded | None = None
        async for event in self._child.events():
            match event:
                case child_messages.AgentTurn():
                    run.watch.turn(plan.name, event.turn, event.text)
                case child_messages.AgentDoing():
                    if relay is not None:
                        event = msgspec.structs.replace(event, tokens=None)  # the relay's count is the run's
                    run.watch.doing(plan.name, event)
                case child_messages.AgentUsed():
                    resources = event.resources if plan.listener is None else None
                    run.stopwatch.reported("agent", agent_s=event.used_s, resources=resources)
                case child_messages.AgentSurvives():
                    self.survivors = list(event.pids)
                    self.tell_survivors()
                case AgentEnded():
                    ended = event
        await self._child.ended()
        # Processes left behind by a supervisor that died have become our children.
        while survivors := await child_rpc.end_orphans():
            if survivors != self.survivors:
                self.survivors = survivors
                self.tell_survivors()
            await asyncio.sleep(_SURVIVORS_PAUSE_S)
        self.survivors = []
        return ended

    def _start_order(self, ready: Ready, relay: ModelRelay | None) -> StartAgent:
        plan, folder, config = self._run.plan, self._run.folder, self._run.plan.agent_config
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
        return StartAgent(
            agent=plan.agent,
            workspace=str(folder.workspace),
            agent_log=str(folder.agent_log),
            urls=ready.variables,
            variables=workspace.variables(shown),
            started_in=str(plan.started_in),
            wall_limit_s=max(1.0, plan.wall_limit_s - self._run.stopwatch.times.agent_s),
            silence_s=plan.silence_s,
            prompts=msgspec.to_builtins(plan.texts.prompts),
            inputs=plan.texts.inputs,
            config=None if config is None else msgspec.to_builtins(config),
            model_url="" if relay is None else relay.url,
            model_token="" if relay is None else relay.token,
            session_file=str(folder.session),
            passed_file=str(folder.passed),
            lock=str(folder.supervisor_lock),
            jail=jail,
            limits=plan.limits if plan.listener is None else AgentLimits(disk_bytes=_ENDLESS),
        )

    def _hidden(self) -> tuple[str, ...]:
        """Folders that the jail never shows: the runs, and the states of the clusters."""
        known = self._credentials
        sockets = [endpoint.partition("/") for endpoint in known.endpoints]
        states = [str(Path(path).parent.resolve()) for kind, _, path in sockets if kind == "unixsock-stream"]
        if known.tls is not None:
            states.append(str(Path(known.tls.private_key).parent))
        return (str(self._run.plan.runs.absolute()), str(credentials.default_state_dir()), *states)
