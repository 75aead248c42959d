"""The HTTP server of all rooms: `uvicorn` with limits on connections and on slow clients.

- A request's headers must arrive within `HEADERS_WAIT_S` of its first byte, those of the first request within
  `HEADERS_WAIT_S` of the connection.
- A client must resume reading an answer within `ANSWER_WAIT_S` after it has stopped.
- The application limits the time of a body, and `KEEP_ALIVE_S` the pause between two requests.
- Beyond `MAX_CONNECTIONS`, a new connection replaces the oldest one without a complete request. If all others have one,
  requests are answered with status 503.

A late client is disconnected without an answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADERS_WAIT_S = 20.0
ANSWER_WAIT_S = 60.0
KEEP_ALIVE_S = 30
CLOSE_GRACE_S = 1
MAX_CONNECTIONS = 256


def bound(host: str, port: int) -> socket.socket:
    """A bound socket, of IPv4 where the host has both. Raises OSError when the address is not available."""
    addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    family, kind, _, _, where = min(addresses, key=lambda each: each[0] != socket.AF_INET)
    sock = socket.socket(family, kind)
    # Allows binding while old connections to the address are in TIME_WAIT.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind(where)
    except OSError:
        sock.close()
        raise
    return sock


@contextlib.asynccontextmanager
async def serving(
    app: ASGIApp, sock: socket.socket, *, certificate: Path | None = None
) -> AsyncIterator[asyncio.Task[None]]:
    """Serves `app` inside the `async with`, and closes `sock`; the task ends early only when the service
    fails. Raises OSError when the address is taken by another listener."""
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
        limit_concurrency=MAX_CONNECTIONS,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=CLOSE_GRACE_S,
        h11_max_incomplete_event_size=32 << 10,
        ssl_certfile=certificate,
    )
    # It warns of every request that it cannot read, of which a client can send thousands a second.
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
        """Leaves signals to the process."""
        yield


class TimedProtocol(H11Protocol):
    _made_at = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._made_at = self.loop.time()
        self._start_timer("headers", HEADERS_WAIT_S)
        others = [each for each in self.connections if isinstance(each, TimedProtocol) and each is not self]
        alive = [each for each in others if not each.transport.is_closing()]
        idle = [each for each in alive if each.cycle is None or each.cycle.response_complete]
        # One less than the server's own limit, which counts this one and refuses what it makes full.
        if idle and len(alive) + 2 > MAX_CONNECTIONS:
            min(idle, key=lambda each: each._made_at)._cut_off()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._start_timer("headers", HEADERS_WAIT_S)
        else:
            self._stop_timer("headers")

    def on_response_complete(self) -> None:
        # Read before the next request, which may have arrived already, changes the state.
        unread = self.conn.their_state is h11.SEND_BODY
        super().on_response_complete()
        if unread:
            # The request has its answer, so the rest of its body will never be read.
            self.transport.close()
            self._start_timer("headers", HEADERS_WAIT_S)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._start_timer("answer", ANSWER_WAIT_S)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stop_timer("answer")

    def timeout_keep_alive_handler(self) -> None:
        # A client that has not read its answer by now is not going to.
        if self.transport.get_write_buffer_size():
            self._cut_off()
        else:
            super().timeout_keep_alive_handler()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer("headers")
        self._stop_timer("answer")
        super().connection_lost(exc)

    def _cut_off(self) -> None:
        self.transport.abort()

    def _start_timer(self, name: str, wait_s: float) -> None:
        # Once per request: a client that sends single bytes gains no time.
        if name not in self._timers:
            self._timers[name] = self.loop.call_later(wait_s, self._cut_off)

    def _stop_timer(self, name: str) -> None:
        if timer := self._timers.pop(name, None):
            timer.cancel()
