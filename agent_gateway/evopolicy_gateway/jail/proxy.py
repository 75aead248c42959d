"""Network access of a jailed program: the agent supervisor serves the ports of its network namespace.

A forwarded port leads to the same port of this machine. The proxy port accepts `CONNECT HOST:PORT` for the allowed
hosts only; it resolves names outside the jail, since a jail has no name service.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Mapping
from functools import partial

from evopolicy_common.logs import log
from evopolicy_gateway.jail.settings import Host

PROXY_PORT = 3128
MAX_CONNECTIONS = 256
"""Most simultaneous connections of one program."""
MAX_DENIED_LOGGED = 100
"""Most different hosts that are logged as not allowed."""
_MAX_HEAD_BYTES = 16 << 10
_HEAD_TIMEOUT_S = 30.0
_CONNECT_TIMEOUT_S = 60.0
_CHUNK = 64 << 10


class JailProxy:
    """The network access of one jailed program. Call `close` once the program has ended."""

    def __init__(self, forwards: Mapping[int, Host], hosts: frozenset[Host]) -> None:
        self._forwards = dict(forwards)
        self._hosts = hosts
        free = PROXY_PORT
        while free in self._forwards:
            free += 1
        self.proxy_port = free
        self._servers: list[asyncio.Server] = []
        self._connections: set[asyncio.Task[None]] = set()
        self._denied: set[str] = set()

    @property
    def ports(self) -> tuple[int, ...]:
        """Ports on which to listen in the jail, in the order in which `serve` expects the sockets."""
        return (*self._forwards, self.proxy_port)

    async def serve(self, control: socket.socket) -> None:
        """Serves the listening sockets of the jail; returns if the program ended before sending them."""
        loop = asyncio.get_running_loop()
        control.setblocking(False)
        ready = asyncio.Event()
        loop.add_reader(control, ready.set)
        try:
            await ready.wait()
        finally:
            loop.remove_reader(control)
        _, fds, _, _ = socket.recv_fds(control, 1, len(self.ports))
        for port, fd in zip(self.ports, fds, strict=False):
            sock = socket.socket(fileno=fd)
            sock.setblocking(False)
            accept = partial(self._accept, port)
            self._servers.append(await asyncio.start_server(accept, sock=sock, limit=_MAX_HEAD_BYTES))

    async def close(self) -> None:
        for server in self._servers:
            server.close()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    def _accept(self, port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._connections) >= MAX_CONNECTIONS:
            writer.close()
            return
        task = asyncio.ensure_future(self._connection(port, reader, writer))
        self._connections.add(task)
        task.add_done_callback(self._connections.discard)

    async def _connection(
        self, port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            if port in self._forwards:
                await _join(reader, writer, self._forwards[port])
            else:
                await self._proxy(reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            writer.close()

    async def _proxy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_HEAD_TIMEOUT_S):
            head = await reader.readuntil(b"\r\n\r\n")
        words = head.partition(b"\r\n")[0].decode("latin-1").split()
        if len(words) != 3 or words[0] != "CONNECT":
            await _refuse(writer, "405 Method Not Allowed", "only CONNECT is served here")
            return
        name, _, port = words[1].rpartition(":")
        wanted = (name.lower(), int(port) if port.isdecimal() and port.isascii() and len(port) <= 5 else 0)
        if wanted not in self._hosts:
            self._log_denied(words[1][:200])
            await _refuse(writer, "403 Forbidden", f"{words[1][:200]} is not allowed in this run")
            return
        try:
            await _join(reader, writer, wanted, b"HTTP/1.1 200 Connection established\r\n\r\n")
        except _UnreachableError as error:
            await _refuse(writer, "502 Bad Gateway", str(error))

    def _log_denied(self, host: str) -> None:
        # Once: an agent can ask thousands of times a second, and the log is not in its jail.
        if host not in self._denied and len(self._denied) < MAX_DENIED_LOGGED:
            self._denied.add(host)
            log.warning("the agent asked for a host that it may not reach", host=host)


class _UnreachableError(OSError):
    pass


async def _refuse(writer: asyncio.StreamWriter, status: str, why: str) -> None:
    body = f"{why}\n".encode()
    head = f"HTTP/1.1 {status}\r\ncontent-length: {len(body)}\r\nconnection: close\r\n\r\n"
    writer.write(head.encode() + body)
    await writer.drain()


async def _join(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, to: Host, greeting: bytes = b""
) -> None:
    """Copies bytes in both directions until both sides have ended."""
    try:
        async with asyncio.timeout(_CONNECT_TIMEOUT_S):
            there, away = await asyncio.open_connection(*to)
    except (OSError, TimeoutError) as error:
        raise _UnreachableError(f"{to[0]}:{to[1]} cannot be reached") from error
    try:
        writer.write(greeting)
        async with asyncio.TaskGroup() as group:
            group.create_task(_copy(reader, away))
            group.create_task(_copy(there, writer))
    except* OSError:
        pass
    finally:
        away.close()


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    while data := await source.read(_CHUNK):
        target.write(data)
        await target.drain()
    with contextlib.suppress(OSError):
        target.write_eof()
