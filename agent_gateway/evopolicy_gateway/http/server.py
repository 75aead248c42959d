"""The HTTP service, on a loopback port or at the operator's `Listener`; its address stays the same after every restart.

Slow clients are disconnected: while they send headers, while they read an answer, and between two requests.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import socket
from collections.abc import AsyncIterator, Iterator

import msgspec
import uvicorn
from starlette.types import ASGIApp

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.preflight import LOOPBACK, no_loopback
from evopolicy_common.records.blobs import write_atomically
from evopolicy_gateway.http.listener import Listener
from evopolicy_gateway.http.timeouts import TimedProtocol
from evopolicy_gateway.run.layout import RunFolder, save, saved
from evopolicy_gateway.workspace.agents_md import Urls, urls_at, urls_below

_REBIND_TRIES = 20
_REBIND_PAUSE_S = 0.25
KEEP_ALIVE_S = 30
CLOSE_GRACE_S = 1


class Address(msgspec.Struct, frozen=True, kw_only=True):
    """A run's service address, kept across restarts."""

    host: str
    port: int
    token: str
    """128 random bits, hex: the first part of every path."""
    bearer: str = ""
    """256 random bits, hex, required in every request; empty on loopback without a `Listener`."""
    url: str = ""
    """URL for the agent; empty for `http://host:port`."""

    def urls(self) -> Urls:
        if self.url:
            return urls_below(self.url, self.token, bearer=bool(self.bearer))
        found = urls_at(self.host, self.port, self.token)
        return msgspec.structs.replace(found, bearer=bool(self.bearer))


async def bind(folder: RunFolder) -> tuple[socket.socket, Address]:
    """Returns a bound socket, on the port of the last start or else on a free one, which is saved for the next start.

    Raises ConfigError when the saved or the requested port is not available.
    """
    if folder.service.exists():
        address = saved(folder.service, Address)
        return await _rebind(address), address
    token = secrets.token_hex(16)
    if not folder.listener.exists():
        try:
            sock = bound(LOOPBACK, 0)
        except OSError as error:
            raise ConfigError(no_loopback(error)) from error
        address = Address(host=LOOPBACK, port=sock.getsockname()[1], token=token)
    else:
        listener = saved(folder.listener, Listener)
        try:
            sock = bound(listener.host, listener.port)
        except OSError as error:
            where = f"{listener.host}:{listener.port}"
            raise ConfigError(f"--http {where}: cannot listen there: {error.strerror or error}") from error
        bearer = secrets.token_hex(32)
        address = Address(
            host=listener.host, port=sock.getsockname()[1], token=token, bearer=bearer, url=listener.url
        )
        write_atomically(folder.bearer, f"{bearer}\n".encode(), mode=0o600)
    save(folder.service, address)
    return sock, address


@contextlib.asynccontextmanager
async def serving(app: ASGIApp, sock: socket.socket) -> AsyncIterator[asyncio.Task[None]]:
    """Serves `app` inside the `async with`; the task ends early only when the service fails."""
    config = uvicorn.Config(
        app,
        http=TimedProtocol,
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        backlog=64,
        limit_concurrency=256,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=CLOSE_GRACE_S,
        h11_max_incomplete_event_size=32 << 10,
    )
    # It warns of every request that it cannot read, of which an agent can send thousands a second.
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
    server = _Server(config)
    sock.listen(config.backlog)  # connections queue from here on, before the server accepts them
    task = asyncio.create_task(server.serve(sockets=[sock]), name="http")
    try:
        yield task
    finally:
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)
        sock.close()


class _Server(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leaves signals to the process, so that a submit in flight is left in order."""
        yield


async def _rebind(address: Address) -> socket.socket:
    for _ in range(_REBIND_TRIES):
        try:
            return bound(address.host, address.port)
        except OSError as error:
            reason = error
        await asyncio.sleep(_REBIND_PAUSE_S)
    raise ConfigError(
        f"port {address.port} on {address.host}, which is the address of this run's agent, cannot be used: {reason.strerror};"
        " end what listens there and start the gateway again"
    )


def bound(host: str, port: int) -> socket.socket:
    """A bound socket. Raises OSError when the address is not available."""
    family, kind, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    sock = socket.socket(family, kind)
    # Allows binding while old connections to the address are in TIME_WAIT.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind(where)
    except OSError:
        sock.close()
        raise
    return sock
