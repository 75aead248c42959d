"""Agents by name, and the turn protocol with real programs."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import pytest
from stages.command_stage import play, play_with_a_child_that_holds_the_pipes
from stages.loopback import serving_json

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses import entry_name, make
from evopolicy_gateway.harnesses.command import CommandHarness
from evopolicy_gateway.harnesses.interface.base import AgentError, Stage
from evopolicy_gateway.processes.agent_process import MAX_LINE_BYTES, AgentLog, environment_of
from evopolicy_gateway.processes.clock import Activity


def test_a_program_that_never_reads_plays_until_it_exits(tmp_path: Path) -> None:
    ending, log, turns = play(tmp_path, "print('working'); print('{not json'); print('[1]')")
    assert (ending.reason, ending.turns) == ("agent_stopped", 0)
    assert [line["text"] for line in log if line["type"] == "stdout"] == ["working", "{not json", "[1]"]
    assert turns == []


def test_a_program_that_fails_is_reported_with_its_status(tmp_path: Path) -> None:
    ending, log, _ = play(tmp_path, "import sys; sys.exit('out of luck')")
    assert ending.reason == "agent_failed"
    assert ending.detail.endswith("exit status 1")
    assert {"type": "stderr", "text": "out of luck"} in log


def test_turns_go_on_until_the_program_says_stop(tmp_path: Path) -> None:
    code = """
import json, sys
for line in sys.stdin:
    turn = json.loads(line)["turn"]
    print(json.dumps({"turn": turn - 1, "text": "not this turn"}))
    print(json.dumps({"turn": turn, "text": f"did {turn}", "stop": turn == 2}), flush=True)
"""
    ending, log, turns = play(tmp_path, code)
    assert (ending.reason, ending.turns) == ("agent_stopped", 3)
    assert turns == [(1, "did 0"), (2, "did 1"), (3, "did 2")]
    prompts = [line for line in log if line.get("type") == "prompt"]
    assert [prompt["turn"] for prompt in prompts] == [0, 1, 2]
    assert "AGENTS.md" in prompts[0]["message"]


OPTIONAL = """
import sys
for number, line in enumerate(sys.stdin):
    print(['{}', '{"text": "two"}', '{"turn": 2}', '{"stop": false, "other": 1}', '{"stop": true}'][number], flush=True)
"""
FROM_ONE = """
import json, sys
for number, line in enumerate(sys.stdin, 1):
    print(json.dumps({"turn": number, "stop": number == 3}), flush=True)
"""


@pytest.mark.parametrize(
    ("code", "texts"),
    [(OPTIONAL, ["", "two", "", "", ""]), (FROM_ONE, ["", "", ""])],
    ids=["few", "from one"],
)
def test_every_field_is_optional_and_turns_may_count_from_one(
    tmp_path: Path, code: str, texts: list[str]
) -> None:
    ending, _, turns = play(tmp_path, code)
    assert (ending.reason, ending.turns) == ("agent_stopped", len(texts))
    assert turns == list(enumerate(texts, 1))


IDLE = ["import time; time.sleep(1000)", "import os, time; os.close(1); time.sleep(1000)", "input(); input()"]
ANSWERS_ONLY = "import sys\nfor line in sys.stdin: print('{}', flush=True)"
CHATTERS = "import time\nwhile True: print('working on it', flush=True); time.sleep(0.2)"


@pytest.mark.parametrize("code", [*IDLE, ANSWERS_ONLY, CHATTERS])
def test_a_program_that_does_nothing_counts_as_silent(tmp_path: Path, code: str) -> None:
    ending, _, _ = play(tmp_path, code, silence_s=1.5)
    assert ending.reason == "silent"
    assert "for 1.5 s it asked for no submit" in ending.detail


WRITES = "open('notes', 'a').write('x'); time.sleep(0.5)"
COMPUTES = "sum(range(5_000_000)); time.sleep(0.01)"


@pytest.mark.parametrize("work", [WRITES, COMPUTES])
def test_a_program_that_works_without_a_word_is_not_silent(tmp_path: Path, work: str) -> None:
    code = f"import time\nends = time.monotonic() + 4.0\nwhile time.monotonic() < ends: {work}"
    ending, _, _ = play(tmp_path, code, silence_s=1.5)
    assert ending.reason == "agent_stopped"


async def test_an_agent_is_not_silent_during_its_submits(tmp_path: Path) -> None:
    activity = Activity(0.5, tmp_path / "nothing", cpu_s=lambda: 0.0)
    silence = asyncio.create_task(activity.silence())
    activity.note(1, True)
    await asyncio.sleep(1.0)
    assert not silence.done()
    activity.note(1, False)
    for submits in range(2, 6):
        await asyncio.sleep(0.2)
        activity.note(submits, False)
    assert not silence.done()
    assert "0.5 s" in await asyncio.wait_for(silence, 30.0)


def test_program_that_prints_objects_and_never_reads_plays_until_it_exits(tmp_path: Path) -> None:
    # Prompts for all of them would fill its stdin many times over.
    ending, _, turns = play(tmp_path, "for k in range(3000): print('{}', flush=True)")
    assert (ending.reason, ending.turns, len(turns)) == ("agent_stopped", 3000, 3000)


def test_answers_in_pieces_and_lines_without_end_are_read(tmp_path: Path) -> None:
    code = f"""
import json, sys, time
sys.stdin.readline()
sys.stdout.write("x" * {3 * MAX_LINE_BYTES} + "\\n")
text = json.dumps({{"turn": 0, "text": "in pieces", "stop": True}})
for part in (text[:7], text[7:20], text[20:] + "\\n"):
    sys.stdout.write(part); sys.stdout.flush(); time.sleep(0.05)
sys.stdout.write("no newline at the end")
"""
    ending, log, turns = play(tmp_path, code)
    assert ending.turns == 1
    assert turns == [(1, "in pieces")]
    assert all(len(line.get("text", "")) <= MAX_LINE_BYTES for line in log)


def test_a_child_that_holds_the_pipes_does_not_hold_up_the_end(tmp_path: Path) -> None:
    assert play_with_a_child_that_holds_the_pipes(tmp_path).reason == "agent_stopped"


def test_a_flood_of_output_does_not_block_the_program(tmp_path: Path) -> None:
    code = "import sys\nfor _ in range(2000): print('y' * 1000); print('z' * 1000, file=sys.stderr)"
    ending, log, _ = play(tmp_path, code)
    assert ending.reason == "agent_stopped"
    assert sum(line["type"] == "stdout" for line in log) == 2000


def test_the_log_stops_growing_at_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evopolicy_gateway.processes.agent_process.MAX_LOG_BYTES", 1000)
    log = AgentLog(tmp_path / "agent.jsonl")
    for _ in range(200):
        log.raw(b'{"a": 1}', "stdout")
    log.close()
    lines = (tmp_path / "agent.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["type"] == "log_full"
    assert (tmp_path / "agent.jsonl").stat().st_size < 1200


def test_an_agent_sees_the_urls_and_nothing_of_this_projects_variables(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("EVOPOLICY_STATE", "/secret")
    monkeypatch.setenv("OPENAI_API_KEY", "theirs")
    environment = environment_of({"EVOPOLICYGYM_INFO_URL": "u"})
    assert environment["EVOPOLICYGYM_INFO_URL"] == "u"
    assert environment["OPENAI_API_KEY"] == "theirs"
    assert "EVOPOLICY_STATE" not in environment


def test_a_program_that_cannot_be_started_is_reported(tmp_path: Path) -> None:
    log = AgentLog(tmp_path / "agent.jsonl")
    stage = Stage(
        workspace=tmp_path / "missing", urls={}, environment={}, log=log, on_turn=lambda turn, text: None
    )
    with pytest.raises(AgentError, match="cannot start"):
        asyncio.run(CommandHarness("command", ["/bin/true"]).run_agent(stage))
    log.close()


WRONG = ["", "evolv", "evolve:x", "replay", "replay:", "replay:nowhere", "command:", "command: "]
WRONG += ["command:no-such-program-x", "command:python3 no_such_script.py", "command:'open"]


@pytest.mark.parametrize("agent", WRONG)
def test_a_text_that_is_no_agent_is_refused_with_the_forms(agent: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--agent"):
        make(agent, tmp_path)


def test_a_replay_without_policies_is_refused_before_a_run_is_opened(tmp_path: Path) -> None:
    (tmp_path / "all" / "gym_acrobot").mkdir(parents=True)
    (tmp_path / "all" / "other").mkdir()
    (tmp_path / "all" / "other" / "policy.py").write_text("")
    harness = make("replay:all", tmp_path)
    harness.check("gym/racing")
    with pytest.raises(ConfigError, match=r"gym_acrobot holds no policy; name a folder"):
        harness.check("gym/acrobot")


def test_a_program_that_is_not_executable_is_said_to_be_so(tmp_path: Path) -> None:
    (tmp_path / "agent.py").write_text("#!/usr/bin/env python3\n")
    with pytest.raises(ConfigError, match=r"agent.py is not executable: chmod \+x ./agent.py"):
        make("command:./agent.py", tmp_path)


def test_a_script_of_the_workspace_may_be_missing_here(tmp_path: Path) -> None:
    make("command:python3 system/policy.py --log out.json", tmp_path)


def test_files_in_a_command_are_meant_from_where_it_was_given(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("")
    (tmp_path / "link").symlink_to(sys.executable)
    harness = make("command:./link mine.py --flag 'two words'", tmp_path)
    assert isinstance(harness, CommandHarness)
    assert harness._program == [str(tmp_path / "link"), str(tmp_path / "mine.py"), "--flag", "two words"]


@pytest.mark.parametrize(
    ("agent", "name"),
    {
        "evolve": "evolve",
        "random": "random",
        "replay:/tmp/gaits/": "replay-gaits",
        "command:/opt/agents/run.sh --fast": "run",
        "command:python3 my_agent.py 3": "my_agent",
        f"command:{sys.executable} -u agents/mine.py": "mine",
        "command:python3.12 -m my.agent": "my.agent",
        "command:bash -ec 'python3 x.py'": "bash",
        "command:./agent": "agent",
        "command:python3 random.py": "command-random",
        "codex": "codex",
        "codex:gpt-5.5": "gpt-5.5 (codex)",
        "claude-code:m": "m (claude-code)",
        "file:agents/qwen.toml": "qwen",
    }.items(),
)
def test_entries_are_named_after_their_agents(agent: str, name: str) -> None:
    assert entry_name(agent) == name


@pytest.mark.parametrize(
    "state", [{"remaining_budget": 0, "is_finalized": False}, {"remaining_budget": 3, "is_finalized": True}]
)
def test_a_program_gets_no_prompt_after_its_budget_is_spent(tmp_path: Path, state: dict[str, object]) -> None:
    states = iter([{"remaining_budget": 4, "is_finalized": False}])

    with serving_json(lambda *_: (200, {"state": next(states, state)})) as url:
        ending, log, turns = play(tmp_path, ANSWERS_ONLY, info=f"{url}/info")
    prompts = [line["message"] for line in log if line.get("type") == "prompt"]
    assert (ending.reason, len(turns), len(prompts)) == ("agent_stopped", 2, 2)
    assert "4 episodes of the budget are left" in prompts[1]
