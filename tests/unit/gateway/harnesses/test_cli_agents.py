"""Codex and Claude Code as agents, against fake CLIs that speak their streams and fail in their ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from stages.cli_stage import PATH_TOKEN, Played, play, settings, thinks_without_end

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses.coding_agents import session
from evopolicy_gateway.harnesses.interface.base import AgentError
from evopolicy_gateway.relay.usage import Prices

pytestmark = pytest.mark.slow

both = pytest.mark.parametrize("harness", ["codex", "claude-code"])


def in_turns(names: str, *rows: tuple[Any, ...]) -> pytest.MarkDecorator:
    """For what the agents share: each row is of one of them."""
    cases = [(("codex", "claude-code")[k % 2], *row) for k, row in enumerate(rows)]
    return pytest.mark.parametrize(f"harness, {names}".split(", "), cases)


def sessions_of(played: Played) -> set[str]:
    """Session ids that the fake kept."""
    return {path.stem for path in (played.folder / "fake").glob("*.json")}


@both
def test_an_agent_that_stops_is_told_its_remaining_budget(tmp_path: Path, harness: str) -> None:
    played = play(tmp_path, settings(harness), "work", budget=4)
    assert played.outcome == ("agent_stopped", 2, 0)
    assert [text for _, text in played.turns] == ["submitted", "submitted"]
    first, second = played.prompts
    assert "AGENTS.md" in first["message"]
    assert "2 episodes of the budget are left" in second["message"]
    assert second["session"] in sessions_of(played)
    assert len(sessions_of(played)) == 1
    assert "resume" in " ".join(played.starts[1])


@both
def test_tokens_are_counted_as_the_paper_counts_them(tmp_path: Path, harness: str) -> None:
    prices = Prices(input=1.0, output=10.0, cache_read=0.1, cache_creation=2.0)
    played = play(tmp_path, settings(harness, prices=prices), "work", budget=4)
    tokens = played.ending.facts["tokens"]
    # Told while it plays, too, for a sweep's caps: never less than before, and the whole at the end.
    usage = [doing.tokens for doing in played.doings if doing.tokens is not None]
    outputs = [one["output"] for one in usage]
    assert outputs == sorted(outputs)
    assert usage[-1] == tokens
    known = {"input_noncached": 600, "cache_read": 1400, "output": 40}
    if harness == "codex":
        known |= {"cache_creation": 0, "reasoning": 10, "cost": pytest.approx((600 + 140 + 400) / 1e6)}
    else:
        known |= {"cache_creation": 100, "cost": pytest.approx((600 + 140 + 200 + 400) / 1e6)}
    assert tokens == known


@in_turns(
    "scenario, outcome, n_sessions",
    ("work,rate_limit,rate_limit,work", ("agent_stopped", 2, 2), 1),
    ("work,overloaded,overloaded,work", ("agent_stopped", 2, 2), 1),
    ("work,crash,crash,work", ("agent_stopped", 2, 2), 1),
    ("crash_at_once,work,work", ("agent_stopped", 2, 1), 1),
    ("work,forgotten,work", ("agent_stopped", 2, 1), 2),
    ("work,forgotten,work", ("agent_stopped", 2, 1), 2),
)
def test_a_failed_turn_is_retried_in_its_session_or_a_new_one(
    tmp_path: Path, harness: str, scenario: str, outcome: tuple[str, int, int], n_sessions: int
) -> None:
    played = play(tmp_path, settings(harness), scenario, budget=4)
    assert played.outcome == outcome
    assert len(sessions_of(played)) == n_sessions
    last = played.prompts[-1]["message"]
    if n_sessions == 1 and scenario.startswith("work"):
        assert "was interrupted" in last
        assert "2 episodes of the budget are left" in last
    if n_sessions == 2:  # what both used counts
        assert played.ending.facts["tokens"]["output"] == 40
    if scenario.startswith("crash"):
        assert played.prompts[0]["message"] == played.prompts[1]["message"]


@in_turns(
    "scenario, more, reason, details, n_starts",
    ("crash_at_once", {"retries": 2}, "agent_failed", ("3 times in a row", "exit status 139"), 3),
    ("overloaded", {"retries": 0, "max_pause_s": 0.02}, "agent_failed", ("paused for",), None),
    ("bad_key", {}, "agent_failed", ("401",), 1),
    ("bad_key", {}, "agent_failed", ("401",), 1),
    ("idle", {"reprompts": 2}, "agent_stopped", ("4 episodes left after 2 reminders",), 3),
    ("idle", {"max_tokens": 1500}, "agent_stopped", ("cap reached",), 2),
)
def test_an_agent_that_gets_no_further_ends_with_the_reason(
    tmp_path: Path,
    harness: str,
    scenario: str,
    more: dict[str, Any],
    reason: str,
    details: tuple[str, ...],
    n_starts: int | None,
) -> None:
    played = play(tmp_path, settings(harness, **more), scenario)
    assert played.ending.reason == reason
    assert all(each in played.ending.detail for each in details), played.ending.detail
    assert n_starts in (None, len(played.starts))


def test_an_outage_pauses_the_run_and_it_goes_on_afterwards(tmp_path: Path) -> None:
    scenario = ",".join(["overloaded"] * 4 + ["work"])
    played = play(tmp_path, settings("codex", retries=1, provider="p"), scenario, budget=2)
    assert (played.ending.reason, played.ending.turns) == ("agent_stopped", 1)
    assert played.ending.retries == 4
    paused = [doing for doing in played.doings if doing.paused_s]
    assert [doing.provider for doing in paused] == ["p", "p", "p"]
    assert played.ending.facts["settings"]["paused_s"] > 0


@both
def test_a_spent_quota_pauses_until_the_time_that_was_told(tmp_path: Path, harness: str) -> None:
    played = play(tmp_path, settings(harness), "quota,work", budget=2)
    assert (played.ending.reason, played.ending.retries) == ("agent_stopped", 1)
    (paused,) = [doing for doing in played.doings if doing.paused_s]
    assert 0.0 < paused.paused_s <= 1.2
    assert "limit" in paused.action


@both
@pytest.mark.parametrize("oddity", ["torn", "huge", "garbage"])
def test_odd_streams_are_read(tmp_path: Path, harness: str, oddity: str) -> None:
    played = play(tmp_path, settings(harness), oddity, budget=2)
    assert played.outcome == ("agent_stopped", 1, 0)
    assert max(map(len, played.text.splitlines())) < 2 << 20


def test_a_silent_cli_is_ended_and_its_session_resumed(tmp_path: Path) -> None:
    played = play(tmp_path, settings("claude-code", silence_s=1.0), "silent,work", budget=2)
    assert played.outcome == ("agent_stopped", 1, 1)
    (failed,) = [line for line in played.log if line.get("type") == "turn_failed"]
    assert "no output" in failed["message"]
    assert "resume" in " ".join(played.starts[1])


def test_an_endless_stream_is_ended_and_keeps_its_facts(tmp_path: Path) -> None:
    played = play(
        tmp_path, settings("claude-code", model="m"), "work,endless", budget=9, over_when=thinks_without_end
    )
    assert played.ending.facts["model_string"] == "m"
    assert played.ending.facts["tokens"]["output"] >= 20
    assert played.ending.turns == 1
    assert played.ending.retries == 0


def test_an_agent_is_not_reminded_while_its_submit_runs(tmp_path: Path) -> None:
    # A submit while another runs is refused: without the wait the only reminder would come to nothing.
    played = play(tmp_path, settings("codex", reprompts=1), "idle,work", budget=2, asked_in_flight=3)
    assert (played.ending.turns, played.ending.detail) == (2, "")


@both
def test_keys_do_not_reach_the_log(tmp_path: Path, harness: str, monkeypatch: pytest.MonkeyPatch) -> None:
    secret, oddly_named = "correct horse battery", "plain-looking-value"
    scenario = "leaks" if harness == "codex" else "work"
    config = settings(harness, pass_environment=("ODDLY_NAMED",))
    monkeypatch.setenv("ODDLY_NAMED", oddly_named)
    played = play(tmp_path, config, scenario, 2, FAKE_API_KEY=secret, ODDLY_NAMED=oddly_named)
    assert secret not in played.text
    assert "sk-proj-abc" not in played.text
    assert PATH_TOKEN not in played.text
    if harness == "codex":
        assert "my key is [redacted]" in played.text
        assert all(secret not in text for _, text in played.turns)
        assert all(secret not in doing.action for doing in played.doings)


@both
def test_a_killed_agent_goes_on_in_its_session(tmp_path: Path, harness: str) -> None:
    config = settings(harness)
    first = play(tmp_path, config, "work,endless", budget=9, over_when=thinks_without_end)
    kept = session.load(tmp_path / "session.json")
    assert kept.turns == 1
    second = play(tmp_path, config, "work,endless,work", budget=2)
    assert kept.session in " ".join(second.starts[-1])
    assert "was interrupted" in second.prompts[-1]["message"]
    assert second.ending.turns == 2
    assert second.ending.facts["tokens"]["output"] >= 40
    assert len(sessions_of(first)) == 1


@both
def test_versions_are_shown_and_lacking_options_named(tmp_path: Path, harness: str) -> None:
    played = play(tmp_path / "newer", settings(harness), "work", 2, FAKE_VERSION="99.1.0")
    assert played.ending.facts["cli_version"] == "99.1.0"
    tested = played.ending.facts["settings"]["tested_version"]
    assert tested != "99.1.0"
    (note,) = [doing.note for doing in played.doings if doing.note]
    assert note.endswith(f" 99.1.0 is used; tested was {tested}")
    with pytest.raises(AgentError, match=r"0\.1\.0 has no .*--"):
        play(tmp_path / "older", settings(harness), "work", 2, FAKE_VERSION="0.1.0", FAKE_HELP="nothing")


def test_a_cli_that_is_not_there_is_named_with_its_install_command(tmp_path: Path) -> None:
    with pytest.raises(AgentError, match="npm install -g @openai/codex"):
        play(tmp_path, settings("codex", environment={"PATH": "/nowhere"}), "work")


def test_model_effort_and_further_arguments_reach_the_cli(tmp_path: Path) -> None:
    more = {"model": "gpt-5.5", "effort": "xhigh", "extra_args": ("--config", "a=1")}
    played = play(tmp_path / "codex", settings("codex", **more), "work", 2)
    words = " ".join(played.starts[0])
    assert '--model gpt-5.5 --config model_reasoning_effort="xhigh" --config a=1 -' in words
    assert "--ignore-user-config" in words
    more = {"model": "m", "effort": "max", "user_config": True}
    words = " ".join(play(tmp_path / "claude", settings("claude-code", **more), "work", 2).starts[0])
    assert "--model m --effort max" in words
    assert "--safe-mode" not in words


def test_codex_notices_of_reconnecting_fail_no_turn(tmp_path: Path) -> None:
    played = play(tmp_path, settings("codex"), "reconnects", 2)
    assert (played.ending.turns, played.ending.retries) == (1, 0)
    assert played.ending.facts["settings"]["requests_failed"] == 1


def test_settings_that_cannot_work_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="max_cost needs"):
        play(tmp_path, settings("codex", max_cost=1.0), "work")
    with pytest.raises(ConfigError, match="NO_SUCH_NAME not set"):
        play(tmp_path, settings("codex", pass_environment=("NO_SUCH_NAME",)), "work")


def test_a_session_that_fails_after_its_last_submit_gets_no_prompt(tmp_path: Path) -> None:
    played = play(tmp_path, settings("claude-code"), "submits_and_crashes", budget=2)
    assert (played.ending.reason, len(played.prompts)) == ("agent_stopped", 1)
