"""Whole runs of agents in their jail: one behind the Agent Client Protocol, and the built-in one with a model API on
loopback, also with a skill that is read-only and fixed while the run is open."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import played_here, run_dir
from stages.cli_stage import FAKES
from stages.declared_inputs import DESCRIPTION, declare
from stages.model_api import CACHED, INPUT, OUTPUT, SUBMIT, ModelApi, Step, llm_agent

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.records.run_record import inputs_digest
from evopolicy_gateway import harnesses
from evopolicy_gateway.inputs.declared import read_inputs
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.run_options import RunOptions
from evopolicy_gateway.run_folder.layout import save

PROBE = (
    "cat /proc/[0-9]*/environ /proc/[0-9]*/cmdline | tr '\\0' '\\n'; cat /proc/$PPID/mem; curl -sS -m 5"
    " https://example.org; curl -sS -m 5 $SIDE; python3 -c 'import gymnasium'; true"
)
KEY = "key-of-the-test-0123456789"
LOOK = "cd /inputs/skills/lamps; cat SKILL.md; ./scripts/read.sh; touch new || echo shut; rm SKILL.md || echo kept"


def agent_with_a_skill(folder: Path, base_url: str) -> None:
    declare(folder)
    llm_agent(folder, base_url, key="", skills=["skills/lamps"])


@pytest.mark.system
def test_an_agent_behind_the_protocol_plays_a_whole_run_in_its_jail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_SCENARIO", "work,crash,work")
    monkeypatch.setenv("FAKE_STATE", "fake")  # in its workspace
    shown = ("--jail-env", "FAKE_SCENARIO", "--jail-env", "FAKE_STATE")
    record, _ = played_here(tmp_path, f"acp:{FAKES}/acp-agent", *shown)
    folder = run_dir(tmp_path)
    assert (record.jail, record.agent.harness, record.agent.cli_version) == ("bwrap", "acp", "fake 1.2")
    assert (record.outcome.budget_used, record.agent.retries) == (4, 1)
    assert record.agent.tokens is not None
    assert record.agent.tokens.output == 20
    requests = (folder / "workspace/fake/requests").read_text().splitlines()
    assert (requests.count("session/new"), requests.count("session/load")) == (1, 1)
    lines = [json.loads(line) for line in (folder / "logs/agent.jsonl").read_text().splitlines()]
    assert any(line.get("type") == "turn_failed" and "out of cheese" in line["message"] for line in lines)


@pytest.mark.system
@pytest.mark.parametrize("api_name", ["chat", "messages"])
def test_a_model_with_a_shell_plays_a_whole_run_in_its_jail(
    tmp_path: Path, api_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODEL_ACCESS", KEY)
    script = [Step(PROBE), Step(SUBMIT), Step(text="a first try"), Step(SUBMIT), Step(text="done")]
    with ModelApi(script) as api, ModelApi([]) as side:
        more = {"prices": {"input": 1.0, "output": 10.0}, "environment": {"SIDE": side.base_url}}
        agent = llm_agent(tmp_path, api.base_url, api_name, **more)
        record, _ = played_here(tmp_path, agent)
    folder = run_dir(tmp_path)
    assert (record.jail, record.outcome.budget_used, record.agent.harness) == ("bwrap", 4, "llm")
    assert record.agent.model_string == "m-1"
    assert record.agent.tokens is not None
    assert record.agent.tokens.input_noncached == 5 * (INPUT - CACHED)
    assert record.agent.tokens.output == 5 * OUTPUT
    assert record.agent.tokens.cost is not None
    assert "api" in record.agent.settings
    log = (folder / "logs/agent.jsonl").read_text()
    assert KEY not in log
    lines = [json.loads(line) for line in log.splitlines()]
    outputs = [line["message"]["content"][0]["content"] for line in lines if line["type"] == "user"]
    # Neither a host of the world, nor another port of this machine, nor a simulator.
    assert any(words in outputs[0] for words in ("Could not resolve host", "403", "CONNECT"))
    assert any(
        words in outputs[0] for words in ("Connection refused", "Failed to connect", "Couldn't connect")
    )
    assert "No module named 'gymnasium'" in outputs[0]
    assert side.requests == []
    # Neither in the environment of any process of the jail nor in a command line.
    assert "EVOPOLICYGYM_SUBMIT_URL" in outputs[0]
    assert KEY not in str(api.requests)
    assert "mem: Permission denied" in outputs[0]
    policy = folder / "checkpoints" / "submit_001" / "policy.py"
    assert policy.read_text().count("# better") == 2


@pytest.mark.system
def test_an_agent_reads_its_skill_and_cannot_change_it(tmp_path: Path) -> None:
    with ModelApi([Step(command=LOOK), Step(command=SUBMIT), Step(text="done")]) as api:
        agent_with_a_skill(tmp_path, api.base_url)
        record, _ = played_here(tmp_path, "file:agent.toml", "--budget", "2")
    assert [each.name for each in record.agent.inputs] == ["lamps"]
    assert record.agent.inputs == tuple(each.recorded for each in read_inputs(["skills/lamps"], {}, tmp_path))
    assert DESCRIPTION in json.dumps(api.requests[0])
    seen = json.dumps(api.requests[1])
    for words in ("Read the lamp twice.", "lit", "shut", "kept"):
        assert words in seen


def plan(folder: Path, **more: object) -> Plan:
    given = RunOptions(agent="file:agent.toml", exp_id="t", runs=folder / "runs")
    texts = given.texts(folder)
    return Plan(
        settings=given.settings("toy/line", "t", texts=texts),
        texts=texts,
        agent=given.agent,
        runs=given.runs,
        started_in=folder,
        wall_limit_s=60.0,
        **more,  # type: ignore[arg-type]
    )


def test_a_run_with_skills_needs_the_same_skills_and_a_jail(tmp_path: Path) -> None:
    agent_with_a_skill(tmp_path, "http://127.0.0.1:1")
    opened = plan(tmp_path)
    assert opened.settings.inputs == inputs_digest(opened.texts.inputs) != ""
    assert harnesses.config_of(opened.agent, tmp_path) is not None
    opened.folder.state.mkdir(parents=True)
    save(opened.folder.intended, CreateRun(key="k", settings=opened.settings))
    plan(tmp_path, resume=True).check()
    (tmp_path / "skills" / "lamps" / "SKILL.md").write_text("Answer 43.")
    with pytest.raises(ConfigError, match="other skills or MCP servers than are declared now"):
        plan(tmp_path, resume=True).check()
    with pytest.raises(ConfigError, match="leave out --jail none"):
        plan(tmp_path, overwrite=True, jail=JailSettings(mode="none")).check()
