"""The real CLIs against a model API on loopback that makes them edit a file and submit. Opt-in, since they are large:

    npm install --prefix ~/clis @openai/codex@0.169.0 @anthropic-ai/claude-code@2.1.330 \\
        @google/gemini-cli@0.61.0 @qwen-code/qwen-code@0.24.4 opencode-ai@1.18.33 \\
        @agentclientprotocol/claude-agent-acp@0.101.0
    EVOPOLICY_REAL_CLIS=~/clis/node_modules/.bin python -m pytest tests/integration/gateway/agents/test_real_clis.py

Nothing leaves the machine: the keys are made up, and the settings folders are the test's own.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import msgspec
import pytest
from commands import played_here, run_dir
from stages import odd_answers
from stages.cli_stage import play, settings
from stages.declared_inputs import DESCRIPTION, as_toml, declare
from stages.model_api import CACHED, CREATED, INPUT, OUTPUT, REASONING, SUBMIT, ModelApi, Step

from evopolicy_common.records.run_record import RunRecord
from evopolicy_gateway.harnesses.interface.agent_config import AcpTable, AgentConfig, ApiTable, read_agent

AGENTS = Path(__file__).parents[4] / "examples" / "agents"
CLIS = os.environ.get("EVOPOLICY_REAL_CLIS", "")

if not CLIS:
    pytest.skip(
        "the file's tests need the real CLIs: install them as its docstring says, then EVOPOLICY_REAL_CLIS=..."
        " make test ARGS=tests/integration/gateway/agents/test_real_clis.py",
        allow_module_level=True,
    )

SCRIPT = [Step(command=SUBMIT), Step(text="first"), Step(command=SUBMIT), Step(text="second")]
FAILING = [*SCRIPT[:2], Step(status=503, text="overloaded"), *SCRIPT[2:]]


def config_for(harness: str, api: ModelApi) -> AgentConfig:
    path = os.environ["PATH"]
    if harness == "codex":
        provider = (
            f'model_providers.stub={{name="stub",base_url="{api.base_url}/v1",wire_api="responses",'
            'env_key="STUB_KEY",request_max_retries=0,stream_max_retries=0}'
        )
        arguments = ("--config", "model_provider=stub", "--config", provider)
        variables = {"STUB_KEY": "sk-stub-0123456789abcdef", "PATH": f"{CLIS}:{path}"}
        return settings(harness, model="gpt-5.5", effort="high", extra_args=arguments, environment=variables)
    variables = {
        "ANTHROPIC_API_KEY": "sk-ant-stub-0123456789abcdef",
        "ANTHROPIC_BASE_URL": api.base_url,
        "CLAUDE_CODE_MAX_RETRIES": "0",
        "PATH": f"{CLIS}:{path}",
    }
    return settings(harness, model="claude-opus-4-7-thinking-max", effort="max", environment=variables)


@pytest.mark.parametrize("harness", ["codex", "claude-code"])
def test_the_real_cli_edits_submits_and_is_resumed_also_after_a_failure(tmp_path: Path, harness: str) -> None:
    with ModelApi(FAILING) as api:
        played = play(tmp_path, config_for(harness, api), "", budget=4)
    assert played.outcome == ("agent_stopped", 2, 1), played.ending.detail
    assert [text for _, text in played.turns] == ["first", "second"]
    assert (tmp_path / "workspace/system/policy.py").read_text() == "# better\n# better\n"
    tokens = played.ending.facts["tokens"]
    assert tokens["input_noncached"] == 4 * (INPUT - CACHED)
    assert tokens["cache_read"] == 4 * CACHED
    assert tokens["output"] == 4 * OUTPUT
    assert tokens["cache_creation"] == (0 if harness == "codex" else 4 * CREATED)
    assert tokens.get("reasoning") == (4 * REASONING if harness == "codex" else None)
    assert "sk-stub" not in played.text
    # The second turn knows the first: one session.
    assert "first" in str(api.requests[-1])


@pytest.mark.parametrize("harness", ["codex", "claude-code"])
def test_the_real_cli_with_a_wrong_key_ends_the_run(tmp_path: Path, harness: str) -> None:
    with ModelApi([Step(status=401, text="invalid key")] * 9) as api:
        played = play(tmp_path, config_for(harness, api), "", budget=4)
    assert played.ending.reason == "agent_failed"
    assert "401" in played.ending.detail


@pytest.mark.parametrize("name", ["gemini", "qwen"])
def test_a_cli_of_the_example_files_edits_submits_and_is_resumed(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("GEMINI_API_KEY", "OPENAI_API_KEY"):
        monkeypatch.setenv(variable, "stub-0123456789abcdef")
    # With a base URL of its own Gemini CLI has to be told in its settings that there is a key.
    (tmp_path / ".gemini").mkdir()
    (tmp_path / ".gemini/settings.json").write_text(
        '{"security": {"auth": {"selectedType": "gemini-api-key"}}}'
    )
    agent = read_agent(AGENTS / f"{name}.toml")
    with ModelApi(FAILING) as api:
        variables = {
            "GOOGLE_GEMINI_BASE_URL": api.base_url,
            "OPENAI_BASE_URL": f"{api.base_url}/v1",
            "PATH": f"{CLIS}:{os.environ['PATH']}",
        }
        config = msgspec.structs.replace(agent, environment=variables, backoff_s=0.001)
        played = play(
            tmp_path, config, "", budget=4, GEMINI_API_KEY="stub-0123456789", OPENAI_API_KEY="stub-0123456789"
        )
    assert played.ending.reason == "agent_stopped", played.ending.detail
    assert [text for _, text in played.turns] == ["first", "second"]
    assert "first" in str(api.requests[-1])
    tokens = played.ending.facts["tokens"]
    assert tokens["input_noncached"] == 4 * (INPUT - CACHED)
    assert tokens["cache_read"] == 4 * CACHED
    assert tokens["output"] == 4 * OUTPUT


def jailed(folder: Path, config: AgentConfig, *more: str, **waits: float) -> tuple[RunRecord, str]:
    """As `played_here`, with the settings in a file."""
    document = msgspec.to_builtins(msgspec.structs.replace(config, backoff_s=0.01))
    known = {name: value for name, value in document.items() if value not in (None, (), {})}
    (folder / "agent.toml").write_text("".join(f"{name} = {as_toml(known[name])}\n" for name in known))
    return played_here(folder, "file:agent.toml", *more, **waits)


@pytest.mark.parametrize("harness", ["codex", "claude-code"])
def test_the_real_cli_plays_and_resumes_a_jailed_run(tmp_path: Path, harness: str) -> None:
    with ModelApi(FAILING) as api:
        reaches = api.base_url.removeprefix("http://")
        record, _ = jailed(tmp_path, inputs_config(harness, api, tmp_path), "--allow-host", reaches)
    assert (record.jail, record.outcome.budget_used, record.agent.retries) == ("bwrap", 4, 1)
    assert "first" in str(api.requests[-1])
    policy = run_dir(tmp_path) / "checkpoints" / "submit_001" / "policy.py"
    assert policy.read_text().count("# better") == 2


@pytest.mark.parametrize("harness", ["codex", "claude-code", "qwen", "qwen-acp"])
def test_the_relay_counts_for_a_real_cli_which_never_has_the_key(
    tmp_path: Path, harness: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever else it asks its model for, and whatever the model answers, the relay counts as the API does."""
    needle = "$(printf %s fedcba9876543210-dliw-ks | rev)"
    search = (
        f"env | grep -c {needle}; cat /proc/[0-9]*/environ | grep -c {needle}; grep -rlaF {needle} ~ /tmp ."
    )
    odd = (odd_answers.busy(429, retry_after="1"), odd_answers.busy(500))
    steps = [Step(command=search), *(Step(odd=each) for each in odd), Step(unknown="no_such_tool"), *SCRIPT]
    anthropic = harness == "claude-code"
    with ModelApi(steps) as api:
        vendor = "ANTHROPIC" if anthropic else "OPENAI"
        monkeypatch.setenv(f"{vendor}_API_KEY", "sk-wild-0123456789abcdef")
        monkeypatch.setenv(f"{vendor}_BASE_URL", api.base_url if anthropic else f"{api.base_url}/v1")
        name = {"claude-code": "claude"}.get(harness, harness.removesuffix("-acp"))
        more: dict[str, Any] = {"program": (f"{CLIS}/{name}",)}
        if name == "qwen":
            more |= {"api": ApiTable(base_url=f"{api.base_url}/v1")}
            more |= {"cli": read_agent(AGENTS / "qwen.toml").cli}
        if harness == "qwen-acp":
            program = (*more["program"], "--acp", "--model", "gpt-5.5", "--auth-type", "openai")
            more |= {"program": program, "cli": None, "acp": AcpTable()}
        if harness in ("codex", "claude-code"):
            # They pass where only known fields and tools do.
            more |= {"models": "declared", "hosted_tools": "refuse"}
        if harness == "codex":
            more |= {"extra_args": ("--config", 'web_search="disabled"')}
        config = AgentConfig(harness=harness, model="gpt-5.5", **more)
        record, said = jailed(tmp_path, config, timeout_s=400)
    use, tokens = record.agent.model_use, record.agent.tokens
    assert record.outcome.budget_used == 4
    assert use is not None
    assert tokens is not None
    assert (use.metering, use.requests, use.requests_failed) == ("relay", api.n_asked, 2), said
    assert (tokens.output, tokens.cache_read) == (api.n_answered * OUTPUT, api.n_answered * CACHED)
    assert record.agent.cli_version is not None
    assert (record.agent.model_string, use.other_models) == ("gpt-5.5", {})
    assert all("sk-wild" in key for key in api.keys)
    assert "sk-wild" not in json.dumps(api.requests)
    assert "next try in 1 s" in said


KEY = "sk-ant-stub-0123456789abcdef"
ACP = {
    "gemini": ("gemini", "--acp", "--model", "gemini-2.5-pro", "--skip-trust"),
    "qwen": ("qwen", "--acp", "--model", "m", "--auth-type", "openai"),
    "opencode": ("opencode", "acp"),
    "claude": ("claude-agent-acp",),
}
"""Agents that speak the Agent Client Protocol, by themselves or through an adapter."""


def acp_settings(name: str, api: ModelApi, home: Path) -> dict[str, str]:
    """The variables of an agent, whose settings are written into `home`."""
    if name == "gemini":
        (home / ".gemini").mkdir(parents=True)
        login = {"security": {"auth": {"selectedType": "gemini-api-key"}}}
        (home / ".gemini/settings.json").write_text(json.dumps(login))
        return {"GEMINI_API_KEY": KEY, "GOOGLE_GEMINI_BASE_URL": api.base_url}
    if name == "opencode":
        (home / ".config/opencode").mkdir(parents=True)
        provider = {
            "npm": "@ai-sdk/openai-compatible",
            "options": {"baseURL": f"{api.base_url}/v1", "apiKey": KEY},
            "models": {"m": {"name": "m", "limit": {"context": 100_000, "output": 8000}}},
        }
        chosen = {"model": "stub/m", "small_model": "stub/m", "autoupdate": False}
        text = json.dumps(chosen | {"provider": {"stub": provider}})
        (home / ".config/opencode/opencode.json").write_text(text)
        return {}
    if name == "qwen":
        return {"OPENAI_API_KEY": KEY, "OPENAI_BASE_URL": f"{api.base_url}/v1"}
    return {"ANTHROPIC_API_KEY": KEY, "ANTHROPIC_BASE_URL": api.base_url, "IS_SANDBOX": "1"}


@pytest.mark.parametrize("name", ACP)
def test_a_real_agent_behind_the_protocol_edits_submits_and_goes_on(tmp_path: Path, name: str) -> None:
    program = (f"{CLIS}/{ACP[name][0]}", *ACP[name][1:])
    with ModelApi(SCRIPT) as api:
        variables = acp_settings(name, api, tmp_path) | {"PATH": f"{CLIS}:{os.environ['PATH']}"}
        config = settings("acp", program=program, acp=AcpTable(), environment=variables, silence_s=60.0)
        played = play(tmp_path, config, "", budget=4)
    assert played.outcome == ("agent_stopped", 2, 0), played.ending.detail
    assert [text for _, text in played.turns] == ["first", "second"]
    assert (tmp_path / "workspace/system/policy.py").read_text() == "# better\n# better\n"
    assert "first" in str(api.requests[-1])
    # OpenCode tells those of a turn's last request.
    usage = {"gemini": 4 * INPUT, "opencode": 2 * INPUT, "claude": 4 * (INPUT + CREATED), "qwen": 4 * INPUT}
    tokens = played.ending.facts.get("tokens", {})
    given = sum(tokens.get(kind, 0) for kind in ("input_noncached", "cache_read", "cache_creation"))
    assert given == usage[name]
    assert KEY not in played.text


LOOK = (
    "echo '# better' >> system/policy.py; ls -d ~/.*/skills/lamps/SKILL.md; echo x >> $(ls -d"
    " ~/.*/skills/lamps/SKILL.md) || echo shut"
)


@pytest.mark.parametrize(
    "name", ["claude-code", "codex", "gemini", "qwen", "acp-gemini", "acp-qwen", "acp-opencode", "acp-claude"]
)
def test_a_jailed_real_agent_has_the_runs_skills_and_servers(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The description of the skill reaches the model, which calls the server's tool; neither can be changed."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    for variable in ("GEMINI_API_KEY", "OPENAI_API_KEY"):
        monkeypatch.setenv(variable, "stub-0123456789abcdef")
    skills, servers = declare(tmp_path)
    script = [Step(tool="measure"), *map(Step, (LOOK, SUBMIT, SUBMIT)), Step(text="done")]
    with ModelApi(script) as api:
        more = ["--allow-host", api.base_url.removeprefix("http://")]
        config = msgspec.structs.replace(inputs_config(name, api, home), skills=skills, mcp=servers)
        for path in home.iterdir():
            more += ["--jail-bind-rw", str(path)]
        record, _ = jailed(tmp_path, config, *more)
    assert [(each.kind, each.name, each.hosts) for each in record.agent.inputs] == [
        ("skill", "lamps", ()),
        ("mcp", "lamp", ("lamps.example.org",)),
    ]
    assert (record.jail, record.outcome.budget_used) == ("bwrap", 4)
    assert DESCRIPTION in json.dumps(api.requests[0])
    assert "the lamp reads 42, lux; could not change it" in json.dumps(api.requests[1])
    assert "shut" in json.dumps(api.requests[2])
    assert (tmp_path / "skills/lamps/SKILL.md").read_text().endswith("twice.\n")
    assert (tmp_path / "tools/lamp.txt").read_text() == "42"


def inputs_config(name: str, api: ModelApi, home: Path) -> AgentConfig:
    """The settings of an agent in its jail, with a login in `home` where it needs one."""
    if name.startswith("acp-"):
        name = name.removeprefix("acp-")
        program = (f"{CLIS}/{ACP[name][0]}", *ACP[name][1:])
        return AgentConfig(
            harness="acp", program=program, acp=AcpTable(), environment=acp_settings(name, api, home)
        )
    if name in ("gemini", "qwen"):
        agent = read_agent(AGENTS / f"{name}.toml")
        variables = {"GOOGLE_GEMINI_BASE_URL": api.base_url, "OPENAI_BASE_URL": f"{api.base_url}/v1"}
        if name == "gemini":
            acp_settings(name, api, home)
        key = ("OPENAI_API_KEY" if name == "qwen" else "GEMINI_API_KEY",)
        changed = {"environment": variables, "program": (f"{CLIS}/{name}",), "api": None}
        return msgspec.structs.replace(agent, pass_environment=key, **changed)
    config = config_for(name, api)
    variables = {key: value for key, value in config.environment.items() if key != "PATH"}
    program = f"{CLIS}/{'codex' if name == 'codex' else 'claude'}"
    return msgspec.structs.replace(config, environment=variables, program=(program,))
