"""What a request may have where its run refuses other models or the provider's tools, and how a body is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from stages.model_api import Step
from stages.relay_stage import GEMINI, PATHS, asked, relay

from evopolicy_gateway.relay import requests

WEB: dict[str, Any] = {"type": "web_search"}
FUNCTION: dict[str, Any] = {"type": "function", "name": "f", "parameters": {}}
STRICT: dict[str, Any] = {"model": "m", "declared_only": True, "own_tools_only": True}


@pytest.mark.parametrize(
    ("api", "more"),
    [
        ("responses", {"tools": [{"type": "shell"}]}),
        ("responses", {"tools": [{"type": "shell", "environment": {"type": "container_auto"}}]}),
        ("responses", {"tools": [{"type": "tool_search", "execution": "server"}]}),
        ("responses", {"tools": [{"type": "namespace", "name": "n", "tools": [WEB]}]}),
        ("responses", {"tools": WEB}),
        ("responses", {"tools": [FUNCTION | {"server_url": "https://x.example"}]}),
        ("responses", {"input": [{"type": "tool_search_output", "tools": [FUNCTION, WEB]}]}),
        ("responses", {"prompt": {"id": "p"}}),
        ("responses", {"Tools": [WEB]}),
        ("chat/completions", {"tools": [{"type": "function", "function": {"name": "f", "url": "x"}}]}),
        ("chat/completions", {"tools": [7]}),
        ("chat/completions", {"enable_search": True}),
        ("chat/completions", {"search_parameters": {"mode": "on"}}),
        ("chat/completions", {"models": ["dear"]}),
        ("chat/completions", {"Model": "dear"}),
        ("messages", {"tools": [{"type": "advisor_20260301", "name": "a", "model": "dear"}]}),
        ("messages", {"tools": [{"name": "f", "input_schema": {}, "model": "dear"}]}),
        ("messages", {"container": "c"}),
        (GEMINI, {"tools": [{"functionDeclarations": [{"name": "f"}], "google_search": {}}]}),
        (GEMINI, {"tools": [{"functionDeclarations": [{"name": "f", "mcpServer": {}}]}]}),
        (GEMINI, {"cachedContent": "cachedContents/c"}),
        (GEMINI, {"model": "dear"}),
    ],
)
def test_fields_and_tools_that_are_not_known_are_refused(
    tmp_path: Path, api: str, more: dict[str, Any]
) -> None:
    """Each gave an agent another model, a search of the web, or a shell at its provider, where only the names that
    were known to do so were refused."""
    (answer,), served = asked(tmp_path, [], more, path=api, **STRICT)
    assert answer.status_code == 400, answer.text
    assert served.api.bodies == []
    (tmp_path / "usual").mkdir()
    (answer,), _ = asked(tmp_path / "usual", [], more, path=api, model="m")
    assert answer.status_code == 200, answer.text


def test_known_tools_of_the_provider_pass_where_only_the_model_is_declared(tmp_path: Path) -> None:
    terms: dict[str, Any] = {"model": "m", "declared_only": True}
    (answer,), served = asked(tmp_path, [], {"tools": [WEB]}, path="responses", **terms)
    assert (answer.status_code, served.used.hosted_tools) == (200, {"web_search": 1})


CODEX: dict[str, Any] = {
    "client_metadata": {"a": "b"},
    "include": ["reasoning.encrypted_content"],
    "parallel_tool_calls": True,
    "prompt_cache_key": "k",
    "reasoning": {"effort": "high"},
    "store": False,
    "text": {"verbosity": "low"},
    "tool_choice": "auto",
    "tools": [
        FUNCTION | {"strict": False, "description": "runs"},
        {"type": "custom", "name": "apply_patch", "description": "d", "format": {"type": "grammar"}},
        {"type": "tool_search", "execution": "client", "description": "d", "parameters": {}},
        {"type": "namespace", "name": "mcp", "description": "d", "tools": [FUNCTION]},
        {"type": "shell", "environment": {"type": "local"}},
    ],
    "input": [
        {"type": "reasoning", "id": "r", "summary": [], "encrypted_content": "e", "own": {"tools_of": 1}},
        {"type": "function_call", "call_id": "c", "name": "f", "arguments": "{}"},
        {"type": "tool_search_output", "call_id": "c", "tools": [FUNCTION]},
    ],
}
CLAUDE: dict[str, Any] = {
    "context_management": {"edits": []},
    "metadata": {"user_id": "u"},
    "output_config": {"effort": "max"},
    "system": [{"type": "text", "text": "s", "cache_control": {"type": "ephemeral"}}],
    "thinking": {"type": "adaptive"},
    "tools": [
        {"name": "Bash", "description": "d", "input_schema": {}, "cache_control": {"type": "ephemeral"}},
        {"type": "bash_20250124", "name": "bash"},
        {"type": "custom", "name": "f", "input_schema": {}, "strict": True},
    ],
    "messages": [
        {"role": "assistant", "content": [{"type": "thinking", "thinking": "t", "signature": "s", "own": 1}]}
    ],
}
CHAT: dict[str, Any] = {
    "reasoning_effort": "high",
    "max_completion_tokens": 9,
    "messages": [
        {"role": "assistant", "content": None, "reasoning_content": "r", "extra_content": {"google": 1}}
    ],
}
CONTENTS: dict[str, Any] = {
    "systemInstruction": {"parts": [{"text": "s"}]},
    "generationConfig": {"thinkingConfig": {"includeThoughts": True}},
    "contents": [
        {"role": "model", "parts": [{"functionCall": {"name": "f"}, "thoughtSignature": "s", "own": 1}]}
    ],
}


@pytest.mark.parametrize(
    ("path", "more"),
    [("responses", CODEX), ("messages", CLAUDE), ("chat/completions", CHAT), (GEMINI, CONTENTS)],
)
def test_the_requests_of_coding_agents_and_what_a_provider_sent_pass(
    tmp_path: Path, path: str, more: dict[str, Any]
) -> None:
    (answer,), served = asked(tmp_path, [Step(text="hello")], more, path=path, **STRICT)
    assert answer.status_code == 200, answer.text
    (sent,) = served.api.requests
    assert {name: sent[name] for name in more} == more


@pytest.mark.parametrize("terms", [{}, STRICT])
@pytest.mark.parametrize(
    ("body", "why"),
    [
        ('{"model": "dear", "model": "m", "input": []}', "'model' occurs twice"),
        ('{"model": "m", "input": [{"a": 1, "a": 2}]}', "'a' occurs twice"),
        ('{"model": "m", "input": [], "temperature": NaN}', "NaN is not a number"),
        ('{"model": "m", "input": "\\ud800"}', "cannot be sent on"),
        ('{"model": "m", "input": [], "seed": 123456789012345678901234567890}', "cannot be sent on"),
        ('{"model": "m", "input": ' + "[" * 100_000 + "]" * 100_000 + "}", "nested too deeply"),
        ('{"model": "m", "input": [' + "{}," * 1_000 + "{}]}", "more than 500 values"),
        ("[]", "not a JSON object"),
    ],
)
async def test_a_body_that_two_readers_could_read_in_two_ways_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, terms: dict[str, Any], body: str, why: str
) -> None:
    monkeypatch.setattr(requests, "MAX_MARKS", 500 if "{}," in body else 300_000)
    async with relay(tmp_path, [], **terms) as served:
        answer = await served.client.post("/v1/responses", content=body.encode())
        assert (answer.status_code, why in answer.text) == (400, True), answer.text
    assert served.api.bodies == []


@pytest.mark.parametrize(("path", "protocol"), PATHS.items())
async def test_a_body_is_sent_as_it_was_understood(tmp_path: Path, path: str, protocol: Any) -> None:
    async with relay(tmp_path, [], protocol=protocol) as served:
        version = "v1beta" if protocol == "google" else "v1"
        spaced = b' {"mo\\u0064el" : "m",  "contents": [ "\\u00e9" ] } '
        assert (await served.client.post(f"/{version}/{path}", content=spaced)).status_code == 200
    assert served.api.bodies == ['{"model":"m","contents":["é"]}'.encode()]


@pytest.mark.parametrize("path", ["models/../files:generateContent", "models/a/b:generateContent", "files"])
async def test_other_paths_of_google_are_not_served(tmp_path: Path, path: str) -> None:
    async with relay(tmp_path, [], protocol="google") as served:
        for each in (path, path.replace("/", "%2F")):
            assert (await served.client.post(f"/v1beta/{each}", json={})).status_code == 404
    assert served.api.bodies == []
