"""The run's gateway as a child process, which is started again on the same port until it has closed the run."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Awaitable, Callable

from evopolicy_common.processes import child_process, host
from evopolicy_gateway.processes.child_messages import CloseRun, Progress, Ready, RunClosed, Waits
from evopolicy_gateway.processes.child_rpc import Child
from evopolicy_gateway.run.open_run import OpenRun, RunError
from evopolicy_gateway.run_folder.listener import TOKEN_VARIABLE, place_notice

_QUICK_DEATH_S = 5.0
_MAX_QUICK_DEATHS = 5
_USAGE_ERROR = 2


class GatewayProcess:
    """The gateway of one run, over all its processes."""

    def __init__(
        self,
        run: OpenRun,
        served: asyncio.Future[Ready],
        on_progress: Callable[[Progress], Awaitable[None]],
        *,
        closed: bool,
    ) -> None:
        """`served`: gets the result when the agent is served for the first time. `closed`: the run is closed."""
        self._run = run
        self._served = served
        self._on_progress = on_progress
        self.closed = asyncio.Event()
        """Set when the coordinator has closed the run."""
        if closed:
            self.closed.set()
        self._close: CloseRun | None = None
        self._child: Child | None = None

    @property
    def is_closing(self) -> bool:
        """Whether the run is closed, or its closing was requested."""
        return self._close is not None or self.closed.is_set()

    async def keep(self) -> None:
        """Runs the gateway until it has closed the run. Raises RunError when it cannot serve."""
        run, log = self._run, self._run.folder.harness_log
        module = "evopolicy_gateway.cli.serve"
        program = [sys.executable, "-P", "-m", module, str(run.folder.root), "--controlled"]
        quick_deaths = 0
        while not self.closed.is_set():
            started = time.monotonic()
            run.stopwatch.begins("gateway")
            self._child = await Child.start(program, log, talks=True)
            async for event in self._child.events():
                await self._on_event(event)
            code = await self._child.ended()
            if self.closed.is_set():
                return
            quick_deaths = quick_deaths + 1 if time.monotonic() - started < _QUICK_DEATH_S else 0
            if code == _USAGE_ERROR or quick_deaths > _MAX_QUICK_DEATHS:
                words = child_process.last_words(log)
                raise RunError(f"the gateway cannot serve (exit status {code}): {words}; see {log}")
            run.note(f"the gateway ended with status {code}; starting it again")
            await asyncio.sleep(0.1 * 2**quick_deaths)

    async def close(self, order: CloseRun) -> None:
        """Has the run closed, by this gateway or the next one."""
        self._close = order
        if self._child is not None:
            await self._child.tell(order)

    async def end(self, grace_s: float) -> None:
        if self._child is not None:
            await self._child.end(grace_s)

    async def _on_event(self, event: object) -> None:
        run = self._run
        match event:
            case Waits():
                run.watch.held(run.plan.name, event.waits_for)
            case Ready():
                run.stopwatch.permit_reported(event.permit_s)
                run.stopwatch.held_reported(event.held_s)
                if not self._served.done():
                    for text in (*event.notes, *_place_notes(run, event)):
                        run.note(text)
                    self._served.set_result(event)
                if self._close is not None:
                    await self.close(self._close)
            case Progress():
                await self._on_progress(event)
            case RunClosed():
                self.closed.set()


def _place_notes(run: OpenRun, ready: Ready) -> list[str]:
    """Facts about the agent's place: for a remote agent, those that the operator passes on to it."""
    if run.plan.listener is None:
        until = "until then no hidden case that this run shares is played while its agent lives"
        return [] if host.boot_id() else [f"{host.NO_BOOT_ID}; {until}"]
    return [
        place_notice(run.plan.settings.agent_host, run.folder.root),
        f"the agent is served at {ready.variables['EVOPOLICYGYM_SUBMIT_URL']}",
        f"its bearer token is in {run.folder.bearer}; it finds it in {TOKEN_VARIABLE}",
        f"its workspace is {run.folder.workspace}; the rules are in AGENTS.md there",
        f"when it is done before its budget is spent: evopolicy finish {run.folder.root}",
    ]
