"""Connections to the provider: a request goes out, and its answer comes in as bytes.

httpcore, the part of httpx below its client, does the work. The client would build, copy and check every
request and answer once more, for redirects, cookies and logins that a relay does not want; that took a sixth
of the relay's processor time.
"""

from __future__ import annotations

import base64
import contextlib
from collections.abc import AsyncIterator, Mapping
from typing import NamedTuple
from urllib.parse import unquote, urlsplit
from urllib.request import getproxies, proxy_bypass

import httpcore
import httpx

FAILED = (
    httpcore.NetworkError,
    httpcore.ProtocolError,
    httpcore.ProxyError,
    httpcore.TimeoutException,
    httpcore.UnsupportedProtocol,
)
"""Errors of a request or its answer."""
NOT_SENT = (
    *(httpcore.ConnectError, httpcore.ConnectTimeout, httpcore.PoolTimeout),
    *(httpcore.ProxyError, httpcore.UnsupportedProtocol),
)
"""Those of a request that did not reach the provider."""
_CONNECT_S = 30.0
_KEEP_ALIVE_S = 60.0
_HERE = ("localhost", "127.0.0.1", "::1")


class Sent(NamedTuple):
    name: str
    """`apis.Route.name`."""
    method: str
    url: str
    headers: Mapping[str, str]
    body: bytes


class Answer(NamedTuple):
    """An answer whose body is still to come."""

    status: int
    headers: Mapping[str, str]
    """By names in lower case."""
    pieces: AsyncIterator[bytes]
    """The body, as it comes. Raises `FAILED`."""


class Provider:
    """Connections to one API, which stay open between requests."""

    def __init__(self, base_url: str, timeout_s: float) -> None:
        """`timeout_s`: longest time without a byte. The proxy of the variables (`HTTPS_PROXY`, …) is used,
        unless `NO_PROXY` names the host; it does not lead to this machine."""
        parts = urlsplit(base_url)
        host = parts.hostname or ""
        proxies = {} if host in _HERE or proxy_bypass(host) else getproxies()
        proxy = proxies.get(parts.scheme) or proxies.get("all")
        self._pool = httpcore.AsyncConnectionPool(
            ssl_context=httpx.create_ssl_context()
            if "https" in (parts.scheme, urlsplit(proxy or "").scheme)
            else None,
            proxy=_proxy(proxy) if proxy else None,
            max_connections=None,
            keepalive_expiry=_KEEP_ALIVE_S,
        )
        # Compressed answers would have to be unpacked to be counted.
        self._usual = {"accept": "*/*", "accept-encoding": "identity", "user-agent": "evopolicy"}
        if parts.username:
            login = f"{unquote(parts.username)}:{unquote(parts.password or '')}".encode()
            self._usual["authorization"] = f"Basic {base64.b64encode(login).decode()}"
        connect_s = min(_CONNECT_S, timeout_s)
        waits = {"connect": connect_s, "read": timeout_s, "write": timeout_s, "pool": timeout_s}
        self._extensions = {"timeout": waits}

    async def close(self) -> None:
        await self._pool.aclose()

    @contextlib.asynccontextmanager
    async def sent(self, sent: Sent) -> AsyncIterator[Answer]:
        """Sends a request; raises `FAILED`. The answer ends with the `with`."""
        wanted = [(name.encode(), _encoded(value)) for name, value in {**self._usual, **sent.headers}.items()]
        async with self._pool.stream(
            sent.method, sent.url, headers=wanted, content=sent.body, extensions=self._extensions
        ) as response:
            names = [(name.decode("latin-1").lower(), value) for name, value in response.headers]
            headers = {name: value.decode("latin-1") for name, value in names}
            yield Answer(response.status, headers, response.aiter_stream())


def _encoded(value: str) -> bytes:
    try:
        return value.encode("latin-1")
    except UnicodeEncodeError:
        return value.encode()


def _proxy(url: str) -> httpcore.Proxy:
    parts = urlsplit(url)
    login = (unquote(parts.username), unquote(parts.password or "")) if parts.username else None
    return httpcore.Proxy(f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}", auth=login)
