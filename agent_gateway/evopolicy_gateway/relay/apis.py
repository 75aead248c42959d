"""The model APIs that the relay serves: their paths, the place of their keys, and the form of their errors. No I/O."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple
from urllib.parse import urlencode, urlsplit

import msgspec

Protocol = Literal["openai", "anthropic", "google"]


class _Vendor(NamedTuple):
    """A protocol's paths and key."""

    version: str
    """Begins the provider's paths; the agent may leave it out."""
    paths: str
    """Pattern of the paths after the version."""
    key_header: str


_VENDORS: dict[Protocol, _Vendor] = {
    "openai": _Vendor("", "chat/completions|responses|models", "authorization"),
    "anthropic": _Vendor("v1/", "messages|messages/count_tokens|models", "x-api-key"),
    "google": _Vendor(
        "v1beta/",
        r"models|models/(?P<model>[\w.-]+):(?P<method>generateContent|streamGenerateContent|countTokens)",
        "x-goog-api-key",
    ),
}
_FREE = ("models", "messages/count_tokens", "countTokens")
_PASSED_QUERY = ("alt", "beta", "client_version", "limit", "pageSize", "pageToken")


class Route(NamedTuple):
    path: str
    """At the provider, below the base URL."""
    name: str
    """The path without its version, by which a call is recorded."""
    api: str
    """Key of `answers.SHAPES` and `requests.RULES`, or the name of a path that is free."""
    free: bool
    """Whether its requests cost no tokens."""
    model: str | None
    """The model that the path names."""


class Upstream(msgspec.Struct, frozen=True, kw_only=True):
    protocol: Protocol
    base_url: str
    """As the vendor's library takes it: OpenAI's with `/v1`, the others' without a version."""
    key: str = ""
    key_header: str = ""
    """Header with the key; empty: the protocol's own. `authorization` takes it as a bearer token."""
    headers: dict[str, str] = {}
    query: dict[str, str] = {}

    def route(self, path: str) -> Route | None:
        """The route of a path at the relay; None for one that is not served."""
        vendor = _VENDORS[self.protocol]
        name = path.strip("/").removeprefix(vendor.version or "v1/")
        match = re.fullmatch(vendor.paths, name, re.ASCII)
        if match is None:
            return None
        found = match.groupdict()
        api = (found.get("method") or name).replace("streamGenerate", "generate")
        return Route(vendor.version + name, name, api, api in _FREE, found.get("model"))

    def url(self, path: str, asked: Mapping[str, str]) -> str:
        """The address of a `Route.path`. `asked`: the agent's query."""
        query = {name: asked[name] for name in _PASSED_QUERY if name in asked} | self.query
        return f"{self.base_url.rstrip('/')}/{path}" + (f"?{urlencode(query)}" if query else "")

    @property
    def shown(self) -> str:
        """The base URL without what may be secret in it."""
        parts = urlsplit(self.base_url)
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"

    def authorization(self) -> dict[str, str]:
        """The headers that the provider wants besides the agent's."""
        if not self.key:
            return dict(self.headers)
        name = self.key_header.lower() or _VENDORS[self.protocol].key_header
        return {**self.headers, name: f"Bearer {self.key}" if name == "authorization" else self.key}


KEY_HEADERS = ("x-api-key", "api-key", "x-goog-api-key")
"""Headers besides `authorization` in which an agent may send its token."""
_PASSED_UP = ("content-type", "accept", "user-agent", "openai-beta", "session_id", "originator", "version")
_PASSED_UP_FROM = ("anthropic-", "x-stainless-", "x-codex-", "x-goog-api-client")
_PASSED_DOWN = (
    "content-type",
    "retry-after",
    "retry-after-ms",
    "x-should-retry",
    "request-id",
    "x-request-id",
)
_PASSED_DOWN_FROM = ("anthropic-", "x-ratelimit-")


def passed_up(headers: Mapping[str, str]) -> dict[str, str]:
    """The agent's headers that go to the provider: none that chooses an account, a key or another form of the body."""
    return _chosen(headers, _PASSED_UP, _PASSED_UP_FROM)


def passed_down(headers: Mapping[str, str]) -> dict[str, str]:
    """The provider's headers that go to the agent."""
    return _chosen(headers, _PASSED_DOWN, _PASSED_DOWN_FROM)


def _chosen(headers: Mapping[str, str], names: tuple[str, ...], starts: tuple[str, ...]) -> dict[str, str]:
    lower = {name.lower(): value for name, value in headers.items()}
    return {name: value for name, value in lower.items() if name in names or name.startswith(starts)}


class RelayRefusal(NamedTuple):
    """An error that the relay answers itself, in the words of each protocol."""

    status: int
    openai: tuple[str, str]
    """`type` and `code`."""
    anthropic: str
    """`type`."""
    google: str
    """`status`."""

    def body(self, protocol: Protocol, message: str) -> bytes:
        kind, code = self.openai
        errors: dict[Protocol, Any] = {
            "openai": {"error": {"message": message, "type": kind, "param": None, "code": code}},
            "anthropic": {"type": "error", "error": {"type": self.anthropic, "message": message}},
            "google": {"error": {"code": self.status, "message": message, "status": self.google}},
        }
        return json.dumps(errors[protocol]).encode()


_WRONG = "invalid_request_error"
_INVALID = (_WRONG, "invalid_request")
SPENT = RelayRefusal(
    400, ("billing_limit_user_error", "billing_hard_limit_reached"), _WRONG, "FAILED_PRECONDITION"
)
"""As OpenAI and Anthropic refuse an account without money: clients do not try again."""
NO_TOKEN = RelayRefusal(401, (_WRONG, "invalid_api_key"), "authentication_error", "UNAUTHENTICATED")
OTHER_MODEL = RelayRefusal(404, (_WRONG, "model_not_found"), "not_found_error", "NOT_FOUND")
NO_PATH = RelayRefusal(404, (_WRONG, "unknown_url"), "not_found_error", "NOT_FOUND")
INVALID = RelayRefusal(400, _INVALID, _WRONG, "INVALID_ARGUMENT")
TOO_SLOW = RelayRefusal(408, _INVALID, _WRONG, "DEADLINE_EXCEEDED")
TOO_LARGE = RelayRefusal(413, _INVALID, "request_too_large", "INVALID_ARGUMENT")
COMPRESSED = RelayRefusal(415, _INVALID, _WRONG, "INVALID_ARGUMENT")
TOO_MANY = RelayRefusal(429, ("requests", "rate_limit_exceeded"), "rate_limit_error", "RESOURCE_EXHAUSTED")
UNREACHABLE = RelayRefusal(502, ("server_error", "server_error"), "api_error", "UNAVAILABLE")
