"""One run from its opening to `run.json`, in the operator's process: the phases of `PHASES` in order.

| phase   | does                                        | ends by                  | durable before the next |
|---------|---------------------------------------------|--------------------------|-------------------------|
| `claim` | empties the folder; opens the run first     | a refusal: the earlier   | `intended.json`: the    |
|         | where an earlier one would be lost          | run stays                | request and its key     |
| `open`  | opens the run, or finds it again by its key | a refusal: a new folder  | `run.json`: the run;    |
|         |                                             | is removed               | its capability          |
| `agent` | keeps gateway, relay and agent alive until  | the agent, its budget,   | the closed run, at the  |
|         | the gateway has closed the run              | its limits, cancellation | coordinator             |
| `score` | waits for the scores of the hidden cases,   | the run's result         | the result, at the      |
|         | which only this process receives            |                          | coordinator             |
| `write` | writes the finished run's files             | a disk or folder that    | `run.json`, in place of |
|         |                                             | refuses                  | the gateway's folder    |

A command that resumes a run begins at the first phase whose result is not durable. The permit begins before
the agent, and ends with the closing of the run, after the agent and all that it started. A gateway that dies
is restarted on the same port while the agent continues; an agent supervisor that dies, with its agent. When
this process is killed, its children end.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
import uuid
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from evopolicy_common.errors import BrokenEnvironmentError, ConfigError, EvopolicyError
from evopolicy_common.messages.gateway import CANCELLED
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.processes import child_process, host
from evopolicy_common.processes.left_files import keep_to_owner
from evopolicy_common.processes.notices import Waiting
from evopolicy_common.processes.preflight import LOOPBACK
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.open_run import IntendedRun, OpenedRun
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.run_record import AgentLimits, RunRecord
from evopolicy_common.records.secrets import Redaction, without_keys
from evopolicy_common.records.words import in_words
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway import harnesses
from evopolicy_gateway.agent_supervisor.supervisor import secrets_in
from evopolicy_gateway.http.server import Address
from evopolicy_gateway.inputs import own_config
from evopolicy_gateway.jail.jail import JailOrder
from evopolicy_gateway.processes import child_messages, child_rpc
from evopolicy_gateway.processes.agent_process import environment_of
from evopolicy_gateway.processes.child_messages import AgentEnded, Ready, StartAgent
from evopolicy_gateway.processes.child_rpc import Child
from evopolicy_gateway.relay.service import Order
from evopolicy_gateway.run import record, recorded_agent, starts
from evopolicy_gateway.run.model_relay import ModelRelay
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run.plan import Plan, Replays
from evopolicy_gateway.run.times import Stopwatch
from evopolicy_gateway.run.watch import RunObserver
from evopolicy_gateway.run_folder.layout import RunFolder, save, saved
from evopolicy_gateway.run_folder.listener import TOKEN_VARIABLE, agent_place, place_notice
from evopolicy_gateway.run_folder.locks import alone
from evopolicy_gateway.workspace import staging as workspace
from evopolicy_gateway.workspace.agents_md import LAST_WORDS_S

T = TypeVar("T")
END_GRACE_S = 15.0
GIVE_UP_TIMEOUT_S = 10.0
"""Limit for reporting a given-up run to the coordinator, whose failure may be the reason for giving up."""
_QUICK_DEATH_S = 5.0
_MAX_QUICK_DEATHS = 5
_MAX_SUPERVISOR_DEATHS = 5
_USAGE_ERROR = 2
_SURVIVORS_PAUSE_S = 1.0
_ENDLESS = 1 << 62
"""Bytes that a remote agent's workspace may take: its files may be elsewhere, and are its operator's."""


class RunError(EvopolicyError):
    """The run could not be played to its end; its folder and the message tell how far it came."""


class RunLifecycle:
    """Plays one plan, once."""

    def __init__(
        self,
        plan: Plan,
        operations: Operations,
        gateway: Credentials,
        watch: RunObserver,
        *,
        stays_open: bool = False,
        on_agent_gone: Callable[[], None] = lambda: None,
    ) -> None:
        """`gateway`: credentials of the gateway role, without a run's capability.

        `stays_open`: cancelling this leaves the run open, to be resumed. `on_agent_gone` is called once the
        agent's side is over; the rest of the run needs no slot for an agent.
        """
        self._plan = plan
        self._folder = plan.folder
        self._operations = operations
        self._credentials = gateway
        self._watch = watch
        self._name = plan.name or plan.settings.env
        self._stays_open = stays_open
        self.run = ""
        """The cluster's id of the run, once it is open."""
        self.served: asyncio.Future[Ready] = asyncio.get_running_loop().create_future()
        """Done when the gateway serves the agent for the first time."""
        self._spent = asyncio.Event()
        self._closed = asyncio.Event()
        self._cancelled = False
        """The run was cancelled at the coordinator by someone else."""
        self._on_agent_gone = on_agent_gone
        self._survivors: list[int] = []
        """Process ids of the agent that survive being killed."""
        self._submits = child_messages.SubmitsSeen(asked=0, running=False)
        """As last reported by the gateway."""
        self._held_before = 0.0
        """`held_s` of the run when the agent supervisor was started."""
        self._order: child_messages.CloseRun | None = None
        self._relay: ModelRelay | None = None
        self._model_spent = asyncio.Event()
        """A request beyond the limits of the run's model was refused."""
        self._gateway: Child | None = None
        self._supervisor: Child | None = None
        self._stopwatch: Stopwatch
        """Set when the run is open: the folder is new then, or holds the times of earlier commands."""
        self._new = False
        """Whether this command claims the folder."""
        self._put_aside: Callable[[], None] | None = None
        self._finished: RunFinished | None = None
        self._record: RunRecord

    @property
    def agent_at_work(self) -> bool:
        """Whether the agent's side is open and its closing was not requested yet."""
        return self._supervisor is not None and self._order is None and not self._closed.is_set()

    async def play(self, put_aside: Callable[[], None] | None = None) -> RunRecord:
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
            if await self._operations.phase(done.run) is None:
                how += (
                    f"; the cluster has no run {done.run}, so that nothing of it can be verified or re-scored"
                    " there (another cluster played it, or the state is of an earlier backup); --overwrite"
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
        if not self._new and (folder.intended.exists() or folder.opened_run.exists()):
            return
        self._new = True
        # Checking starts programs that try the jail, which another run's search would take for orphans.
        async with child_process.starting():
            plan.check_held()
        wanted = self._wanted
        if folder.root.exists() or folder.asked.exists():
            wanted = await self._ask(wanted)
        await self._operations.drop(folder)
        if self._put_aside is not None:
            self._put_aside()
        async with child_process.starting():
            plan.claim()
        folder.state.mkdir(mode=0o700)
        if plan.start_from:
            await asyncio.to_thread(starts.stage, starts.find(plan.start_from, plan.started_in), folder)
        save(folder.intended, wanted)
        folder.asked.unlink(missing_ok=True)
        if (replays := plan.replays) is not None:
            save(folder.service, Address(host=LOOPBACK, port=replays.port, token=replays.token))
        if plan.listener is not None:
            save(folder.listener, plan.listener)

    @property
    def _wanted(self) -> IntendedRun:
        """A new request for the run."""
        replays = self._plan.replays
        return IntendedRun(
            key=uuid.uuid4().hex,
            settings=self._plan.settings,
            replay_key="" if replays is None else replays.key,
        )

    async def _ask(self, wanted: IntendedRun) -> IntendedRun:
        """Opens the run and returns the request for it while the folder has its earlier run, which a refusal keeps.

        The request is kept beside the folder, so that a command that is killed meanwhile finds the run again.
        """
        folder = self._folder
        if folder.asked.exists():
            before = saved(folder.asked, IntendedRun)
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
        """Cancels the run that was asked for, as its folder cannot be had."""
        if self.run:
            with contextlib.suppress(EvopolicyError):
                await self._operations.cancel(self.run)
            self._folder.asked.unlink(missing_ok=True)
            self.run = ""

    async def _open(self) -> None:
        folder = self._folder
        if resumed := folder.opened_run.exists():
            self.run, token = (
                saved(folder.opened_run, OpenedRun).run,
                credentials.read(folder.credentials).token,
            )
        else:
            created = await self._operations.create(saved(folder.intended, IntendedRun))
            self.run, token = created.run, created.capability
        credentials.write(msgspec.structs.replace(self._credentials, token=token), folder.credentials)
        if resumed:
            phase = await self._operations.phase(self.run)
            if phase is None:
                raise ConfigError(f"the cluster no longer knows run {self.run} of {folder.root}")
            if phase != "open":
                self._closed.set()
            self._note(f"goes on with run {self.run} in {folder.root}")
        else:
            save(folder.opened_run, OpenedRun(run=self.run, agents_md=self._plan.texts.agents_md))
            self._note(f"run {self.run} in {folder.root}")
        self._operations.watched_by(self.run, (folder.lock, folder.supervisor_lock))
        self._stopwatch = Stopwatch(folder.times)

    async def _remove_new(self, error: BaseException) -> None:
        if self._new:
            remove_tree(self._folder.root)

    async def _score(self) -> None:
        if self._cancelled:
            await self._tell_gone()
        self._on_agent_gone()
        self._finished = await self._result()

    async def _result(self) -> RunFinished:
        async for progress in self._operations.wait(self.run):
            self._watch.phase(self._name, progress)
            if progress.finished is not None:
                return progress.finished
        raise AssertionError("waiting ends with the finished run")

    async def _write(self, why: str | None = None) -> None:
        assert self._finished is not None
        root, times = self._folder.root, self._stopwatch.times
        if refused := await asyncio.to_thread(keep_to_owner, root):
            how = f"as root: chown -R {os.getuid()} {root}; chmod -R a-s,o-w {root}"
            left = "files and folders that the agent left belong to other users and keep their modes"
            self._note(f"{refused} {left}; {how}")
        given = (self._folder, self._plan, self._finished, self._operations, times, self._note, why)
        self._record = await record.write(*given)

    async def _leave(self, error: BaseException) -> None:
        """Tells how the open run goes on, or gives it up."""
        if self._survivors:
            self._tell_survivors()
            self._note(
                f"when they are gone, go on with --resume, or say: evopolicy runs agent-gone {self.run}"
            )
        elif self._finished is not None or (self._closed.is_set() and isinstance(error, Exception)):
            how = f"--resume --exp-id {self._plan.settings.exp_id}, or the suite's command again,"
            self._note(f"its agent has ended: {how} completes the run without starting it")
        elif self._stays_open and isinstance(error, asyncio.CancelledError):
            await self._tell_gone()
        else:
            await self._give_up(str(error) if isinstance(error, EvopolicyError) else None)

    async def _give_up(self, why: str | None) -> None:
        """Cancels the run at the coordinator, so that no more is played, and records it in `run.json`."""
        with contextlib.suppress(EvopolicyError, OSError, TimeoutError):
            async with asyncio.timeout(GIVE_UP_TIMEOUT_S):
                await self._operations.cancel(self.run)
                await self._tell_gone()
                self._finished = await self._result()
                await self._write(why)

    async def _tell_gone(self) -> None:
        """Tells the coordinator that an open run's agent is gone; resuming the run needs a new permit."""
        if self._plan.listener is not None:
            return  # this machine does not know about a remote agent
        with contextlib.suppress(EvopolicyError, TimeoutError):
            async with asyncio.timeout(GIVE_UP_TIMEOUT_S):
                # Only for this machine: the run may have been resumed elsewhere before this arrives.
                await self._operations.agent_gone(self.run, agent_place(self._folder).boot_id)

    def _note(self, text: str) -> None:
        self._watch.note(self._name, text)

    # The phase of the agent.

    async def _agent(self) -> None:
        if self._closed.is_set():
            return
        tasks: list[asyncio.Task[Any]] = []

        def begin(work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
            task = asyncio.create_task(work)
            tasks.append(task)
            return task

        serving = begin(self._keep_gateway())
        begin(self._follow())
        ends = [begin(self._model_spent.wait()), begin(self._spent.wait())]
        try:
            up: list[asyncio.Future[Any]] = [serving, self.served]
            await asyncio.wait(up, return_when=asyncio.FIRST_COMPLETED)
            if serving.done():
                serving.result()
            if not self.served.done():
                return  # cancelled before it was served
            self._stopwatch.opened()
            self._relay = self._new_relay(self.served.result())
            relaying = [] if self._relay is None else [begin(self._relay.serve())]
            keeping = begin(self._keep_agent(self.served.result()))
            going: list[asyncio.Future[Any]] = [serving, keeping, *ends, *relaying]
            await asyncio.wait(going, return_when=asyncio.FIRST_COMPLETED)
            for task in relaying:
                if task.done():
                    task.result()
            if not serving.done() and not keeping.done():
                either: list[asyncio.Future[Any]] = [serving, keeping]
                await asyncio.wait(either, timeout=LAST_WORDS_S, return_when=asyncio.FIRST_COMPLETED)
            if serving.done() and not self._closed.is_set():
                serving.result()
            if not keeping.done():
                await self._tell_agent(child_messages.StopAgent())
            await self._close(await keeping)
            await serving
        finally:
            for each in tasks:
                # At the loop's end they are being cancelled too. A second time would interrupt the clean-up.
                if not each.cancelling():
                    each.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for child in (self._supervisor, self._relay, self._gateway):
                if child is not None:
                    await child.end(END_GRACE_S)
            self._survivors = await child_rpc.end_orphans()
            self._stopwatch.closed()

    async def _tell_agent(self, message: Any) -> None:
        if self._supervisor is not None:
            await self._supervisor.tell(message)

    async def _close(self, ended: AgentEnded) -> None:
        reason = "budget_spent" if self._spent.is_set() else ended.reason
        if self._model_spent.is_set() and reason in ("agent_stopped", "agent_failed", "told"):
            reason = "model_budget_spent"
        reason = CANCELLED if self._cancelled else reason
        how = f"agent ended: {in_words(reason)}"
        self._note(f"{how}, {ended.detail}" if ended.detail else how)
        if reason == "agent_failed":
            for line in ended.stderr_tail:
                self._note(f"stderr: {line}")
            without = "" if ended.stderr_tail else "the agent printed no errors; "
            self._note(f"{without}full log: {self._folder.agent_log}")
        facts = without_keys(ended.facts)
        about = {"turns": ended.turns, "retries": ended.retries, "detail": ended.detail, **facts}
        try:
            about["record"] = record.told_at_close(self._folder, self._plan, about, self._stopwatch.times)
        except Exception as error:  # the agent has ended: no bug in this costs the run
            why = record.why_failed(error, self._folder.harness_log)
            self._note(f"the coordinator does not commit to this side of run.json: {why}")
        self._order = child_messages.CloseRun(reason=reason, agent=about)
        if self._gateway is not None:
            await self._gateway.tell(self._order)

    async def _follow(self) -> None:
        """Prints why the run is not served yet. Ends the agent when the run is cancelled at the coordinator,
        which the gateway may not learn."""
        waiting = Waiting()
        async for progress in self._operations.wait(self.run):
            if not self.served.done() and progress.env_failure and self._operations.own:
                self.served.set_exception(BrokenEnvironmentError(progress.env_failure))
            if not self.served.done() and waiting.worth_saying(progress.waits_for):
                self._note(f"waiting for {progress.waits_for}")
            finished = progress.finished
            if finished is not None and finished.status == CANCELLED:
                self._cancelled = True
                self._spent.set()

    def _secrets(self, ready: Ready) -> tuple[str, ...]:
        """What the agent's log leaves out, and so does the record of its model."""
        harness, config = self._plan.harness(), self._plan.agent_config
        config = config or harnesses.config_of(self._plan.agent, self._plan.started_in)
        variables = environment_of({**ready.variables, **workspace.variables(self._folder)})
        on_command_line: list[str] = []
        without_keys([self._plan.agent, msgspec.to_builtins(config)], on_command_line)
        found = Redaction.of(secrets_in(variables, config), ready.variables).secrets
        return (*found, *on_command_line, *own_config.secrets(harness.own_files))

    def _new_relay(self, ready: Ready) -> ModelRelay | None:
        """The relay for the agent's model, or None where it has none or cannot use one. Prints the limits."""
        terms = self._plan.harness().model
        if terms is None:
            return None
        if terms.upstream is None:
            how = "counted by the agent itself, so that only its tokens are limited"
            self._note(f"model limits: {terms.limits}; metering: agent ({how})")
            return None
        self._note(f"model limits: {terms.limits}; metering: relay")
        upstream, replays = terms.upstream, self._plan.replays

        def spent(what: str) -> None:
            if not self._model_spent.is_set():
                self._note(
                    f"the model budget is spent: {what}" if replays is None else f"the replay ends: {what}"
                )
            self._model_spent.set()

        made = ModelRelay(
            lambda token: Order(
                upstream=upstream,
                token=token,
                ledger=str(self._folder.model_requests),
                limits=terms.limits,
                prices=terms.prices,
                model=terms.model,
                declared_only=terms.declared_only,
                own_tools_only=terms.own_tools_only,
                record=self._plan.record_model,
                replay="" if replays is None else str(replays.folder),
                folder=str(self._folder.model_record),
                tokens=(saved(self._folder.service, Address).token, token),
                secrets=self._secrets(ready),
            ),
            self._folder.model_requests,
            self._folder.harness_log,
            jailed=self._plan.jail.mode != "none",
            doing=partial(self._watch.doing, self._name),
            spent=spent,
            port=0 if replays is None else replays.model_port,
            token="" if replays is None else replays.model_token,
        )
        # A replay needs the jail, for its paths; and an agent without one could read this file.
        if self._plan.record_model == "full" and self._plan.jail.mode != "none":
            service = saved(self._folder.service, Address)
            replays = Replays(
                folder=self._folder.model_record,
                root=self._folder.root,
                run=self.run,
                key=saved(self._folder.intended, IntendedRun).key,
                port=service.port,
                token=service.token,
                model_port=made.port,
                model_token=made.token,
            )
            recorded_agent.keep(self._folder, self._plan, replays)
        return made

    async def _keep_gateway(self) -> None:
        """Runs the gateway, with restarts, until it has closed the run."""
        serve = [sys.executable, "-P", "-m", "evopolicy_gateway.cli.serve"]
        program = [*serve, str(self._folder.root), "--controlled"]
        quick_deaths = 0
        while not self._closed.is_set():
            started = time.monotonic()
            self._stopwatch.gateway_begins()
            self._gateway = await Child.start(program, self._folder.harness_log, talks=True)
            async for event in self._gateway.events():
                await self._on_gateway_event(event)
            code = await self._gateway.ended()
            if self._closed.is_set():
                return
            quick_deaths = quick_deaths + 1 if time.monotonic() - started < _QUICK_DEATH_S else 0
            if code == _USAGE_ERROR or quick_deaths > _MAX_QUICK_DEATHS:
                words = child_process.last_words(self._gateway.log)
                log = self._folder.harness_log
                raise RunError(f"the gateway cannot serve (exit status {code}): {words}; see {log}")
            self._note(f"the gateway ended with status {code}; starting it again")
            await asyncio.sleep(0.1 * 2**quick_deaths)

    async def _on_gateway_event(self, event: object) -> None:
        if isinstance(event, child_messages.Waits):
            self._watch.held(self._name, event.waits_for)
        elif isinstance(event, Ready):
            self._stopwatch.permit_reported(event.permit_s)
            self._stopwatch.held_reported(event.held_s)
            if not self.served.done():
                for text in event.notes:
                    self._note(text)
                self._tell_where(event)
                self.served.set_result(event)
            if self._order is not None and self._gateway is not None:
                await self._gateway.tell(self._order)
        elif isinstance(event, child_messages.Progress):
            self._stopwatch.gateway_reported(event.in_flight_s, event.feedback_s)
            self._watch.progress(self._name, event)
            before, held = self._stopwatch.times.held_s, self._stopwatch.held_reported(event.held_s)
            if held > before:
                # Time for which submits waited for hidden episodes is given back to the agent's clock.
                await self._tell_agent(child_messages.HeldTime(seconds=held - self._held_before))
            asked, running = event.n_submits + event.n_rejected, event.submit_id is not None
            self._submits = child_messages.SubmitsSeen(asked=asked, running=running)
            await self._tell_agent(self._submits)
            self._cancelled = self._cancelled or event.cancelled
            if event.spent:
                self._spent.set()
        elif isinstance(event, child_messages.RunClosed):
            self._closed.set()

    def _tell_where(self, ready: Ready) -> None:
        """Prints the facts that the operator passes on to a remote agent."""
        if self._plan.listener is None:
            if not host.boot_id():
                until = "until then no hidden case that this run shares is played while its agent lives"
                self._note(f"{host.NO_BOOT_ID}; {until}")
            return
        for text in (
            place_notice(self._plan.settings.agent_host, self._folder.root),
            f"the agent is served at {ready.variables['EVOPOLICYGYM_SUBMIT_URL']}",
            f"its bearer token is in {self._folder.bearer}; it finds it in {TOKEN_VARIABLE}",
            f"its workspace is {self._folder.workspace}; the rules are in AGENTS.md there",
            f"when it is done before its budget is spent: evopolicy finish {self._folder.root}",
        ):
            self._note(text)

    def _jail(self) -> JailOrder | None:
        if self._plan.jail.mode == "none":
            return None
        sockets = [endpoint.partition("/") for endpoint in self._credentials.endpoints]
        states = [str(Path(path).parent.resolve()) for kind, _, path in sockets if kind == "unixsock-stream"]
        if self._credentials.tls is not None:
            states.append(str(Path(self._credentials.tls.private_key).parent))
        hidden = [str(self._plan.runs.absolute()), str(credentials.default_state_dir()), *states]
        return JailOrder(
            settings=self._plan.jail,
            private=str(self._folder.agent),
            hidden=tuple(hidden),
            shown="" if self._plan.replays is None else str(self._shown.workspace),
        )

    @property
    def _shown(self) -> RunFolder:
        """The run's folder, as its agent sees it."""
        return self._folder if self._plan.replays is None else RunFolder(self._plan.replays.root)

    async def _keep_agent(self, ready: Ready) -> AgentEnded:
        """Runs the agent to its end. Restarts it when its supervisor dies, our failure: in its session if it
        has one, else anew in its workspace."""
        for _ in range(_MAX_SUPERVISOR_DEATHS):
            ended = await self._keep_agent_once(ready)
            if ended is not None:
                return ended
            if self._spent.is_set():
                break
            self._note("the agent's supervisor died; starting it again, and the agent with it")
        known = self._plan.harness().known()
        return AgentEnded(reason="agent_failed", detail="its agent supervisor died", facts=known)

    async def _keep_agent_once(self, ready: Ready) -> AgentEnded | None:
        """Returns how the agent ended; None when its supervisor died."""
        self._stopwatch.agent_begins()
        self._held_before = self._stopwatch.times.held_s
        left_s = max(1.0, self._plan.wall_limit_s - self._stopwatch.times.agent_s)
        program = [sys.executable, "-P", "-m", "evopolicy_gateway.agent_supervisor.supervisor"]
        config, here = self._plan.agent_config, self._plan.listener is None
        self._supervisor = await Child.start(program, self._folder.harness_log, talks=True)
        await self._supervisor.tell(
            StartAgent(
                agent=self._plan.agent,
                workspace=str(self._folder.workspace),
                agent_log=str(self._folder.agent_log),
                urls=ready.variables,
                variables=workspace.variables(self._shown),
                started_in=str(self._plan.started_in),
                wall_limit_s=left_s,
                silence_s=self._plan.silence_s,
                prompts=msgspec.to_builtins(self._plan.texts.prompts),
                inputs=self._plan.texts.inputs,
                config=None if config is None else msgspec.to_builtins(config),
                model_url="" if self._relay is None else self._relay.url,
                model_token="" if self._relay is None else self._relay.token,
                session_file=str(self._folder.session),
                passed_file=str(self._folder.passed),
                lock=str(self._folder.supervisor_lock),
                jail=self._jail(),
                limits=self._plan.limits if here else AgentLimits(disk_bytes=_ENDLESS),
            )
        )
        await self._supervisor.tell(self._submits)
        ended: AgentEnded | None = None
        async for event in self._supervisor.events():
            if isinstance(event, child_messages.AgentTurn):
                self._watch.turn(self._name, event.turn, event.text)
            elif isinstance(event, child_messages.AgentDoing):
                if self._relay is not None:
                    event = msgspec.structs.replace(event, tokens=None)  # the relay's count is the run's
                self._watch.doing(self._name, event)
            elif isinstance(event, child_messages.AgentTime):
                self._stopwatch.agent_reported(event.used_s)
            elif isinstance(event, child_messages.AgentUsed) and here:
                self._stopwatch.agent_used(event.resources)
            elif isinstance(event, child_messages.AgentSurvives):
                self._survivors = list(event.pids)
                self._tell_survivors()
            elif isinstance(event, AgentEnded):
                ended = event
        await self._supervisor.ended()
        # Processes left behind by a supervisor that died have become our children.
        while left := await child_rpc.end_orphans():
            if left != self._survivors:
                self._survivors = left
                self._tell_survivors()
            await asyncio.sleep(_SURVIVORS_PAUSE_S)
        self._survivors = []
        return ended

    def _tell_survivors(self) -> None:
        pids = ", ".join(map(str, self._survivors))
        self._note(
            f"processes of the agent survive being killed ({pids}): the run stays open, and no hidden case"
            " that it shares is played on this machine, before they are gone"
        )


PHASES = (
    (RunLifecycle._claim, RunLifecycle._withdraw),
    (RunLifecycle._open, RunLifecycle._remove_new),
    (RunLifecycle._agent, RunLifecycle._leave),
    (RunLifecycle._score, RunLifecycle._leave),
    (RunLifecycle._write, RunLifecycle._leave),
)
"""Each phase, which returns at once if its result is durable; and what is called with the error of one."""
