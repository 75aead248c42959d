"""Agents that speak the Agent Client Protocol: a made-up one that does well, fails and asks, and the messages by
themselves."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import pytest
from stages.cli_stage import FAKES, Played, play, settings

from evopolicy_common.errors import ConfigError
from evopolicy_gateway import harnesses
from evopolicy_gateway.harnesses.coding_agents.acp_stream import AcpReader, permission, usage_of
from evopolicy_gateway.harnesses.interface.agent_config import AcpTable
from evopolicy_gateway.harnesses.interface.base import AgentError
from evopolicy_gateway.relay.usage import Usage

PROGRAM = (str(FAKES / "acp-agent"),)


def played(tmp_path: Path, scenario: str, budget: int = 4, **more: Any) -> Played:
    return play(tmp_path, settings("acp", program=PROGRAM, acp=AcpTable(), **more), scenario, budget=budget)


def kept(run: Played, name: str) -> list[str]:
    return (run.folder / "fake" / name).read_text().splitlines()


def test_an_agent_that_stops_is_prompted_again_in_its_session(tmp_path: Path) -> None:
    run = played(tmp_path, "work")
    assert run.outcome == ("agent_stopped", 2, 0)
    assert run.turns == [(1, "done 0"), (2, "done 1")]
    assert run.ending.facts["cli_version"] == "fake 1.2"
    tokens = run.ending.facts["tokens"]
    assert (tokens["input_noncached"], tokens["cache_read"], tokens["output"]) == (60, 140, 20)
    assert kept(run, "requests").count("session/new") == 1
    assert any(doing.action == "$ submit" for doing in run.doings)
    # As the live page and the reports read it.
    texts = [line["message"]["content"][0] for line in run.log if line.get("type") == "assistant"]
    assert [block.get("text", block.get("input")) for block in texts[:3]] == [
        "let me",
        {"command": "submit"},
        "done 0",
    ]


@pytest.mark.parametrize(
    ("scenario", "requests", "retries"),
    [
        ("work,crash,work", {"session/new": 1, "session/load": 1}, 1),
        ("work,crash,work,noload", {"session/new": 2}, 2),
        ("work,crash,work,lostload", {"session/new": 2, "session/load": 1}, 2),
        ("work,busynew", {"session/new": 2}, 1),  # a session that could not begin
        ("busy,work", {"initialize": 1}, 1),
        ("deeperror,deep", {}, 1),
        ("silent,work", {"initialize": 2}, 1),
        ("deaf,work", {}, 1),
    ],
)
def test_an_agent_that_fails_goes_on_in_a_session(
    tmp_path: Path, scenario: str, requests: dict[str, int], retries: int
) -> None:
    run = played(tmp_path, scenario, silence_s=1.0)
    assert run.outcome == ("agent_stopped", 2, retries), run.ending.detail
    assert {name: kept(run, "requests").count(name) for name in requests} == requests
    if scenario == "work,crash,work":
        failed = next(line for line in run.log if line.get("type") == "turn_failed")
        assert "out of cheese" in failed["message"]
        # A loaded session repeats texts that are not the new turn's.
        assert run.turns[-1] == (2, "done 2")
    if scenario.endswith("load"):
        assert run.prompts[-1]["message"].startswith("Read AGENTS.md")
    if "deep" in scenario:
        assert {"type": "user", "text": "nested too deeply to be kept"} in run.log
    # An agent that reads no answers, to 20 MB of requests, is not read either: what was read stands in the log.
    assert (tmp_path / "agent.jsonl").stat().st_size < 4 << 20


@pytest.mark.parametrize("name", ["model", "effort"])
def test_a_setting_that_can_be_neither_chosen_nor_seen_ends_the_run(tmp_path: Path, name: str) -> None:
    setting: dict[str, Any] = {name: "some-value"}
    with pytest.raises(AgentError, match=f"put the {name} into `program`"):
        played(tmp_path / "a", "work", **setting)
    run = played(tmp_path / "b", "work", extra_args=(f"--{name}=some-value",), **setting)
    assert run.ending.reason == "agent_stopped"


def test_a_session_plays_in_the_mode_that_asks_permission(tmp_path: Path) -> None:
    """Others let a model of the agent's own decide what it may do, or refuse what the run's rules allow."""
    played(tmp_path / "modes", "work,crash,work,modes")
    # Also in a session that is loaded after a crash.
    assert kept(Played(tmp_path / "modes"), "chosen") == ["default", "default"]
    played(tmp_path / "options", "work,options")
    assert kept(Played(tmp_path / "options"), "chosen") == ["mode default"]
    named = settings("acp", program=PROGRAM, acp=AcpTable(mode="plan"))
    assert kept(play(tmp_path / "named", named, "work,modes"), "chosen") == ["plan"]


@pytest.mark.parametrize(
    ("model", "args", "chosen"),
    [
        ("small-1", (), ["mode default", "model small-1"]),
        ("SMALL-1", (), ["mode default", "model small-1"]),
        ("huge", ("--model=huge",), ["mode default"]),  # not offered, so the program's own
    ],
)
def test_a_model_is_chosen_by_its_id_or_its_name(
    tmp_path: Path, model: str, args: tuple[str, ...], chosen: list[str]
) -> None:
    run = played(tmp_path, "work,options", model=model, extra_args=args)
    assert kept(run, "chosen") == chosen


def test_requests_that_cannot_be_answered_are_not_logged_one_by_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = played(tmp_path, "deepid,work")
    assert (run.ending.reason, run.ending.turns) == ("agent_stopped", 2)
    assert [record.message for record in caplog.records if record.exc_info] == []


def test_an_agent_that_is_not_logged_in_ends_the_run(tmp_path: Path) -> None:
    run = played(tmp_path, "login")
    assert run.ending.reason == "agent_failed"
    assert "not logged in" in run.ending.detail


def test_permissions_follow_the_rules_and_this_side_is_out_of_reach(tmp_path: Path) -> None:
    run = played(tmp_path, "asks", budget=2)
    answers = [line.rpartition(" ")[2] for line in kept(run, "permissions")]
    assert answers == ["reject_once", "reject_once", "reject_once", "allow_once", "allow_once"]
    assert all("Method not found" in line for line in kept(run, "refused"))
    assert [line["outcome"] for line in run.log if line.get("type") == "permission"] == ["selected"] * 5


def test_an_option_that_is_not_offered_is_not_chosen() -> None:
    options = [{"optionId": "a", "kind": "allow_always"}]
    asked = {"toolCall": {"kind": "edit", "locations": [{"path": "/w/feedback/x"}]}, "options": options}
    assert permission(asked, PurePosixPath("/w")) == {"outcome": {"outcome": "cancelled"}}
    asked["toolCall"] = {"kind": "edit"}
    assert permission(asked, PurePosixPath("/w"))["outcome"]["optionId"] == "a"
    for odd in ({}, {"options": 3, "toolCall": []}, {"options": [1, {"kind": "allow_once"}]}):
        assert permission(odd, PurePosixPath("/w")) == {"outcome": {"outcome": "cancelled"}}


@pytest.mark.parametrize(
    ("given", "cached", "output", "thought", "total", "usage"),
    [
        (30, 70, 5, None, 105, Usage(input_noncached=30, cache_read=70, output=5)),
        (100, 70, 5, None, 105, Usage(input_noncached=30, cache_read=70, output=5)),
        (10, None, 5, 3, 18, Usage(input_noncached=10, output=8, reasoning=3)),
        (10, None, 5, 3, 15, Usage(input_noncached=10, output=5, reasoning=3)),
        ("x", None, -1, None, None, Usage()),
    ],
)
def test_tokens_are_counted_whatever_an_agent_counts_into_its_input(
    given: Any, cached: Any, output: Any, thought: Any, total: Any, usage: Usage
) -> None:
    reported = {"inputTokens": given, "cachedReadTokens": cached, "outputTokens": output}
    assert usage_of(reported | {"thoughtTokens": thought, "totalTokens": total}) == usage


def test_tokens_of_requests_are_added_where_the_answer_has_none() -> None:
    chunk = {"sessionUpdate": "agent_message_chunk", "content": {"type": "text", "text": ""}}
    counts = {"inputTokens": 100, "outputTokens": 5, "totalTokens": 105, "cachedReadTokens": 70}
    reader = AcpReader()
    for _ in range(2):
        reader.read_event({**chunk, "_meta": {"usage": counts}})
    # A turn that fails has spent them too.
    assert reader.usage == Usage(input_noncached=60, cache_read=140, output=10)
    reader.ended({"stopReason": "end_turn"})
    assert reader.usage == Usage(input_noncached=60, cache_read=140, output=10)
    reader.ended({"stopReason": "end_turn", "usage": counts})
    assert reader.usage == Usage(input_noncached=30, cache_read=70, output=5)


def test_odd_updates_are_skipped() -> None:
    reader = AcpReader()
    for update in (
        {},
        {"sessionUpdate": "tool_call", "toolCallId": 3, "title": [], "rawInput": "x"},
        {"sessionUpdate": "agent_message_chunk", "content": "x"},
        {"sessionUpdate": "tool_call_update", "status": "completed", "toolCallId": None},
    ):
        reader.read_event(update)
    reader.ended({"stopReason": "cancelled", "usage": 3, "_meta": []})
    assert (reader.done, reader.text, reader.usage) == (False, "", Usage())


def test_the_memory_of_a_turn_is_bounded() -> None:
    reader = AcpReader()
    large = {"text": "x" * (300 << 10)}
    for n in range(1000):
        reader.read_event(
            {"sessionUpdate": "tool_call", "toolCallId": f"t{n}", "title": "Write", "rawInput": large}
        )
        reader.read_event({"sessionUpdate": "agent_message_chunk", "content": {"text": ""}})
    assert len(reader._calls) == 64
    assert sum(len(str(call)) for call in reader._calls.values()) < 1 << 20
    assert reader._text == []
    # The latest are still known by name.
    reader.entries()
    reader.read_event({"sessionUpdate": "tool_call_update", "toolCallId": "t999", "status": "completed"})
    used = reader.entries()[0]["message"]["content"][0]
    assert (used["name"], used["input"]) == ("Write", {"title": "Write"})


def test_the_command_line_names_the_program(tmp_path: Path) -> None:
    made = harnesses.make(f"acp:{PROGRAM[0]} --flag", tmp_path)
    assert (made.name, list(made.command)) == ("acp", [*PROGRAM, "--flag"])
    assert harnesses.entry_name("acp:gemini --acp") == "acp-gemini"
    with pytest.raises(ConfigError, match="program"):
        harnesses.make("acp", tmp_path, settings("acp", acp=AcpTable()))
