"""The built-in LLM agent (`agents/llm/`) as a CLI: it prints Claude Code's stream, so its turns are read as those.

It gets the relay's token on stdin, and its memory is closed to its commands, which therefore use the model only through
it. The API's key stays outside its jail.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.installation import add_extra
from evopolicy_gateway.harnesses.coding_agents.claude_code import ClaudeReader
from evopolicy_gateway.harnesses.coding_agents.dialect import Dialect
from evopolicy_gateway.harnesses.interface.agent_config import PROVIDERS, AgentConfig, ApiTable
from evopolicy_gateway.inputs.declared import IN_JAIL, SKILL
from evopolicy_gateway.relay.usage import Prices

_FORM = "--agent llm:PROVIDER/MODEL"
_CLIENTS = {"openai": "openai", "anthropic": "anthropic", "google": "google-genai"}
"""Distribution of the vendor's library, by the family of APIs."""
_RETRIES = 4
"""Retries of one request by the vendor's library; a turn that fails after them is retried by the harness."""
_TIMEOUT_S = 600.0
"""Most time without a byte from the API, seconds."""


class Llm(Dialect):
    name = "llm"
    # -P: modules in the workspace, which the agent writes, must not shadow installed ones.
    program = (sys.executable, "-P", "-m", "evopolicy_gateway.agents.llm")
    makes_session_id = True
    takes_variables = False
    skills_at = f"{IN_JAIL}/skills"

    def __init__(self, config: AgentConfig) -> None:
        super().__init__(config)
        if config.api is None or not config.model:
            raise ConfigError(
                "harness llm needs `model` and a table [api] with a `provider` or a `base_url`; on the command line:"
                f" {_FORM}"
            )
        if config.mcp:
            raise ConfigError("harness llm starts no MCP servers; leave out [mcp], or use another harness")
        self._api: ApiTable = config.api
        self.packages = ("pydantic-ai-slim", _CLIENTS[self._api.protocol])
        for name in self.packages:
            with_extra = f"the agent llm needs the package {name}: {add_extra('llm')}"
            try:
                metadata.version(name)
            except metadata.PackageNotFoundError:
                raise ConfigError(with_extra) from None

    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        api = self._api
        version = "/v1" if api.protocol == "openai" else ""
        settings: dict[str, Any] = {
            "provider": api.provider or "compatible",
            "api": api.spoken,
            "model": self.config.model,
            "base_url": api.url if self.relay is None else f"{self.relay.url}{version}",
            "system": api.system,
            "skills": [
                f"{self.config.skills_at or self.skills_at}/{name}/{SKILL}" for name in self.kept.skills
            ],
            "effort": self.config.effort,
            "variable": api.variable,
            "parameters": api.parameters,
            "max_output_tokens": api.max_output_tokens,
            "context_tokens": api.context_tokens,
            "retries": _RETRIES,
            "timeout_s": _TIMEOUT_S,
        }
        words = ["--settings", json.dumps(settings), "--session", session or ""]
        return [*words, *(["--resume"] if resume else []), *self.config.extra_args]

    def stdin(self, prompt: str) -> str:
        key = os.environ.get(self._api.variable, "") if self.relay is None else self.relay.token
        return json.dumps({"key": key, "prompt": prompt})

    def version_in(self, text: str) -> str | None:
        return text.strip() or None

    def reader(self) -> ClaudeReader:
        return ClaudeReader()


def config_of(rest: str) -> AgentConfig:
    """The settings behind `--agent llm:PROVIDER/MODEL`. Raises ConfigError for anything else."""
    provider, slash, model = rest.partition("/")
    if provider not in PROVIDERS or not slash or not model:
        raise ConfigError(
            f"--agent llm:{rest}: write {_FORM}, with PROVIDER one of {', '.join(PROVIDERS)}; for another server, use"
            ' --agent file:AGENT.toml with harness = "llm" and a table [api] with its base_url'
        )
    api = msgspec.convert({"provider": provider}, ApiTable)
    return AgentConfig(harness="llm", model=model, api=api)


def prices_of(config: AgentConfig) -> Prices | None:
    """The prices in the settings, else the list prices of the built-in agent's provider at its own address."""
    api = config.api
    if config.prices is not None or config.harness != Llm.name or api is None or api.base_url:
        return config.prices
    provider = {"moonshot": "moonshotai"}.get(api.provider or "", api.provider or "")
    return listed_prices(provider, config.model or "")


@functools.cache
def listed_prices(provider: str, model: str) -> Prices | None:
    """A provider's list prices in the library genai-prices, of the smallest tier; None where they are not known."""
    try:
        from genai_prices.data_snapshot import get_snapshot

        known = (
            get_snapshot().find_provider_model(model, None, provider, None)[1].get_prices(datetime.now(UTC))
        )
    except (ImportError, LookupError):
        return None
    fields = ("input_mtok", "output_mtok", "cache_read_mtok", "cache_write_mtok")
    listed = [getattr(known, field) for field in fields]
    # A cached token without a price of its own costs as much as another.
    given, answered, *cached = [None if one is None else float(getattr(one, "base", one)) for one in listed]
    if given is None or answered is None:
        return None
    read, created = (given if one is None else one for one in cached)
    return Prices(input=given, output=answered, cache_read=read, cache_creation=created)
