"""One run's gateway as a process: session, desk and HTTP service together, until the run is closed or it is told to stop.

It holds the run's capability and nothing else of the cluster. Stopped without a word (signal, death, its operator gone) it
leaves the run open: started again on the same folder it goes on where it was.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import structlog

from evopolicy_common import credentials, transport
from evopolicy_common.blobs import BlobStore
from evopolicy_common.errors import ConfigError, RefusedError
from evopolicy_common.refusals import RUN_OVER
from evopolicy_gateway import workspace
from evopolicy_gateway.agents_md import Urls
from evopolicy_gateway.http import make_app
from evopolicy_gateway.journal import Closed, Journal
from evopolicy_gateway.layout import OpenedRun, RunFolder
from evopolicy_gateway.server import bind, serving
from evopolicy_gateway.session import Session
from evopolicy_gateway.submits import Desk

log: structlog.stdlib.BoundLogger = structlog.get_logger()


class Close(msgspec.Struct, frozen=True, kw_only=True):
    """The agent and all its children are gone: tell the coordinator so."""

    reason: str
    agent: dict[str, Any] = {}


class Gateway:
    """Runs once. `tell` may be called from the same event loop at any time."""

    def __init__(
        self,
        folder: RunFolder,
        connect: tuple[str, ...] = (),
        credentials_file: Path | None = None,
        *,
        on_ready: Callable[[Urls, Desk], None],
        on_change: Callable[[Desk], None],
        close_when_spent: bool,
    ) -> None:
        """`connect` and `credentials_file` (its folder) replace those of the run; its capability stays.

        `close_when_spent`: nobody else watches the agent.
        """
        self._folder = folder
        self._connect = connect
        self._credentials_file = credentials_file
        self._on_ready = on_ready
        self._on_change = on_change
        self._close_when_spent = close_when_spent
        self._told: asyncio.Future[Close | None] = asyncio.get_running_loop().create_future()
        self._changed = asyncio.Event()

    def tell(self, close: Close | None) -> None:
        """Ends the gateway: closing the run, or (None) leaving it open."""
        if not self._told.done():
            self._told.set_result(close)

    async def run(self) -> bool:
        """Serves until told to end; whether the run was closed. Raises what makes it impossible to go on."""
        found, run = _load(self._folder, self._connect, self._credentials_file)
        sock, address = await bind(self._folder)
        journal = Journal(self._folder.journal)
        try:
            async with contextlib.AsyncExitStack() as stack:
                link = await self._unless_told(
                    stack.enter_async_context(transport.connect(found, timeout_s=None))
                )
                if link is None:
                    return False
                session = Session(link, run)
                try:
                    opened = await self._unless_told(session.open())
                except RefusedError as error:
                    if error.status not in RUN_OVER:
                        raise
                    log.warning("the run takes no more", status=error.status, why=error.message)
                    return True
                if opened is None:
                    return False
                workspace.stage(self._folder, opened, address.urls())
                blobs = BlobStore(self._folder.blobs)
                desk = Desk(session, opened, self._folder.workspace, journal, blobs, self._changed.set)
                http = await stack.enter_async_context(
                    serving(make_app(desk, address.token, address.bearer), sock)
                )
                log.info("serving", run=run, env=opened.env.env, port=address.port)
                self._on_ready(address.urls(), desk)
                try:
                    close = await self._watch(desk, http)
                    return close is not None and await self._close(session, journal, desk, close)
                finally:
                    await desk.stop()
        finally:
            sock.close()
            journal.close()

    async def _watch(self, desk: Desk, http: asyncio.Task[None]) -> Close | None:
        """Passes changes on until told to end."""
        self._changed.set()
        while True:
            changed = asyncio.ensure_future(self._changed.wait())
            waited: list[asyncio.Future[Any]] = [changed, self._told, desk.fatal, http]
            await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
            changed.cancel()
            if desk.fatal.done():
                desk.fatal.result()
            if http.done():
                http.result()
                raise ConfigError("the HTTP service ended by itself")
            if self._told.done():
                return self._told.result()
            self._changed.clear()
            self._on_change(desk)
            if self._close_when_spent and desk.spent:
                return Close(reason="budget_spent")

    async def _close(self, session: Session, journal: Journal, desk: Desk, close: Close) -> bool:
        # The agent is gone, but what it asked for last is still played and written.
        desk.closed = True
        await desk.idle()
        await session.close(close.reason, close.agent)
        await asyncio.to_thread(journal.append, Closed(reason=close.reason))
        log.info("run closed", reason=close.reason)
        return True

    async def _unless_told(self, wanted: Any) -> Any:
        """The result, or None when told to end first."""
        task = asyncio.ensure_future(wanted)
        await asyncio.wait([task, self._told], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            return task.result()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return None


def _load(
    folder: RunFolder, connect: tuple[str, ...], file: Path | None
) -> tuple[credentials.Credentials, str]:
    if not folder.opened.exists():
        raise ConfigError(
            f"{folder.root} holds no open run ({folder.state.name}/{folder.opened.name} is missing);"
            " runs are opened by `evopolicy run`"
        )
    found = credentials.read(folder.credentials)
    run = msgspec.json.decode(folder.opened.read_bytes(), type=OpenedRun).run
    if file is not None:
        found = msgspec.structs.replace(credentials.find("gateway", connect, file), token=found.token)
    return credentials.at(found, connect), run


def folder_of(path: Path) -> RunFolder:
    """The run folder at `path`; ConfigError when there is no such folder."""
    if not path.is_dir():
        raise ConfigError(
            f"{path} is not a folder; name a run directory such as runs/evolve/gym_acrobot/first"
        )
    return RunFolder(path.absolute())
