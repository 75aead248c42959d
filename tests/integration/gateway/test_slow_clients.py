"""Clients that take their time are cut off, while others are served."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

import pytest
from gateway_double import Served, served

from evopolicy_common.wire import http as server
from evopolicy_gateway.http import service as http

SHORT_S = 0.5
TIMEOUT_S = 60.0


@asynccontextmanager
async def living(tmp_path: Path) -> AsyncIterator[Served]:
    """A gateway that still answers afterwards."""
    async with served(tmp_path) as service:
        yield service
        assert (await service.http.get(service.urls.info)).status_code == 200


async def drip(address: SplitResult, start: bytes, drop: bytes) -> bytes:
    """Sends `start`, then `drop` again and again, until it is cut off; what was answered before."""
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    writer.write(start)

    async def send() -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                writer.write(drop)
                await writer.drain()
                await asyncio.sleep(SHORT_S / 10)

    sending = asyncio.create_task(send())
    answer = b""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            with contextlib.suppress(ConnectionError):
                while more := await reader.read(1 << 16):
                    answer += more
    finally:
        sending.cancel()
        writer.close()
    return answer


@pytest.mark.parametrize(
    ("start", "drop"),
    [(b"", b""), (b"G", b""), (b"GET / HTTP/1.1\r\nHost: x\r\n", b"X-A: b\r\n")],
    ids=["says nothing", "begins and stops", "drips its headers"],
)
async def test_headers_that_do_not_come_are_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: bytes, drop: bytes
) -> None:
    monkeypatch.setattr(server, "HEADERS_WAIT_S", SHORT_S)

    async with living(tmp_path) as s:
        slow = [drip(urlsplit(s.urls.info), start, drop) for _ in range(20)]
        answers = asyncio.gather(*slow)
        assert (await s.http.get(s.urls.info)).status_code == 200
        assert await answers == [b""] * 20


async def test_a_second_request_may_not_drip_either(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HEADERS_WAIT_S", SHORT_S)

    async with living(tmp_path) as s:
        address = urlsplit(s.urls.info)
        request = f"GET {address.path} HTTP/1.1\r\nHost: x\r\n\r\n".encode()
        answer = await drip(address, request + b"GET ", b"x")
        assert answer.count(b"HTTP/1.1 200") == 1


async def test_a_dripping_body_is_refused_uncharged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http, "BODY_WAIT_S", SHORT_S)
    monkeypatch.setattr(http, "LINGER", (1 << 20, SHORT_S))
    monkeypatch.setattr(server, "HEADERS_WAIT_S", SHORT_S)

    async with living(tmp_path) as s:
        address = urlsplit(s.urls.submit)
        head = f"POST {address.path} HTTP/1.1\r\nHost: x\r\nContent-Length: 500000\r\n\r\n".encode()
        answer = await drip(address, head, b" ")
        assert answer.startswith(b"HTTP/1.1 400")
        assert b"did not arrive" in answer
        assert s.double.submits == []


async def test_an_unread_answer_is_not_kept_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "ANSWER_WAIT_S", SHORT_S)

    async with living(tmp_path) as s:
        address = urlsplit(s.urls.task)
        request = f"GET {address.path} HTTP/1.1\r\nHost: x\r\n\r\n".encode()
        loop = asyncio.get_running_loop()
        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.setblocking(False)
            await loop.sock_connect(sock, (address.hostname, address.port))

            # Asks until nothing more goes in: its answers have filled every buffer on the way.
            async def ask() -> None:
                while True:
                    await loop.sock_sendall(sock, request * 100)

            with pytest.raises(ConnectionError):
                await asyncio.wait_for(ask(), TIMEOUT_S)
