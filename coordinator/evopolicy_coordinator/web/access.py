"""Access to the live view: tokens, cookies, and the checks of every request.

Rules that this module owns:
- A token is needed on loopback too, since an agent without a jail reaches loopback. It travels in the body of a
  sign-in, in a cookie or in an `Authorization` header, never in a path or a query, which logs and histories keep. The
  printed URL has it in its fragment, which browsers send to nobody.
- The pages read and change nothing, so that one token suffices.
- `Host` must be an address or a name of this server, else a page elsewhere could be made to resolve to it (DNS
  rebinding).
- A request that another site's page caused is refused, whatever cookies come with it.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.regular_files import read_given

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; connect-src"
    " 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content security policy of every page: no inline script or style, nothing from elsewhere."""
_HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
_OPEN = ("/login", "/static/", "/healthz")
"""Paths that need no token: they tell nothing."""
_HOST = re.compile(r"(?:\[(?P<six>[0-9A-Fa-f:.]+)\]|(?P<name>[A-Za-z0-9._-]+))(?::[0-9]{1,5})?")
"""The `Host` header; a browser sends names of other alphabets in ASCII."""


def drawn_token() -> str:
    return secrets.token_urlsafe(32)


def kept_token(path: Path) -> str:
    """The token in a file of mode 0600, which is made where it is not there. ConfigError for a file that is no such
    file."""
    try:
        if path.stat().st_mode & 0o077:
            raise ConfigError(f"--token-file {path} may be read by others: chmod 600 it")
        token = read_given(path, f"--token-file {path}").decode("ascii").strip()
    except FileNotFoundError:
        token = drawn_token()
        write_atomically(path, token.encode(), mode=0o600)
    except OSError as error:
        raise ConfigError(f"--token-file {path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise ConfigError(f"--token-file {path} holds no token; remove it, and it is created again") from None
    if len(token) < 32:
        raise ConfigError(
            f"--token-file {path}: a token of 32 characters or more is needed; remove it, and it is created again"
        )
    return token


class Access:
    """Decides about requests."""

    def __init__(self, token: str, *, names: Iterable[str] = (), cookie: str) -> None:
        """`names`: host names, beside addresses and localhost, under which browsers find this server."""
        self.cookie = cookie
        own = {socket.gethostname().lower(), *(name.lower() for name in names), "localhost"}
        self._names = frozenset(name.rstrip(".") for name in own if name)
        self._token = token
        # Derived from the token, so that it outlives a restart if the token does.
        self.cookie_value = hmac.new(token.encode(), b"evopolicy web cookie", hashlib.sha256).hexdigest()

    def admits_token(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self._token.encode())

    def admits(self, headers: Headers) -> bool:
        """Whether a request may read, by its cookie or its `Authorization`."""
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self.admits_token(token.strip())
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self.cookie)
        except CookieError:
            return False
        given = "" if morsel is None else morsel.value
        return hmac.compare_digest(given.encode(), self.cookie_value.encode())

    def is_own_host(self, host: str) -> bool:
        """Whether `Host` names this server: an address, which cannot be rebound, or one of its names."""
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        try:
            ipaddress.IPv6Address(match["six"]) if match["six"] else ipaddress.IPv4Address(match["name"])
        except ValueError:
            return not match["six"] and match["name"].lower().rstrip(".") in self._names
        return True

    def objection(self, scheme: str, method: str, headers: Headers) -> tuple[int, str] | None:
        """Why a request is refused before anything else is looked at; None for a good one."""
        host = headers.get("host", "")
        if not self.is_own_host(host):
            advice = "Use its address, or start it with --name for that name."
            return 421, f"This server is not called {host[:100]!r}. {advice}"
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "none")
        same = origin is not None and origin.lower() == f"{scheme}://{host}".lower()
        elsewhere = site not in ("same-origin", "none") and headers.get("sec-fetch-mode") != "navigate"
        if elsewhere or (origin is not None and not same):
            return 403, "The request comes from another site's page."
        if method not in ("GET", "HEAD") and not same and headers.get("authorization") is None:
            return 403, "The request has no origin."
        return None


class RequestGuard:
    """ASGI middleware: checks every request, and gives every answer its security headers."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        answer = self._refusal(scope)
        await (answer or self._app)(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers, path = Headers(scope=scope), str(scope["path"])
        if (objection := self._access.objection(scope["scheme"], scope["method"], headers)) is not None:
            return PlainTextResponse(objection[1] + "\n", objection[0])
        if self._access.admits(headers) or path in _OPEN or path.startswith("/static/"):
            return None
        if scope["method"] == "GET" and "text/html" in headers.get("accept", ""):
            return RedirectResponse("/login", 303)
        return PlainTextResponse(
            "Sign in with the token that `evopolicy web` prints.\n", 401, {"www-authenticate": "Bearer"}
        )
