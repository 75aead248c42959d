"""The HTTP service on a loopback port, the same port and token after every restart."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
from collections.abc import AsyncIterator, Iterator

import msgspec
import uvicorn
from starlette.types import ASGIApp

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.agents_md import Urls, urls_at
from evopolicy_gateway.layout import RunFolder, save

LOOPBACK = "127.0.0.1"
_REBIND_TRIES = 20
_REBIND_PAUSE_S = 0.25


class Address(msgspec.Struct, frozen=True, kw_only=True):
    """Where a run's service is, kept through restarts."""

    host: str
    port: int
    token: str
    """128 random bits, hex: the first part of every path."""

    def urls(self) -> Urls:
        return urls_at(self.host, self.port, self.token)


async def bind(folder: RunFolder) -> tuple[socket.socket, Address]:
    """A bound socket: on the port of the last time, or on a free one and then noted for the next time.

    ConfigError when the old port is not to be had.
    """
    if folder.service.exists():
        address = msgspec.json.decode(folder.service.read_bytes(), type=Address)
        return await _rebind(address), address
    sock = _bound(LOOPBACK, 0)
    address = Address(host=LOOPBACK, port=sock.getsockname()[1], token=secrets.token_hex(16))
    save(folder.service, address)
    return sock, address


@contextlib.asynccontextmanager
async def serving(app: ASGIApp, sock: socket.socket) -> AsyncIterator[asyncio.Task[None]]:
    """Serves `app` inside the `async with`; the task ends early only when the service failed."""
    config = uvicorn.Config(
        app,
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        backlog=64,
        limit_concurrency=256,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=32 << 10,
    )
    server = _Server(config)
    sock.listen(config.backlog)  # from here on nobody is refused, whenever the server gets to it
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
        """Leaves signals to the process: a submit in flight must be left in order."""
        yield


async def _rebind(address: Address) -> socket.socket:
    for _ in range(_REBIND_TRIES):
        try:
            return _bound(address.host, address.port)
        except OSError as error:
            reason = error
        await asyncio.sleep(_REBIND_PAUSE_S)
    raise ConfigError(
        f"port {address.port} on {address.host}, which this run's agent knows, is taken: {reason.strerror};"
        " end what listens there and start the gateway again"
    )


def _bound(host: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    # An address whose last connections are still in TIME_WAIT must be had again at once.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((host, port))
    except OSError:
        sock.close()
        raise
    return sock
