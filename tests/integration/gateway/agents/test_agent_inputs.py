"""A run whose agent has a skill: shown read-only in the jail, known by its digest, and fixed while the run is open."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import command, record_in, run_dir
from stages.declared_inputs import DESCRIPTION, declare
from stages.model_api import ModelApi, Step

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.open_run import IntendedRun
from evopolicy_common.records.run_record import inputs_digest
from evopolicy_gateway import harnesses
from evopolicy_gateway.inputs.declared import read
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.run_options import RunOptions
from evopolicy_gateway.run_folder.layout import save

SUBMIT = "curl -s -X POST -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL"
LOOK = "cd /inputs/skills/lamps; cat SKILL.md; ./scripts/read.sh; touch new || echo shut; rm SKILL.md || echo kept"


def agent_file(folder: Path, base_url: str) -> None:
    declare(folder)
    (folder / "agent.toml").write_text(
        f"""
harness = "llm"
model = "m-1"
skills = ["skills/lamps"]
[api]
protocol = "openai"
base_url = "{base_url}/v1"
key = ""
"""
    )


@pytest.mark.system
def test_an_agent_reads_its_skill_and_cannot_change_it(tmp_path: Path) -> None:
    with ModelApi([Step(command=LOOK), Step(command=SUBMIT), Step(text="done")]) as api:
        agent_file(tmp_path, api.base_url)
        arguments = ("--env", "toy/line", "--agent", "file:agent.toml", "--exp-id", "t", "--budget", "2")
        small = ("--validation", "1", "--heldout", "1", "--slots", "1")
        with command(tmp_path, "local", *arguments, *small) as running:
            assert running.wait() == 0, running.text
    record = record_in(run_dir(tmp_path))
    assert [each.name for each in record.agent.inputs] == ["lamps"]
    assert record.agent.inputs == tuple(each.recorded for each in read(["skills/lamps"], {}, tmp_path))
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
    agent_file(tmp_path, "http://127.0.0.1:1")
    opened = plan(tmp_path)
    assert opened.settings.inputs == inputs_digest(opened.texts.inputs) != ""
    assert harnesses.config_of(opened.agent, tmp_path) is not None
    opened.folder.state.mkdir(parents=True)
    save(opened.folder.intended, IntendedRun(key="k", settings=opened.settings))
    plan(tmp_path, resume=True).check()
    (tmp_path / "skills" / "lamps" / "SKILL.md").write_text("Answer 43.")
    with pytest.raises(ConfigError, match="other skills or MCP servers than are declared now"):
        plan(tmp_path, resume=True).check()
    with pytest.raises(ConfigError, match="leave out --jail none"):
        plan(tmp_path, overwrite=True, jail=JailSettings(mode="none")).check()
