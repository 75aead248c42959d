"""The model of a conversation: pydantic-ai's class for its API, over the vendor's client.

A client retries a request by itself after rate limits, overload and lost connections, and honours `retry-after`. Only
the libraries of the API in use are imported.
"""

from __future__ import annotations

import contextlib
import json
import re
import ssl
from collections.abc import Awaitable, Callable
from functools import cache, partial
from typing import Any

import httpx2
from pydantic_ai.models import Model
from pydantic_ai.profiles import ModelProfile
from pydantic_ai.profiles.openai import OpenAIModelProfile
from pydantic_ai.settings import ModelSettings

from evopolicy_gateway.agents.llm import shell

Opened = tuple[Model[Any], ModelSettings]
_MAX_LISTED = 2000

_PROFILE = ModelProfile(thinking_tags=("\0", "\0"), ignore_streamed_leading_whitespace=False)
"""Text is not split at `<think>`, so that it goes back as it came."""
_WITHOUT_REASONING = re.compile(r"(chat)?gpt-[34]")


def opened(
    settings: dict[str, Any], key: str
) -> tuple[Model[Any], ModelSettings, Callable[[], Awaitable[list[str]]]]:
    """The model, the settings of each request, and a function that asks the server for the names of its models.
    `settings`: made by `harnesses/coding_agents/llm.py`."""
    http = httpx2.AsyncClient(
        timeout=settings["timeout_s"],
        trust_env=False,
        verify=_trusted(),
        event_hooks={"response": [_mended]},
    )
    opens = {"messages": _messages, "gemini": _gemini}.get(settings["api"], _openai)
    return (*opens(settings, key or "none", http), partial(_listed, settings, key, http))


@cache
def _trusted() -> ssl.SSLContext:
    """The certificates that are trusted, which take a tenth of a second to read."""
    trusted: ssl.SSLContext = httpx2.create_ssl_context(trust_env=False)
    return trusted


async def _listed(settings: dict[str, Any], key: str, http: httpx2.AsyncClient) -> list[str]:
    """The names of the server's models; none where it does not tell them."""
    version = {"messages": "/v1", "gemini": "/v1beta"}.get(settings["api"], "")
    headers = {"authorization": f"Bearer {key}", "x-api-key": key, "x-goog-api-key": key}
    if settings["api"] != "messages":
        del headers["x-api-key"]
    try:
        answer = await http.get(f"{settings['base_url'].rstrip('/')}{version}/models", headers=headers)
        document = answer.json()
        listed = document.get("data") or document.get("models") or []
        return [str(one.get("id") or one["name"]).removeprefix("models/") for one in listed[:_MAX_LISTED]]
    except (httpx2.HTTPError, ValueError, LookupError, TypeError, AttributeError):
        return []


def _messages(settings: dict[str, object], key: str, http: httpx2.AsyncClient) -> Opened:
    from anthropic import AsyncAnthropic
    from pydantic_ai.models.anthropic import AnthropicModel, AnthropicModelSettings
    from pydantic_ai.providers.anthropic import AnthropicProvider

    client = AsyncAnthropic(
        api_key=key, base_url=settings["base_url"], http_client=http, max_retries=settings["retries"]
    )
    model = AnthropicModel(
        settings["model"], provider=AnthropicProvider(anthropic_client=client), profile=_PROFILE
    )
    return model, AnthropicModelSettings(
        max_tokens=settings["max_output_tokens"],
        anthropic_cache_messages=True,
        anthropic_effort=settings["effort"],
        extra_body=settings["parameters"],
    )


def _gemini(settings: dict[str, Any], key: str, http: httpx2.AsyncClient) -> Opened:
    from google.genai import Client, types
    from pydantic_ai.models.google import GoogleModel, GoogleModelSettings
    from pydantic_ai.providers.google import GoogleProvider

    options = types.HttpOptions(
        base_url=settings["base_url"],
        httpx_async_client=http,
        timeout=int(settings["timeout_s"] * 1000),
        retry_options=types.HttpRetryOptions(attempts=settings["retries"] + 1),
        extra_body=settings["parameters"],
    )
    provider = GoogleProvider(client=Client(vertexai=False, api_key=key, http_options=options))
    model = GoogleModel(settings["model"], provider=provider, profile=_PROFILE)
    if not settings["effort"]:
        return model, GoogleModelSettings()
    return model, GoogleModelSettings(google_thinking_config={"thinking_level": settings["effort"]})


def _openai(settings: dict[str, Any], key: str, http: httpx2.AsyncClient) -> Opened:
    from openai import AsyncOpenAI
    from pydantic_ai.models.openai import OpenAIChatModel, OpenAIResponsesModel
    from pydantic_ai.models.openrouter import OpenRouterModel
    from pydantic_ai.providers.deepseek import DeepSeekProvider
    from pydantic_ai.providers.moonshotai import MoonshotAIProvider
    from pydantic_ai.providers.openai import OpenAIProvider
    from pydantic_ai.providers.openai_compatible import OpenAICompatibleProvider
    from pydantic_ai.providers.openrouter import OpenRouterProvider

    client = AsyncOpenAI(
        api_key=key, base_url=settings["base_url"], http_client=http, max_retries=settings["retries"]
    )
    known: dict[str, Any] = {"openai": OpenAIProvider, "deepseek": DeepSeekProvider}
    known |= {"moonshot": MoonshotAIProvider, "openrouter": OpenRouterProvider}
    name, compatible = settings["model"], partial(OpenAICompatibleProvider, settings["provider"])
    provider = known.get(settings["provider"], compatible)(openai_client=client)
    asked: dict[str, Any] = {"extra_body": settings["parameters"]}
    if settings["effort"]:
        asked["openai_reasoning_effort"] = settings["effort"]
    if settings["api"] == "responses":
        profile = OpenAIModelProfile(**_PROFILE)
        if not _WITHOUT_REASONING.match(name):
            # Also of a model that the library does not know yet.
            profile |= {
                "openai_supports_encrypted_reasoning_content": True,
                "openai_supports_reasoning": True,
            }
        asked |= {"openai_store": False, "openai_prompt_cache_diagnostics": False}
        return OpenAIResponsesModel(name, provider=provider, profile=profile), ModelSettings(**asked)
    made = OpenRouterModel if settings["provider"] == "openrouter" else OpenAIChatModel
    return made(name, provider=provider, profile=_PROFILE), ModelSettings(**asked)


async def _mended(response: httpx2.Response) -> None:
    """Gives an error in a success its status, an error in a list the form that the libraries read, and a call without a
    name that of the only tool."""
    if response.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        return
    await response.aread()
    with contextlib.suppress(ValueError, TypeError, AttributeError, LookupError):
        document = response.json()
        if isinstance(document, list):
            document = document[0] if document else {}
        if (error := document.get("error")) and not response.is_error:
            code = error.get("code") if isinstance(error, dict) else None
            response.status_code = code if isinstance(code, int) and 400 <= code < 600 else 400
        for choice in document.get("choices") or ():
            for call in choice["message"].get("tool_calls") or ():
                call["function"]["name"] = call["function"].get("name") or shell.NAME
        response._content = json.dumps(document).encode()
