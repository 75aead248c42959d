"""The model APIs that the relay serves: their paths, the place of their keys, and the form of their errors. No I/O."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple
from urllib.parse import urlencode, urlsplit

import msgspec

Protocol = Literal["openai", "anthropic", "google"]


_PASSED_QUERY = ("beta", "client_version", "limit")


class Upstream(msgspec.Struct, frozen=True, kw_only=True):
    """A provider's API, with the key."""

    protocol: Protocol
    base_url: str
    """As the vendor's library takes it: OpenAI's with `/v1`, Anthropic's without."""
    key: str = ""
    key_header: str = ""
    """Header with the key; empty: the protocol's own. `authorization` takes it as a bearer token."""
    headers: dict[str, str] = {}
    query: dict[str, str] = {}

    def url(self, path: str, asked: Mapping[str, str]) -> str:
        """The address of an API by its path below the base, such as `responses`. `asked`: the agent's query."""
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
        name = self.key_header.lower() or {"openai": "authorization", "anthropic": "x-api-key"}[self.protocol]
        return {**self.headers, name: f"Bearer {self.key}" if name == "authorization" else self.key}


METERED: dict[Protocol, tuple[str, ...]] = {
    "openai": ("chat/completions", "responses"),
    "anthropic": ("messages",),
}
"""Paths of requests that cost tokens, after `v1/`."""
FREE: dict[Protocol, tuple[str, ...]] = {
    "openai": ("models",),
    "anthropic": ("models", "messages/count_tokens"),
}
"""Paths of requests that cost nothing; they pass on uncounted."""


_CLIENTS_TOOLS = re.compile(
    r"function|custom|namespace|tool_search|(local_)?shell|apply_patch|(computer|bash|text_editor|memory)(_.*)?"
)
"""Types of tools that the agent runs itself, in OpenAI's and Anthropic's requests."""

_HOSTED = ("mcp_servers", "plugins", "prompt", "web_search_options")
"""Other fields of a request that let the provider run tools; a stored `prompt` may have some."""


def hosted_tools(request: Mapping[str, Any]) -> list[str]:
    """The kinds of tools in a request that the provider runs, such as `web_search`, without the version of
    Anthropic's; a kind that is not known counts as one of these."""
    tools = request.get("tools")
    kinds = [
        str(tool.get("type") or "custom")
        for tool in (tools if isinstance(tools, list) else ())
        if isinstance(tool, dict)
    ]
    kinds += [name for name in _HOSTED if request.get(name)]
    return sorted({re.sub(r"_\d{8}$", "", kind) for kind in kinds if not _CLIENTS_TOOLS.fullmatch(kind)})


_PASSED_UP = ("content-type", "accept", "user-agent", "openai-beta", "session_id", "originator", "version")
_PASSED_UP_FROM = ("anthropic-", "x-stainless-", "x-codex-")
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


class Refusal(NamedTuple):
    """An error that the relay answers itself, in the words of each protocol."""

    status: int
    openai: tuple[str, str]
    """`type` and `code`."""
    anthropic: str
    """`type`."""

    def body(self, protocol: Protocol, message: str) -> bytes:
        error: dict[str, Any]
        if protocol == "openai":
            kind, code = self.openai
            error = {"error": {"message": message, "type": kind, "param": None, "code": code}}
        else:
            error = {"type": "error", "error": {"type": self.anthropic, "message": message}}
        return json.dumps(error).encode()


_INVALID = ("invalid_request_error", "invalid_request")
SPENT = Refusal(400, ("billing_limit_user_error", "billing_hard_limit_reached"), "invalid_request_error")
"""As OpenAI and Anthropic refuse an account without money: clients do not try again."""
NO_TOKEN = Refusal(401, ("invalid_request_error", "invalid_api_key"), "authentication_error")
OTHER_MODEL = Refusal(404, ("invalid_request_error", "model_not_found"), "not_found_error")
NO_PATH = Refusal(404, ("invalid_request_error", "unknown_url"), "not_found_error")
INVALID = Refusal(400, _INVALID, "invalid_request_error")
TOO_SLOW = Refusal(408, _INVALID, "invalid_request_error")
TOO_LARGE = Refusal(413, _INVALID, "request_too_large")
COMPRESSED = Refusal(415, _INVALID, "invalid_request_error")
TOO_MANY = Refusal(429, ("requests", "rate_limit_exceeded"), "rate_limit_error")
UNREACHABLE = Refusal(502, ("server_error", "server_error"), "api_error")
