"""The rules of coding agents that need no process: troubles, back-off, redaction, settings, configured CLIs, the
clock."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from program_runs import put_program
from stages.cli_stage import FAKES, play, settings

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.harnesses import make
from evopolicy_gateway.harnesses.coding_agents import codex
from evopolicy_gateway.harnesses.coding_agents.claude_code import ClaudeReader
from evopolicy_gateway.harnesses.coding_agents.configured import ConfiguredCli, ConfiguredReader, values
from evopolicy_gateway.harnesses.coding_agents.dialect import usage_of
from evopolicy_gateway.harnesses.coding_agents.turn_failure import MAX_BACKOFF_S, backoff_s, turn_failure_of
from evopolicy_gateway.harnesses.interface.agent_config import (
    AgentConfig,
    Cli,
    Events,
    TokenPaths,
    read_agent,
)
from evopolicy_gateway.processes.clock import AgentClock
from evopolicy_gateway.relay.usage import MAX_COUNT, Usage

EXAMPLES = Path(__file__).parents[4] / "examples" / "agents"


@pytest.mark.parametrize(
    ("message", "status", "kind", "provider"),
    [
        ("exceeded retry limit, last status: 429 Too Many Requests", None, "passing", True),
        ("unexpected status 529 <unknown>: overloaded, url: http://h:46209/v1", None, "passing", True),
        ("stream disconnected before completion: error sending request", None, "passing", True),
        ("API Error: Request rejected (429) · rate limited", 429, "passing", True),
        ("API Error: 500 Internal server error", None, "passing", True),
        ("You've hit your usage limit. Try again in 3 hours 5 minutes.", None, "quota", True),
        ("Claude AI usage limit reached|1900000000", 429, "quota", True),
        ("Credit balance is too low", 400, "final", True),
        ("quota exceeded: You exceeded your current quota, please check your plan", 429, "final", True),
        ("Insufficient Balance", 402, "final", True),
        ("quota exceeded: billing; try again in 30 s", 429, "quota", True),
        ("3 faulty answers in a row, the last: there is no tool 'edit'", None, "faulty", False),
        ("10 times in a row the same command with the same output: ls", None, "faulty", False),
        ("unexpected status 401 Unauthorized: You exceeded your current quota", None, "final", True),
        ("Invalid API key · Please run /login", None, "final", True),
        ("API Error: 400 prompt is too long", None, "final", True),
        ("No conversation found with session ID: 1-2", None, "lost", False),
        ("thread/resume failed: no rollout found for thread id 1 (code -32600)", None, "lost", False),
        ("Segmentation fault", None, "passing", False),
    ],
)
def test_the_words_of_a_cli_decide_the_kind_of_failure(
    message: str, status: int | None, kind: str, provider: bool
) -> None:
    failure = turn_failure_of(message, status, now=1.0)
    assert (failure.kind, failure.provider) == (kind, provider)


@pytest.mark.parametrize(
    ("text", "wait_s"),
    [
        ("usage limit, try again in 3 hours 5 minutes", 3 * 3600 + 300),
        ("Rate limit is exceeded. Try again in 17 seconds.", 17),
        ("Claude AI usage limit reached|1900000000", 10),
        ('{"type":"usage_limit_reached","resets_in_seconds":9568}', 9568),
        ("Quota exceeded. It resets at 2030-03-17T18:46:30Z.", 3600),
        ("usage limit reached; resets 6pm (UTC)", 13 * 60 + 30),
        ("hit your limit, resets 12:30 AM (America/Los_Angeles)", 13 * 3600 + 43 * 60 + 30),
        ("limit reached: available until 17:00 UTC", 23 * 3600 + 13 * 60 + 30),
        ("resets at 25:00 UTC", None),
        ("resets 6pm (Atlantis/Port)", None),
        ("retry again with 2 others", None),
        ("try again later", None),
    ],
)
def test_a_told_waiting_time_is_understood(text: str, wait_s: float | None) -> None:
    assert turn_failure_of(text, now=1_899_999_990.0).wait_s == wait_s


@given(attempt=st.integers(1, 10_000), chance=st.floats(0.0, 1.0, exclude_max=True))
def test_back_off_doubles_within_its_jitter_and_its_bound(attempt: int, chance: float) -> None:
    delay = backoff_s(attempt, 4.0, chance)
    whole = 4.0 * 2.0 ** min(attempt - 1, 16)
    assert min(MAX_BACKOFF_S, 0.75 * whole) <= delay <= min(MAX_BACKOFF_S, 1.25 * whole)


LONG = 1_000_000


@pytest.mark.parametrize(
    "text",
    [
        "retry in " + "9" * 400 + " x",  # infinity times nothing
        "retry in " + "9" * 400 + " hours",
        "resets_in_seconds: " + "9" * 400,
        "retry in " + "1" * LONG,
        "retry in " + "1.1" * LONG,
        "retry in " + "1 s, " * (LONG // 5),
        "retry in 1 " * (LONG // 11),
        " " * LONG,
    ],
)
def test_no_text_of_a_cli_gives_an_endless_wait_or_takes_long(text: str) -> None:
    wait_s = turn_failure_of(text, now=1.0).wait_s
    assert wait_s is None or 0.0 <= wait_s < float("inf")


@pytest.mark.parametrize(
    "piece", ["eyJ-", "eyJaaaaaaaaaaaa.", "sk-", "Bearer ", "bearer" + " " * 99, "-", "a.eyJ"]
)
def test_redaction_takes_time_that_grows_with_a_lines_length(piece: str) -> None:
    Redaction(["secret-word"])((piece * (LONG // len(piece))).encode())


def in_codex(counts: dict[str, Any]) -> Usage:
    return usage_of({"usage": counts}, codex.TOKENS) or Usage()


def test_counts_of_tokens_are_bounded() -> None:
    usage = in_codex({"input_tokens": 10**400, "cached_input_tokens": -1, "output_tokens": 1 << 70})
    assert (usage.input_noncached, usage.cache_read, usage.output) == (MAX_COUNT, 0, MAX_COUNT)


def test_messages_of_claude_are_counted_once_each_however_many_there_are() -> None:
    reader = ClaudeReader()

    def report_usage(identity: int, output: int) -> None:
        usage = {"output_tokens": output, "input_tokens": 1}
        reader.read_event({"type": "assistant", "message": {"id": f"m{identity}", "usage": usage}})

    for identity in range(100_000):
        report_usage(identity, 1)
        report_usage(identity, 3)
    assert (reader.usage.output, reader.usage.input_noncached) == (300_000, 100_000)
    assert len(reader._messages) <= 1000


def test_cached_input_is_taken_off_in_codex_streams() -> None:
    counts = {"input_tokens": 10, "cached_input_tokens": 7, "output_tokens": 3, "reasoning_output_tokens": 2}
    usage = in_codex(counts)
    assert (usage.input_noncached, usage.cache_read, usage.output, usage.reasoning) == (3, 7, 3, 2)
    assert in_codex({"input_tokens": True, "output_tokens": "x"}).total == 0


@given(
    secret=st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=8, max_size=40),
    around=st.text(),
)
def test_a_logged_line_stays_a_document_without_the_secret(secret: str, around: str) -> None:
    redact = Redaction([secret])
    document = json.loads(redact(json.dumps({"text": f"{around} {secret} {around}"}).encode()))
    assert secret not in document["text"]


def test_redaction_knows_names_of_variables_and_looks_of_keys() -> None:
    redact = Redaction.of(
        {"MY_API_KEY": "0123456789", "SSH_AUTH_SOCK": "/run/agent.sock", "LANG": "en_GB.UTF-8"},
        {"EVOPOLICYGYM_INFO_URL": "http://127.0.0.1:4/abcdefabcdefabcdef/info"},
    )
    line = redact.text("0123456789 /run/agent.sock en_GB.UTF-8 http://127.0.0.1:4/abcdefabcdefabcdef/info")
    assert line == "[redacted] /run/agent.sock en_GB.UTF-8 http://127.0.0.1:4/[redacted]/info"
    assert redact.text("Authorization: Bearer abcdefghijklmnop") == "Authorization: Bearer [redacted]"
    assert redact.text("sk-ant-" + "a1B2" * 6) == "[redacted]"
    assert redact.text("task-list of the mask-rcnn") == "task-list of the mask-rcnn"


def test_the_clock_stands_still_in_a_pause_and_for_hidden_episodes() -> None:
    now = [0.0]
    clock = AgentClock(10.0, lambda: now[0])
    now[0] = 4.0
    with clock.paused():
        now[0] = 1000.0
        assert clock.remaining_s() == 6.0
    now[0] = 1005.0
    clock.set_held(3.0)
    assert (clock.remaining_s(), clock.used_s()) == (4.0, 6.0)
    clock.set_held(2.0)
    assert clock.remaining_s() == 4.0
    clock.set_held(5.0)
    now[0] = 1012.0
    assert clock.remaining_s() == -1.0


QWEN = """
harness = "qwen"
program = ["fake-qwen"]
model = "qwen3-coder"
[cli]
first = ["--prompt-from-stdin", "--model", "{model}"]
resume = ["--resume", "{session}", "--model", "{model}"]
[cli.events]
session = ["session_id"]
text = ["message.content.*.text"]
error = ["error.message"]
[cli.events.tokens]
input = "usage.in"
cache_read = "usage.cached"
output = "usage.out"
input_includes_cached = true
"""

FAKE = f"""#!{sys.executable}
import sys
sys.path.insert(0, {str(FAKES)!r})
from fake_stream import emit, scenario, submit
if sys.argv[1:] == ["--version"]:
    print("fake 1.2.3")
    sys.exit()
"""
FAKE_QWEN = """if scenario() == "busy":
    emit({"error": {"message": "503 overloaded"}})
    sys.exit(1)
submit(2)
emit({"session_id": "s-1"})
emit({"message": {"content": [{"kind": "thought"}, {"text": "made it better"}]}})
emit({"usage": {"in": 10, "cached": 4, "out": 2}})
"""


def fake(tmp_path: Path, code: str) -> tuple[str, ...]:
    """A CLI, as the agent's program."""
    return (str(put_program(tmp_path / "fake-cli", FAKE + code)),)


def test_a_cli_without_a_harness_is_described_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "qwen.toml").write_text(QWEN)
    config = read_agent(tmp_path / "qwen.toml")
    quick = settings("qwen", program=fake(tmp_path, FAKE_QWEN), model=config.model, cli=config.cli)
    played = play(tmp_path, quick, "work,busy,work", budget=4)
    assert played.outcome == ("agent_stopped", 2, 1)
    assert played.turns[0] == (1, "made it better")
    assert played.starts[0] == ["--prompt-from-stdin", "--model", "qwen3-coder"]
    assert played.starts[2] == ["--resume", "s-1", "--model", "qwen3-coder"]
    facts = played.ending.facts
    assert (facts["harness"], facts["cli_version"]) == ("qwen", "1.2.3")
    assert facts["tokens"] == {"input_noncached": 12, "cache_read": 8, "cache_creation": 0, "output": 4}


FAKE_KIMI = """name = scenario()
if name == "error":
    emit({"type": "error", "code": "rate_limit", "message": "429 rate limited", "retryable": True})
    sys.exit(75)
call = {"type": "function", "id": "tc_1", "function": {"name": "Bash", "arguments": '{"command": "curl"}'}}
emit({"role": "assistant", "content": "", "tool_calls": [call]})
emit({"role": "tool", "tool_call_id": "tc_1", "content": str(submit(2)), "session_id": "not this one"})
emit({"role": "assistant", "content": "made it better"})
emit({"role": "meta", "type": "session.resume_hint", "session_id": "s-7", "content": "To resume"})
"""


def test_the_example_file_of_kimi_speaks_its_documented_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KIMI_MODEL_API_KEY", "key-0123456789")
    program = fake(tmp_path, FAKE_KIMI)
    config = msgspec.structs.replace(read_agent(EXAMPLES / "kimi.toml"), program=program, backoff_s=0.001)
    played = play(tmp_path, config, "work,error,work", 4, KIMI_MODEL_API_KEY="key-0123456789")
    assert played.outcome == ("agent_stopped", 2, 1)
    assert [text for _, text in played.turns] == ["made it better"] * 2
    assert any(doing.action == '{"command": "curl"}' for doing in played.doings)
    assert played.starts[0][:2] == ["--prompt", played.prompts[0]["message"]]
    assert played.starts[2][:2] == ["--session", "s-7"]
    assert "tokens" not in played.ending.facts


def test_the_example_files_of_other_clis_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GEMINI_API_KEY", "OPENAI_API_KEY", "KIMI_MODEL_API_KEY"):
        monkeypatch.setenv(name, "set")
    docs = (EXAMPLES.parents[1] / "docs" / "how-to" / "agents-clis.md").read_text()
    files = sorted(EXAMPLES.glob("*.toml"))
    assert [path.stem for path in files] == ["gemini", "kimi", "qwen"]
    for path in files:
        agent = make(f"file:{path}", EXAMPLES)
        assert (agent.name, agent.resumable) == (path.stem, True)
        assert f"examples/agents/{path.name}" in docs
    assert (EXAMPLES / "qwen.toml").read_text().partition("\n#")[2].partition("\n")[2] in docs


def test_an_event_counts_only_where_its_path_allows_it() -> None:
    paths = TokenPaths(
        input="u.in", cache_read="u.cached", output="u.out", total="u.all", input_includes_cached=True
    )
    events = Events(error=("[type=result].error.message",), text=("[role=assistant].content",), tokens=paths)
    reader = ConfiguredReader(events)
    reader.read_event({"type": "tool_result", "error": {"message": "no such file"}})
    reader.read_event({"type": "message", "role": "user", "content": "the prompt"})
    assert (reader.failure, reader.text) == (None, "")
    reader.read_event({"type": "message", "role": "assistant", "content": "done"})
    # Tokens beyond input and output are reasoning.
    reader.read_event({"type": "result", "u": {"in": 10, "cached": 4, "out": 2, "all": 15}})
    assert (reader.text, reader.usage) == ("done", Usage(input_noncached=6, cache_read=4, output=5))
    reader.read_event({"type": "result", "error": {"message": "429 too many requests"}})
    assert reader.failure is not None
    event = {"a": [{"k": "x", "b": 1}, {"k": "y", "c": 2}, {"k": "y", "b": 3}], "d": {"e": "f"}}
    for path, expected in {"a.*.b": [1, 3], "a.*.[k=y].b": [3], "d.e": ["f"]}.items():
        assert list(values(event, path)) == expected
    for odd in ("[", "[a", "[a=", "]", "[k=x]", "a..b", "d.e.x", ""):
        assert list(values(event, odd)) == []


def test_an_effort_that_would_not_reach_the_cli_is_refused() -> None:
    cli = Cli(first=("--think", "{effort}"))
    config = AgentConfig(harness="x", program=("x",), effort="high", cli=cli)
    assert ConfiguredCli(config).arguments(None, resume=False, prompt="", options="") == ["--think", "high"]
    none = msgspec.structs.replace(config, effort=None)
    assert ConfiguredCli(none).arguments(None, resume=False, prompt="", options="") == []
    with pytest.raises(ConfigError, match="effort = 'high'"):
        msgspec.structs.replace(config, cli=Cli(first=("go",))).check()


def test_arguments_of_a_configured_cli_are_filled_in_once() -> None:
    cli = Cli(first=("-m", "{model}", "--id={session}", "-p", "{prompt}"), prompt="argument")
    dialect = ConfiguredCli(AgentConfig(harness="x", program=("x",), cli=cli))
    words = dialect.arguments(None, resume=False, prompt="say {model} and {session}", options="")
    assert words == ["-p", "say {model} and {session}"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('harness = "codex"\nmodle = "x"\n', "modle"),
        ('harness = "codex"\nbackoff_s = 0.0\n', "backoff_s"),
        ('harness = "codex"\nprices = {input = nan, output = 1.0}\n', r"prices\.input"),
        ('harness = "gemini"\n', r"\[cli\]"),
        ('harness = "codex"\n[cli]\nfirst = []\n', r"takes no \[cli\]"),
    ],
)
def test_agents_files_refuse_what_they_do_not_know(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ConfigError, match=match):
        make("file:a.toml", tmp_path)
