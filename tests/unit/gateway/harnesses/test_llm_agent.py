"""The built-in LLM agent against a model API on loopback, over each API with the vendors' own libraries."""

from __future__ import annotations

import re
import socket
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from stages import odd_answers
from stages.cli_stage import Played, play, settings
from stages.model_api import SUBMIT, ModelApi, Step
from stages.provider_api import CACHED, FRESH, OUTPUT, ProviderApi, Said, conversation_settings

from evopolicy_common.errors import ConfigError
from evopolicy_gateway import harnesses
from evopolicy_gateway.agents.llm import conversation, shell
from evopolicy_gateway.agents.llm.conversation import ApiError, Conversation, ToolCall
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig, ApiName, ApiTable
from evopolicy_gateway.relay.usage import Prices

pytestmark = pytest.mark.slow

apis = pytest.mark.parametrize("api", ["chat", "responses", "messages", "gemini"])
mostly_one = pytest.mark.parametrize("api", ["chat", pytest.param("messages", marks=pytest.mark.system)])
"""For what the agent does alike with all."""
KEY = "a-key-that-nobody-else-may-see"


@pytest.fixture(autouse=True)
def the_key_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODEL_ACCESS", KEY)


def config_for(api: ApiName, base_url: str, **more: Any) -> AgentConfig:
    table = ApiTable(api=api, base_url=base_url, key="MODEL_ACCESS")
    return settings("llm", model="m-1", api=table, **more)


def played(tmp_path: Path, api: ApiName, script: list[Step], **more: Any) -> tuple[Played, ModelApi]:
    with ModelApi(script) as server:
        base = f"{server.base_url}/v1" if api == "chat" else server.base_url
        return play(tmp_path, config_for(api, base, **more), ""), server


@pytest.mark.parametrize(("api", "turns"), [("chat", 2), ("responses", 1), ("messages", 1), ("gemini", 1)])
def test_a_model_edits_submits_and_is_prompted_again_in_its_session(
    tmp_path: Path, api: ApiName, turns: int
) -> None:
    """What a second turn knows of the first with the other APIs: tests/unit/gateway/harnesses/test_llm_providers.py."""
    prices = Prices(input=1.0, output=10.0, cache_read=0.1)
    script = [Said(commands=(SUBMIT,), reasoning="hm"), Said(text="done", reasoning="so")] * turns
    with ProviderApi(api, script) as server:
        config = config_for(api, server.base_url, prices=prices, reprompts=turns - 1)
        run = play(tmp_path, config, "")
    # The second turn knows the first, or the server would refuse it.
    assert run.outcome == ("agent_stopped", turns, 0), run.ending.detail
    assert run.turns == [(turn + 1, "done") for turn in range(turns)]
    assert (tmp_path / "workspace/system/policy.py").read_text() == "# better\n" * turns
    tokens = run.ending.facts["tokens"]
    n = 2 * turns
    assert (server.n_answered, len(server.requests)) == (n, n)
    assert tokens == {
        "input_noncached": n * FRESH,
        "cache_read": n * CACHED,
        "cache_creation": 0,
        "output": n * OUTPUT,
        "cost": pytest.approx(n * (FRESH + 0.1 * CACHED + 10 * OUTPUT) / 1e6),
    }
    assert any(doing.action.startswith("$ echo '# better'") for doing in run.doings)
    assert metadata.version("pydantic-ai-slim") in run.ending.facts["cli_version"]


@mostly_one
def test_a_busy_provider_is_asked_again_and_nothing_shows_the_key(tmp_path: Path, api: ApiName) -> None:
    script = [Step(status=503, text="overloaded"), Step(command="env"), Step(text="done")]
    run, server = played(tmp_path, api, script, reprompts=0)
    assert (run.ending.reason, run.ending.retries) == ("agent_stopped", 0), run.ending.detail
    assert "EVOPOLICYGYM_SUBMIT_URL" in str(server.requests[-1])
    assert KEY not in str(server.requests)
    assert KEY not in run.text


@mostly_one
def test_a_wrong_key_ends_the_run_with_the_providers_words(tmp_path: Path, api: ApiName) -> None:
    run, _ = played(tmp_path, api, [Step(status=401, text="no such key")] * 9)
    assert run.ending.reason == "agent_failed"
    assert "no such key" in run.ending.detail


@apis
@pytest.mark.parametrize("kind", ["text/event-stream", "application/json", "text/html"])
@pytest.mark.parametrize(
    "body", ["{not json", '{"choices": null}', "7", '{"choices": [{}]}', '{"choices": []}', "<html>"]
)
async def test_an_answer_of_another_form_is_an_error_that_says_so(api: ApiName, body: str, kind: str) -> None:
    data = f"data: {body}\n\n" if "event" in kind else body
    with ModelApi([Step(odd=odd_answers.garbage(data.encode(), kind))] * 2) as server:
        known = Conversation(conversation_settings(server.base_url, api), "")
        known.say("hello")
        with pytest.raises(ApiError, match=r"cannot be read: .") as told:
            await known.ask_model()
        assert not re.search("Error:|index|NoneType", str(told.value))
    # The conversation can go on.
    assert [message.kind for message in known.messages] == ["request"]


def test_a_session_that_failed_before_its_first_answer_begins_anew(tmp_path: Path) -> None:
    outage = [Step(status=503, text="overloaded")] * 5
    run, _ = played(tmp_path, "chat", [*outage, Step(command=SUBMIT), Step(command=SUBMIT)])
    assert (run.ending.reason, run.ending.retries) == ("agent_stopped", 1)
    assert [prompt["message"][:14] for prompt in run.prompts] == ["Read AGENTS.md"] * 2


@mostly_one
def test_a_conversation_beyond_the_models_context_goes_on_without_old_outputs(
    tmp_path: Path, api: ApiName
) -> None:
    commands = [Step(command=f"echo output-{n}-of-a-command") for n in range(12)]
    too_long = Step(status=400, text="prompt is too long: context length exceeded")
    run, server = played(tmp_path, api, [*commands, too_long, Step(text="done")], reprompts=0)
    assert run.turns == [(1, "done")]
    assert "output-0-of" in str(server.requests[-2])
    last = str(server.requests[-1]["messages"])
    assert "[exit status 0]\\noutput-0-of" not in last
    assert "[exit status 0]\\noutput-11-of" in last


@pytest.mark.parametrize(
    "text",
    [
        "input length and `max_tokens` exceed context limit: 188240 + 32000 > 200000",
        "the request exceeds the available context size",
        "This model's maximum context length is 128000 tokens",
        "prompt is too long: 200001 tokens > 200000 maximum",
    ],
)
async def test_providers_words_for_a_conversation_that_is_too_long_are_known(text: str) -> None:
    for status in (400, 500):
        with ModelApi([Step(status=status, text=text)] * 2) as server:
            known = Conversation(conversation_settings(server.base_url, "messages"), "")
            known.say("hello")
            with pytest.raises(ApiError, match=re.escape(text)) as raised:
                await known.ask_model()
        assert raised.value.too_long is (status == 400)


def test_shortening_goes_on_until_two_outputs_are_left() -> None:
    known = Conversation(conversation_settings("http://127.0.0.1:1"), "")
    for n in range(12):
        known.answer([ToolCall(id=str(n))], [f"output {n}"])
    kept = []
    while known.shorten():
        kept.append(known.dumped().count(b"output "))
    assert kept == [8, 2]


def test_a_call_that_cannot_be_read_is_answered_with_the_reason() -> None:
    assert "only one is bash" in conversation._call("1", "edit", "{}").fault
    for arguments in ("{", "[]", "{}", '{"command": 1}', '{"command": "a", "timeout_s": "x"}', "null"):
        assert conversation._call("1", shell.NAME, arguments).fault
    fine = conversation._call("1", shell.NAME, '{"command": "ls", "timeout_s": 1e9}')
    assert (fine.command, fine.timeout_s, fine.fault) == ("ls", shell.MOST_S, "")


def test_a_command_ends_in_time_with_its_descendants() -> None:
    text, succeeded = shell.run("sleep 1000 & echo begun; sleep 1000", 0.5)
    assert "begun" in text
    assert "ended after 0.5 s" in text
    assert not succeeded
    text, succeeded = shell.run("seq 1000000", 60.0)
    assert succeeded
    assert len(text) < 31_000
    assert "bytes left out" in text
    assert text.rstrip().endswith("1000000")


@pytest.mark.parametrize(
    ("provider", "api", "host", "variable"),
    [
        ("openai", "responses", "api.openai.com", "OPENAI_API_KEY"),
        ("anthropic", "messages", "api.anthropic.com", "ANTHROPIC_API_KEY"),
        ("google", "gemini", "generativelanguage.googleapis.com", "GEMINI_API_KEY"),
        ("deepseek", "chat", "api.deepseek.com", "DEEPSEEK_API_KEY"),
        ("moonshot", "chat", "api.moonshot.ai", "MOONSHOT_API_KEY"),
        ("mistral", "chat", "api.mistral.ai", "MISTRAL_API_KEY"),
        ("openrouter", "chat", "openrouter.ai", "OPENROUTER_API_KEY"),
    ],
)
def test_the_command_line_names_provider_and_model(
    provider: str, api: str, host: str, variable: str, tmp_path: Path
) -> None:
    config = harnesses.config_of(f"llm:{provider}/some/model", tmp_path)
    assert config is not None
    assert config.api is not None
    assert (config.model, config.api.spoken, config.api.variable) == ("some/model", api, variable)
    assert config.provider_name == host


def test_an_unknown_provider_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    for wrong in ("llm:gpt", "llm:openai/", "llm:acme/gemini"):
        with pytest.raises(
            ConfigError, match="llm:PROVIDER/MODEL, with PROVIDER one of openai, anthropic, goo"
        ):
            harnesses.config_of(wrong, tmp_path)
    with pytest.raises(ConfigError, match=r"needs a provider \(openai, .*or the base_url"):
        harnesses.make("llm", tmp_path, AgentConfig(harness="llm", model="m", api=ApiTable(key="")))


def test_no_host_but_the_relay_is_reachable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    made = harnesses.make("llm:openai/m", tmp_path)
    assert (tuple(made.hosts), made.packages[0]) == ((), "pydantic-ai-slim")
    assert made.model is not None
    assert made.model.upstream is not None
    assert (made.model.upstream.base_url, made.model.upstream.key) == ("https://api.openai.com/v1", KEY)


@pytest.mark.parametrize(
    ("url", "allowed", "with_insecure"),
    [
        ("https://gpu-box/v1", True, True),
        ("http://localhost:8000/v1", True, True),
        ("http://127.0.0.1:8000/v1", True, True),
        ("http://gpu-box:8000/v1", False, True),
        ("http://gpu-box.example.com:8000/v1", False, False),
        ("http://half-public:8000/v1", False, False),
        ("gpu-box", False, False),
        ("https://", False, False),
        ("https://h:x", False, False),
    ],
)
def test_plain_http_reaches_the_local_network_only_where_it_is_allowed(
    url: str, allowed: bool, with_insecure: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Names of loopback stand for the workstation: no private address is asked for.
    known = {"gpu-box": ["127.0.0.2"], "gpu-box.example.com": ["93.184.215.14"]}
    known["half-public"] = ["127.0.0.2", "93.184.215.14"]
    found = {name: [(0, 0, 0, "", (each, 0)) for each in addresses] for name, addresses in known.items()}
    monkeypatch.setattr(socket, "getaddrinfo", lambda host, *more, **options: found[host])
    for insecure, expected in ((False, allowed), (True, with_insecure)):
        table = ApiTable(base_url=url, insecure_http=insecure, key="")
        config = AgentConfig(harness="llm", model="m", api=table)
        if expected:
            config.check()
        else:
            with pytest.raises(ConfigError, match=r"api\.base_url"):
                config.check()


def test_a_key_that_is_not_set_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("ANTHROPIC_API_KEY", raising=False)
    with pytest.raises(ConfigError, match="ANTHROPIC_API_KEY with the API's key is not set"):
        harnesses.make("llm:anthropic/m", tmp_path)


def test_an_installation_without_the_extra_is_told_how_to_add_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("GEMINI_API_KEY", KEY)

    def version(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", version)
    with pytest.raises(ConfigError, match=r"llm needs the package pydantic-ai-slim: .*llm"):
        harnesses.make("llm:google/m", tmp_path)
