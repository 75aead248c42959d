"""A relay between an HTTP client and a model API on loopback."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx

from evopolicy_common.wire.http import bound, serving
from evopolicy_gateway.relay.apis import Protocol, Upstream
from evopolicy_gateway.relay.limits import Used, read_ledger
from evopolicy_gateway.relay.service import Relay, RelaySetup
from stages.model_api import ModelApi, Step

NOON = 1768564800.0
"""2026-01-16 12:00:00 UTC."""
KEY = "sk-the-real-key-0123456789"
TOKEN = "token-of-the-run-0123456789"
GEMINI = "models/m:generateContent"
PATHS = {
    "chat/completions": "openai",
    "responses": "openai",
    "messages": "anthropic",
    GEMINI: "google",
    "models/m:streamGenerateContent?alt=sse": "google",
}


class Served:
    """A running relay, with what it reported."""

    def __init__(self, ledger: Path, api: ModelApi) -> None:
        self.ledger, self.api = ledger, api
        self.notes: list[str] = []
        self.spent: list[str] = []
        self.client: httpx.AsyncClient
        self.port = 0

    @property
    def used(self) -> Used:
        return read_ledger(self.ledger)

    async def ask(self, path: str = "chat/completions", **more: Any) -> httpx.Response:
        """Asks for a small answer, with one tool."""
        function = {"name": "bash", "parameters": {}}
        usual: dict[str, Any] = {"model": "m", "stream": True}
        if path == "chat/completions":
            usual |= {"messages": [], "tools": [{"type": "function", "function": function}]}
        elif path == "responses":
            usual |= {"input": [], "tools": [{"type": "function", **function}]}
        elif path == "messages":
            usual |= {"messages": [], "max_tokens": 9000, "tools": [{"name": "bash", "input_schema": {}}]}
        else:
            usual = {"contents": [], "tools": [{"functionDeclarations": [function]}]}
        version = "v1beta" if path.startswith("models/") else "v1"
        return await self.client.post(f"/{version}/{path}", json={**usual, **more})


@asynccontextmanager
async def relay(
    tmp_path: Path, script: list[Step], protocol: Protocol = "openai", **more: Any
) -> AsyncIterator[Served]:
    """A relay to an API that plays the script; `more`: of its order."""
    with ModelApi(script) as api:
        served = Served(tmp_path / "ledger.jsonl", api)
        base = f"{api.base_url}/v1" if protocol == "openai" else api.base_url
        given = {"base_url": base, "key": KEY, **more.pop("upstream", {})}
        upstream = Upstream(protocol=protocol, **given)
        order = RelaySetup(upstream=upstream, token=TOKEN, ledger=str(served.ledger), **more)
        app = Relay(
            order, counted=lambda: None, note=served.notes.append, spent=served.spent.append, now=lambda: NOON
        )
        sock = bound("127.0.0.1", 0)
        served.port = sock.getsockname()[1]
        async with serving(app, sock):
            headers = {"authorization": f"Bearer {TOKEN}"}
            url = f"http://127.0.0.1:{served.port}"
            async with httpx.AsyncClient(
                base_url=url, headers=headers, trust_env=False, timeout=60.0
            ) as served.client:
                yield served
        await app.close()


def asked(
    tmp_path: Path, script: list[Step], *bodies: dict[str, Any], path: str = "chat/completions", **more: Any
) -> tuple[list[httpx.Response], Served]:
    """The relay's answers to requests one after another, and the relay, which has ended."""

    async def ask() -> tuple[list[httpx.Response], Served]:
        async with relay(tmp_path, script, **{"protocol": PATHS.get(path, "openai"), **more}) as served:
            return [await served.ask(path, **body) for body in bodies], served

    return asyncio.run(ask())
