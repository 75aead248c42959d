"""A whole run of an agent that speaks the Agent Client Protocol, in its jail."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import command, record_in, run_dir
from stages.cli_stage import FAKES

pytestmark = pytest.mark.system


def test_an_agent_behind_the_protocol_plays_a_whole_run_in_its_jail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_SCENARIO", "work,crash,work")
    monkeypatch.setenv("FAKE_STATE", "fake")  # in its workspace
    arguments = ("--env", "toy/line", "--agent", f"acp:{FAKES}/acp-agent", "--exp-id", "t", "--budget", "4")
    small = ("--validation", "1", "--heldout", "1", "--slots", "1")
    shown = ("--jail-env", "FAKE_SCENARIO", "--jail-env", "FAKE_STATE")
    with command(tmp_path, "local", *arguments, *small, *shown) as running:
        assert running.wait() == 0, running.text
    folder = run_dir(tmp_path)
    record = record_in(folder)
    assert (record.jail, record.agent.harness, record.agent.cli_version) == ("bwrap", "acp", "fake 1.2")
    assert (record.outcome.budget_used, record.agent.retries) == (4, 1)
    assert record.agent.tokens is not None
    assert record.agent.tokens.output == 20
    requests = (folder / "workspace/fake/requests").read_text().splitlines()
    assert (requests.count("session/new"), requests.count("session/load")) == (1, 1)
    lines = [json.loads(line) for line in (folder / "logs/agent.jsonl").read_text().splitlines()]
    assert any(line.get("type") == "turn_failed" and "out of cheese" in line["message"] for line in lines)
