"""The relay's connections to the provider: logins in addresses, the operator's proxy, headers of any kind."""

from __future__ import annotations

import asyncio

import pytest

from evopolicy_gateway.relay.provider import Provider


def asked(monkeypatch: pytest.MonkeyPatch, base: str, proxy: str, no_proxy: str = "") -> list[bytes]:
    """The head of a request to `base`, as the server on loopback gets it that stands at `{}` in both
    addresses."""
    heads: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heads.append(await reader.readuntil(b"\r\n\r\n"))
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\nX-Odd: \xe9\r\n\r\nok")
        writer.close()

    async def main() -> None:
        server = await asyncio.start_server(serve, "0.0.0.0", 0)
        port = server.sockets[0].getsockname()[1]
        for name, value in {"http_proxy": proxy.format(port), "no_proxy": no_proxy}.items():
            monkeypatch.setenv(name, value)
            monkeypatch.delenv(name.upper(), raising=False)
        url = base.format(port)
        provider = Provider(url, 10.0)
        async with provider.sent("POST", f"{url}/responses", {"x-team": "é"}, b"{}") as answer:
            assert (answer.status, answer.headers["x-odd"]) == (200, "é")
            assert b"".join([piece async for piece in answer.pieces()]) == b"ok"
        await provider.close()
        server.close()

    asyncio.run(main())
    return heads[0].split(b"\r\n")


def test_a_login_in_the_address_becomes_a_header(monkeypatch: pytest.MonkeyPatch) -> None:
    head = asked(monkeypatch, "http://me:p%40ss@localhost:{}/v1", "http://127.0.0.1:1")
    assert head[0] == b"POST /v1/responses HTTP/1.1"
    lines = {line.lower() for line in head}
    assert {b"authorization: basic bwu6cebzcw==", b"x-team: \xe9", b"content-length: 2"} <= lines
    assert {b"accept-encoding: identity", b"user-agent: evopolicy"} <= lines


def test_the_operators_proxy_leads_elsewhere_but_not_here(monkeypatch: pytest.MonkeyPatch) -> None:
    head = asked(monkeypatch, "http://model.invalid/v1", "http://me:pw@127.0.0.1:{}")
    assert head[0] == b"POST http://model.invalid/v1/responses HTTP/1.1"
    assert b"proxy-authorization: basic bwu6chc=" in {line.lower() for line in head}
    # Loopback, and hosts of `no_proxy`, are reached without it: port 1 answers nothing.
    asked(monkeypatch, "http://127.0.0.1:{}/v1", "http://127.0.0.1:1")
    asked(monkeypatch, "http://127.0.0.2:{}/v1", "http://127.0.0.1:1", "127.0.0.2")
