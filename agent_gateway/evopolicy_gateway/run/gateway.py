"""One run's gateway process: coordinator client, submit pipeline and HTTP service.

- The gateway serves until the run is closed or the gateway is told to stop.
- It holds the run's capability and no other credential of the cluster.
- Ended without an order (signal, crash, end of the parent), it leaves the run open; a restart on the same folder
  resumes.
- It serves, and the agent is started or announced, only once the coordinator permits the agent to be alive at its
  place.
- Closing the run ends the permit, so it follows the agent's end, which the parent or else the operator (`evopolicy
  finish`) reports.
- The order to close the run is durable before it is carried out, and the next gateway repeats it: the coordinator may
  have been started on a backup from before the closing.
- The gateway keeps renewing the permit: a report that an agent elsewhere is gone may have ended this one's.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from evopolicy_common.errors import ConfigError, RefusedError
from evopolicy_common.logs import log
from evopolicy_common.refusals import RUN_OVER
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.http import serving
from evopolicy_gateway.http.server import bind
from evopolicy_gateway.http.service import make_app
from evopolicy_gateway.processes.child_messages import CloseGateway
from evopolicy_gateway.run_folder.journal import Journal
from evopolicy_gateway.run_folder.layout import RunFolder, save, saved
from evopolicy_gateway.run_folder.listener import AgentPlace, agent_place, ends_unseen
from evopolicy_gateway.submits.coordinator_client import CoordinatorClient
from evopolicy_gateway.submits.pipeline import SubmitPipeline
from evopolicy_gateway.workspace import staging as workspace
from evopolicy_gateway.workspace.agents_md import Urls

T = TypeVar("T")
_POLL_S = 1.0
_REPORT_S = 0.1
"""Pause after a report of changes: a submit changes ten times, and each report wakes three processes."""


class Gateway:
    """Runs once. `tell` may be called at any time on the same event loop."""

    def __init__(
        self,
        folder: RunFolder,
        *,
        on_ready: Callable[[Urls, SubmitPipeline], None],
        on_change: Callable[[SubmitPipeline], None],
        on_wait: Callable[[str], None] = lambda waits_for: None,
    ) -> None:
        """`on_wait` receives the reason for waiting, other than the agent, or an empty text when the wait is over."""
        self._folder = folder
        self._on_ready, self._on_change, self._on_wait = on_ready, on_change, on_wait
        self._stopped = asyncio.Event()
        """Set to leave the run open."""
        self.permit_s = 0.0
        """Seconds spent waiting for the agent's permit."""
        self._orders: asyncio.Future[CloseGateway | None] = asyncio.get_running_loop().create_future()
        self._changed = asyncio.Event()

    def tell(self, close: CloseGateway | None) -> None:
        """Ends the gateway: closes the run, or with None leaves it open, even while the closing waits."""
        if close is None:
            self._stopped.set()
        if not self._orders.done():
            self._orders.set_result(close)

    async def run(self) -> bool:
        """Serves until `tell`; returns whether the run was closed. Raises errors that make serving impossible."""
        folder = self._folder
        (own, run), place = _load(folder), agent_place(folder)
        if folder.closing.exists():
            self.tell(saved(folder.closing, CloseGateway))
        async with contextlib.AsyncExitStack() as stack:
            sock, address = await bind(folder)
            stack.callback(sock.close)
            journal = stack.enter_context(contextlib.closing(Journal(folder.journal)))
            linked = stack.enter_async_context(transport.connect(own, timeout_s=None))
            link = await self._unless(self._stopped.wait(), linked)
            if link is None:
                return False
            session = CoordinatorClient(link, run, folder.state)
            try:
                opened = await self._unless(self._stopped.wait(), session.open())
                if opened is None or not await self._permitted(session, place):
                    return False
            except RefusedError as error:
                if error.status not in RUN_OVER:
                    raise
                log.warning("the run takes no more", status=error.status, why=error.message)
                return True
            text = folder.given_agents_md.read_bytes().decode() if folder.given_agents_md.exists() else ""
            workspace.stage(folder, opened, address.urls(), text)
            pipeline = SubmitPipeline(session, opened, folder, journal, self._changed.set)
            app = make_app(pipeline, address.token, address.bearer)
            http = await stack.enter_async_context(serving(app, sock))
            log.info("serving", run=run, env=opened.env.env, port=address.port)
            self._on_ready(address.urls(), pipeline)
            if not self._orders.done():
                stack.callback(asyncio.ensure_future(session.keep_permit(place)).cancel)
            try:
                close = await self._watch(pipeline, http)
                return close is not None and await self._close(pipeline, close)
            finally:
                await pipeline.stop()

    async def _permitted(self, session: CoordinatorClient, place: AgentPlace) -> bool:
        """True when the permit is granted or the run is to be closed; False when ordered to leave the run open."""
        requested_at = time.monotonic()
        permit = session.permit(place, self._on_wait)
        try:
            granted = await self._unless(asyncio.shield(self._orders), permit)
        finally:
            self.permit_s = time.monotonic() - requested_at
            self._on_wait("")
        return not self._stopped.is_set() if granted is None else granted

    async def _watch(self, pipeline: SubmitPipeline, http: asyncio.Task[None]) -> CloseGateway | None:
        """Reports changes until `tell`; returns its argument."""
        ends: list[asyncio.Future[Any]] = [self._orders, pipeline.fatal, http]
        machine = pipeline.machine
        self._changed.set()
        while True:
            changed = asyncio.ensure_future(self._changed.wait())
            await asyncio.wait([changed, *ends], return_when=asyncio.FIRST_COMPLETED)
            changed.cancel()
            for ended in (pipeline.fatal, http):
                if ended.done():
                    ended.result()
                    raise ConfigError("the HTTP service ended unexpectedly")
            if self._changed.is_set():
                self._changed.clear()
                self._on_change(pipeline)
            if self._orders.done():
                return self._orders.result()

            # Each verdict at once, as a report has only the last one. After its last submit an agent may end at any
            # moment, and the reason counts that comes first.
            def is_news(reported: int = machine.n_settled) -> bool:
                return machine.n_settled > reported or machine.spent or machine.cancelled

            urgent = asyncio.ensure_future(pipeline.until(is_news))
            await asyncio.wait([urgent, *ends], timeout=_REPORT_S, return_when=asyncio.FIRST_COMPLETED)
            urgent.cancel()

    async def _close(self, pipeline: SubmitPipeline, close: CloseGateway) -> bool:
        await asyncio.to_thread(save, self._folder.closing, close)
        # The agent is gone, but its last submit is still played and written.
        pipeline.machine.close()
        await pipeline.idle()
        if not await self._agent_gone(pipeline):
            return False
        await pipeline.close(close.reason, close.agent)
        log.info("run closed", reason=close.reason)
        return True

    async def _agent_gone(self, pipeline: SubmitPipeline) -> bool:
        """True once the agent has ended as far as anyone can tell; False when first ordered to leave the run open."""
        unseen = ends_unseen(self._folder)
        while unseen and not (
            pipeline.machine.cancelled or self._folder.finish.exists() or self._stopped.is_set()
        ):
            self._on_wait(f"the agent's end; when it has ended: evopolicy finish {self._folder.root}")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stopped.wait(), _POLL_S)
            await pipeline.refresh()
        self._on_wait("")
        return not self._stopped.is_set()

    async def _unless(self, order: Awaitable[object], wanted: Awaitable[T]) -> T | None:
        """The result of `wanted`, or None when the order comes first."""
        task, ordered = asyncio.ensure_future(wanted), asyncio.ensure_future(order)
        await asyncio.wait([task, ordered], return_when=asyncio.FIRST_COMPLETED)
        ordered.cancel()
        if task.done():
            return task.result()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return None


def _load(folder: RunFolder) -> tuple[credentials.Credentials, str]:
    if not (run := folder.run):
        raise ConfigError(
            f"{folder.root} holds no open run ({folder.state.name}/{folder.intended.name} names none);"
            " runs are opened by `evopolicy run`"
        )
    own = credentials.read_credentials(folder.credentials)
    credentials.check_endpoints(own)
    return own, run
