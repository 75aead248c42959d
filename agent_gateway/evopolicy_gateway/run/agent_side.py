"""The agent's side of an open run: gateway, relay and agent, from their start to the closed run.

They start in this order: the agent needs the gateway's address, and the relay's. They end once the agent has ended, its
budget or its model's is spent, its wall limit is reached, or the run is cancelled. The agent ends first, with all that
it started; then the relay; the gateway closes the run last.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from evopolicy_common.errors import BrokenEnvironmentError
from evopolicy_common.messages.gateway import CANCELLED
from evopolicy_common.processes.notices import Waiting
from evopolicy_common.records.secrets import without_keys
from evopolicy_common.records.words import in_words
from evopolicy_gateway.processes import child_messages as messages
from evopolicy_gateway.processes.child_messages import TrainProgress
from evopolicy_gateway.run import model_relay, record
from evopolicy_gateway.run.children import GatewayProcess, RunContext, SupervisedAgent
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.workspace.agents_md import LAST_WORDS_S

T = TypeVar("T")
END_GRACE_S = 15.0


class AgentSide:
    """Plays once."""

    def __init__(self, run: RunContext, *, closed: bool) -> None:
        """`closed`: the coordinator has closed the run, so that the agent has ended."""
        self._run = run
        self._spent = asyncio.Event()
        """The budget is spent, or the run is cancelled."""
        self._model_spent = asyncio.Event()
        """A request beyond the limits of the run's model was refused."""
        self.cancelled = False
        """The run was cancelled at the coordinator by someone else."""
        self._gateway = GatewayProcess(run, self._on_progress)
        self._gateway.closed = closed
        self.agent = SupervisedAgent(run)

    @property
    def closed(self) -> bool:
        """Whether the run is closed, or its agent has ended and only the closing is left."""
        return self._gateway.closed or self._run.folder.closing.exists()

    @property
    def agent_at_work(self) -> bool:
        """Whether the agent has begun, and the run's closing was not requested yet."""
        return self.agent.has_begun and not self._gateway.is_closing

    async def play_agent(self) -> None:
        """Plays until the run is closed; returns at once if it is. Raises EvopolicyError."""
        if self._gateway.closed:
            return
        if self._run.folder.closing.exists():
            await self.close_again()
            return
        tasks: list[asyncio.Task[object]] = []

        def begin(work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
            tasks.append(task := asyncio.create_task(work))
            return task

        served = self._run.served
        relay: model_relay.ModelRelay | None = None
        serving, following = begin(self._gateway.keep()), begin(self._follow())
        ends = [begin(self._model_spent.wait()), begin(self._spent.wait())]
        try:
            up: list[asyncio.Future[Any]] = [serving, served, following]
            await asyncio.wait(up, return_when=asyncio.FIRST_COMPLETED)
            for task in (serving, following):
                if task.done():
                    task.result()
            if not served.done():
                return  # cancelled before it was served
            ready = served.result()
            self._run.stopwatch.opened()
            relay = model_relay.of_run(self._run, ready, self._model_spent)
            relaying = [] if relay is None else [begin(relay.serve())]
            address = None if relay is None else relay.address
            keeping = begin(self.agent.keep(ready, address, self._spent))
            going: list[asyncio.Future[Any]] = [serving, keeping, following, *ends, *relaying]
            await asyncio.wait(going, return_when=asyncio.FIRST_COMPLETED)
            for task in (*relaying, following):
                if task.done():
                    task.result()
            if not serving.done() and not keeping.done():
                either: list[asyncio.Future[Any]] = [serving, keeping]
                await asyncio.wait(either, timeout=LAST_WORDS_S, return_when=asyncio.FIRST_COMPLETED)
            if serving.done() and not self.closed:
                serving.result()
            if not keeping.done():
                await self.agent.tell(messages.StopAgent())
            await self._close(await keeping)
            await serving
        finally:
            for each in tasks:
                # At the loop's end they are being cancelled too. A second time would interrupt the clean-up.
                if not each.cancelling():
                    each.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for child in (self.agent, relay, self._gateway):
                if child is not None:
                    await child.end(END_GRACE_S)
            self.agent.survivors = await messages.end_orphans()
            self._run.stopwatch.closed()

    async def close_again(self) -> None:
        """Has the run closed whose agent has ended: a coordinator on an earlier backup has lost the closing."""
        try:
            await self._gateway.keep()
        finally:
            await self._gateway.end(END_GRACE_S)

    async def _follow(self) -> None:
        """Prints why the run is not served yet; ends the agent of a cancelled run."""
        run, served, waiting = self._run, self._run.served, Waiting()
        async for progress in run.operations.wait(run.run):
            if not served.done() and progress.env_failure and run.operations.own:
                served.set_exception(BrokenEnvironmentError(progress.env_failure))
            if not served.done() and waiting.worth_saying(progress.waits_for):
                run.note(f"waiting for {progress.waits_for}")
            if progress.finished is not None and progress.finished.status == CANCELLED:
                self.cancelled = True
                self._spent.set()

    async def _on_progress(self, progress: TrainProgress) -> None:
        stopwatch = self._run.stopwatch
        times = Times(in_flight_s=progress.in_flight_s, feedback_s=progress.feedback_s)
        stopwatch.reported("gateway", times)
        self._run.watch.progress(self._run.plan.name, progress)
        held_s, running = stopwatch.held_reported(progress.held_s), progress.submit_id is not None
        asked = progress.n_submits + progress.n_rejected
        await self.agent.note_submits(messages.SubmitsSeen(asked=asked, running=running, held_s=held_s))
        self.cancelled = self.cancelled or progress.cancelled
        if progress.spent:
            self._spent.set()

    async def _close(self, ended: messages.AgentEnded) -> None:
        """Prints why the agent ended, and has the run closed."""
        run = self._run
        reason = "budget_spent" if self._spent.is_set() else ended.reason
        if self._model_spent.is_set() and reason in ("agent_stopped", "agent_failed", "told"):
            reason = "model_budget_spent"
        reason = CANCELLED if self.cancelled else reason
        run.note(", ".join(filter(None, (f"agent ended: {in_words(reason)}", ended.detail))))
        if not run.folder.model_requests.exists() and (tokens := ended.facts.get("tokens")):
            run.note(f"model use, as the agent counted: {model_relay.use_words(tokens)}")
        if reason == "agent_failed":
            for line in ended.stderr_tail:
                run.note(f"stderr: {line}")
            without = "" if ended.stderr_tail else "the agent printed no errors; "
            run.note(f"{without}full log: {run.folder.agent_log}")
        facts = without_keys(ended.facts)
        about = {"turns": ended.turns, "retries": ended.retries, "detail": ended.detail, **facts}
        try:
            about["record"] = record.told_at_close(run.folder, run.plan, about, run.stopwatch.times)
        except Exception as error:  # the agent has ended: no bug in this costs the run
            why = record.why_failed(error, run.folder.harness_log)
            run.note(f"the coordinator does not commit to this side of run.json: {why}")
        await self._gateway.close(messages.CloseGateway(reason=reason, agent=about))
