"""The built-in LLM agent against a model API on loopback, with both protocols and the vendors' own libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import pytest
from stages import odd_answers
from stages.cli_stage import Played, play, settings
from stages.model_api import CACHED, CREATED, INPUT, OUTPUT, SUBMIT, ModelApi, Step

from evopolicy_common.errors import ConfigError
from evopolicy_gateway import harnesses
from evopolicy_gateway.agents.llm import apis, shell
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig, ApiTable
from evopolicy_gateway.relay.usage import Prices

pytestmark = pytest.mark.slow

Protocol = Literal["openai", "anthropic"]
protocols = pytest.mark.parametrize("protocol", ["openai", "anthropic"])
mostly_one = pytest.mark.parametrize(
    "protocol", ["openai", pytest.param("anthropic", marks=pytest.mark.system)]
)
"""For what the agent does alike with both."""
KEY = "a-key-that-nobody-else-may-see"


@pytest.fixture(autouse=True)
def the_key_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODEL_ACCESS", KEY)


def config_for(protocol: Protocol, api: ModelApi, **more: Any) -> AgentConfig:
    base = f"{api.base_url}/v1" if protocol == "openai" else api.base_url
    return settings(
        "llm", model="m-1", api=ApiTable(protocol=protocol, base_url=base, key="MODEL_ACCESS"), **more
    )


def played(tmp_path: Path, protocol: Protocol, script: list[Step], **more: Any) -> tuple[Played, ModelApi]:
    with ModelApi(script) as api:
        return play(tmp_path, config_for(protocol, api, **more), ""), api


@protocols
def test_a_model_edits_submits_and_is_prompted_again_in_its_session(
    tmp_path: Path, protocol: Protocol
) -> None:
    prices = Prices(input=1.0, output=10.0, cache_read=0.1)
    script = [Step(command=SUBMIT), Step(text="first"), Step(command=SUBMIT), Step(text="second")]
    run, api = played(tmp_path, protocol, script, prices=prices)
    assert run.outcome == ("agent_stopped", 2, 0), run.ending.detail
    assert run.turns == [(1, "first"), (2, "second")]
    assert (tmp_path / "workspace/system/policy.py").read_text() == "# better\n# better\n"
    tokens = run.ending.facts["tokens"]
    assert tokens["input_noncached"] == 4 * (INPUT - CACHED)
    assert (tokens["cache_read"], tokens["output"]) == (4 * CACHED, 4 * OUTPUT)
    assert tokens["cache_creation"] == (4 * CREATED if protocol == "anthropic" else 0)
    assert tokens["cost"] == pytest.approx(4 * (INPUT - CACHED + 0.1 * CACHED + 10 * OUTPUT) / 1e6)
    assert any(doing.action.startswith("$ echo '# better'") for doing in run.doings)
    assert protocol in run.ending.facts["cli_version"]
    # The second turn knows the first: one session.
    assert "first" in str(api.requests[2])


@mostly_one
def test_neither_its_commands_nor_its_log_have_the_key(tmp_path: Path, protocol: Protocol) -> None:
    run, api = played(tmp_path, protocol, [Step(command="env"), Step(text="done")], reprompts=0)
    assert "EVOPOLICYGYM_SUBMIT_URL" in str(api.requests[1])
    assert KEY not in str(api.requests)
    assert KEY not in run.text


@mostly_one
def test_a_busy_provider_is_asked_again_within_the_turn(tmp_path: Path, protocol: Protocol) -> None:
    script = [Step(status=503, text="overloaded"), Step(command=SUBMIT), Step(command=SUBMIT)]
    run, _ = played(tmp_path, protocol, [*script, Step(text="done")])
    assert (run.ending.reason, run.ending.retries) == ("agent_stopped", 0), run.ending.detail


@mostly_one
def test_a_wrong_key_ends_the_run_with_the_providers_words(tmp_path: Path, protocol: Protocol) -> None:
    run, _ = played(tmp_path, protocol, [Step(status=401, text="no such key")] * 9)
    assert run.ending.reason == "agent_failed"
    assert "no such key" in run.ending.detail


KNOWN = {"model": "m-1", "system": "", "parameters": {}, "retries": 0, "timeout_s": 9.0}
KNOWN |= {"context_tokens": 1000, "max_output_tokens": 9}


@protocols
@pytest.mark.parametrize(
    "body", [b"{not json", b'{"choices": null}', b"7", b'{"choices": [{}]}', b'{"choices": []}', None]
)
def test_an_answer_of_another_form_is_an_error_that_says_so(protocol: Protocol, body: bytes | None) -> None:
    data = b"<html>" if body is None else b"data: " + body + b"\n\n"
    with ModelApi([Step(odd=odd_answers.garbage(data))]) as server:
        api = apis.open_api({"protocol": protocol, "base_url": server.base_url, **KNOWN}, "", [])
        api.say("hello")
        with pytest.raises(apis.ApiError, match="cannot be read"):
            api.ask()
    # The conversation can go on.
    assert [message["role"] for message in api.messages] == ["user"]


def test_a_session_that_failed_before_its_first_answer_begins_anew(tmp_path: Path) -> None:
    outage = [Step(status=503, text="overloaded")] * 5
    run, _ = played(tmp_path, "openai", [*outage, Step(command=SUBMIT), Step(command=SUBMIT)])
    assert (run.ending.reason, run.ending.retries) == ("agent_stopped", 1)
    assert [prompt["message"][:14] for prompt in run.prompts] == ["Read AGENTS.md"] * 2


@mostly_one
def test_a_conversation_beyond_the_models_context_goes_on_without_old_outputs(
    tmp_path: Path, protocol: Protocol
) -> None:
    commands = [Step(command=f"echo output-{n}-of-a-command") for n in range(12)]
    too_long = Step(status=400, text="prompt is too long: context length exceeded")
    run, api = played(tmp_path, protocol, [*commands, too_long, Step(text="done")], reprompts=0)
    assert run.turns == [(1, "done")]
    assert "output-0-of" in str(api.requests[-2])
    last = str(api.requests[-1]["messages"])
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
def test_providers_words_for_a_conversation_that_is_too_long_are_known(text: str) -> None:
    assert apis.ApiError(text, 400, None).too_long
    assert not apis.ApiError(text, 500, None).too_long


def test_shortening_goes_on_until_two_outputs_are_left() -> None:
    api = apis.open_api({"protocol": "openai", "base_url": "http://127.0.0.1:1", **KNOWN}, "", [])
    for n in range(12):
        api.answer([apis.Call(id=str(n))], [f"output {n}"])
    kept = []
    while api.shorten():
        kept.append(sum("output" in message["content"] for message in api.messages))
    assert kept == [8, 2]


def test_arguments_that_are_no_object_are_not_sent_back() -> None:
    assert apis._sent_back('{"command": "ls"}') == '{"command": "ls"}'
    for odd in ('{"command": "cut o', "[]", "", "3"):
        assert apis._sent_back(odd) == "{}"


def test_a_call_that_cannot_be_read_is_answered_with_the_reason() -> None:
    assert "only one is bash" in apis._call("1", "edit", "{}").fault
    for arguments in ("{", "[]", "{}", '{"command": 1}', '{"command": "a", "timeout_s": "x"}', "null"):
        assert apis._call("1", shell.NAME, arguments).fault
    fine = apis._call("1", shell.NAME, '{"command": "ls", "timeout_s": 1e9}')
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


def test_the_command_line_names_protocol_and_model(tmp_path: Path) -> None:
    config = harnesses.config_of("llm:openai/some/model", tmp_path)
    assert config is not None
    assert config.api is not None
    assert (config.model, config.api.protocol) == ("some/model", "openai")
    assert config.api.variable == "OPENAI_API_KEY"
    assert config.provider_name == "api.openai.com"
    for wrong in ("llm:gpt", "llm:openai/", "llm:google/gemini"):
        with pytest.raises(ConfigError, match="llm:openai/MODEL"):
            harnesses.config_of(wrong, tmp_path)


def test_no_host_but_the_relay_is_reachable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    made = harnesses.make("llm:openai/m", tmp_path)
    assert (tuple(made.hosts), tuple(made.packages)) == ((), ("openai",))
    assert made.model is not None
    assert made.model.upstream is not None
    assert (made.model.upstream.base_url, made.model.upstream.key) == ("https://api.openai.com/v1", KEY)
    for url in ("http://gpu-box:8000/v1", "gpu-box", "https://", "https://h:x"):
        wrong = AgentConfig(harness="llm", model="m", api=ApiTable(protocol="openai", base_url=url, key=""))
        with pytest.raises(ConfigError, match="base_url"):
            harnesses.make("llm", tmp_path, wrong)


def test_a_key_that_is_not_set_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("ANTHROPIC_API_KEY", raising=False)
    with pytest.raises(ConfigError, match="ANTHROPIC_API_KEY with the API's key is not set"):
        harnesses.make("llm:anthropic/m", tmp_path)
