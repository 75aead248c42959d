"""The proxy of a jail: which requests lead out."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

import pytest

from evopolicy_gateway.jail import proxy
from evopolicy_gateway.jail.proxy import JailProxy
from evopolicy_gateway.jail.settings import Host


async def ask(
    request: bytes, hosts: frozenset[Host] = frozenset(), *, then: bytes = b"", ends: bool = True
) -> bytes:
    """The proxy's answer to a client that may leave its side open; the listening socket is handed over as a jail
    does it."""
    opened = JailProxy({}, hosts)
    here, there = socket.socketpair()
    listening = socket.create_server(("127.0.0.1", 0))
    socket.send_fds(there, [b"."], [listening.fileno()])
    await opened.serve(here)
    reader, writer = await asyncio.open_connection(*listening.getsockname())
    try:
        writer.write(request + then)
        if ends:
            writer.write_eof()
        return await asyncio.wait_for(reader.read(), 30)
    finally:
        writer.close()
        await opened.close()
        for sock in (here, there, listening):
            sock.close()


@pytest.mark.parametrize(
    ("request_line", "status"),
    [
        ("GET http://example.org/ HTTP/1.1", b"405"),
        ("CONNECT example.org:443", b"405"),
        ("CONNECT example.org:80 HTTP/1.1", b"403"),
        ("CONNECT example.org:4_43 HTTP/1.1", b"403"),
        ("CONNECT evil.example.org:443 HTTP/1.1", b"403"),
        ("CONNECT example.org.evil:443 HTTP/1.1", b"403"),
        ("CONNECT example.org HTTP/1.1", b"403"),
        ("CONNECT 127.0.0.1:443 HTTP/1.1", b"403"),
        (f"CONNECT example.org:{'4' * 5000} HTTP/1.1", b"403"),
    ],
)
async def test_anything_but_a_named_host_and_port_is_refused(request_line: str, status: bytes) -> None:
    hosts = frozenset({("example.org", 443)})
    answer = await ask(request_line.encode() + b"\r\n\r\n", hosts)
    assert answer.split()[1] == status


def test_a_forbidden_host_is_logged_once(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: list[str] = []
    monkeypatch.setattr(proxy.log, "warning", lambda text, host: logged.append(host))
    jail_proxy = JailProxy({}, frozenset())
    for k in range(300):
        jail_proxy._log_denied("example.org:443")
        jail_proxy._log_denied(f"{k}.example.org:443")
    assert logged[:2] == ["example.org:443", "0.example.org:443"]
    assert len(logged) == len(set(logged)) == proxy.MAX_DENIED_LOGGED


async def test_a_named_host_gets_the_bytes_and_answers() -> None:
    async def shout(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write((await reader.read()).upper())
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(shout, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server:
        request = f"CONNECT LocalHost:{port} HTTP/1.1\r\nhost: x\r\n\r\n".encode()
        answer = await ask(request, frozenset({("localhost", port)}), then=b"psst")
    assert answer.startswith(b"HTTP/1.1 200")
    assert answer.endswith(b"\r\n\r\nPSST")


async def test_a_named_host_that_is_away_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    request = f"CONNECT localhost:{port} HTTP/1.1\r\n\r\n".encode()
    assert (await ask(request, frozenset({("localhost", port)}))).split()[1] == b"502"


@pytest.mark.parametrize("sent", [b"x" * 100_000, b""], ids=["without end", "nothing"])
async def test_a_program_that_sends_no_head_is_hung_up_on(
    sent: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(proxy, "_HEAD_TIMEOUT_S", 0.2 if sent == b"" else 30.0)
    assert await ask(sent, ends=sent != b"") == b""


async def test_a_program_that_ended_before_it_passed_its_sockets_opens_no_listener() -> None:
    opened = JailProxy({}, frozenset())
    here, there = socket.socketpair()
    there.close()
    await asyncio.wait_for(opened.serve(here), 30)
    await opened.close()
    here.close()


async def test_a_named_host_that_does_not_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proxy, "_CONNECT_TIMEOUT_S", 0.2)
    connect = asyncio.open_connection

    async def to_nowhere(host: str, port: int, *more: Any) -> Any:
        if host == "example.org":
            await asyncio.sleep(1000)
        return await connect(host, port, *more)

    monkeypatch.setattr(asyncio, "open_connection", to_nowhere)
    request = b"CONNECT example.org:443 HTTP/1.1\r\n\r\n"
    assert (await ask(request, frozenset({("example.org", 443)}))).split()[1] == b"502"
