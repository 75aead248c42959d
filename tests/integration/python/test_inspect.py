"""Inspect at work with the real library: it plays our tasks and gets our scores, and reads agents' logs that we
export."""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import shlex
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from installed import python_with
from invented.agent_logs import LOGS
from invented.policies import Version
from invented.run_dirs import write_run
from machines.own_certs import free_port
from waiting import wait_until

from evopolicy_common.records.run_record import Tokens

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "how-to" / "inspect.md"
POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        push = 0.95 + 0.05 * abs(obs[0])  # its cost tells episodes apart
        return [push if obs[1] >= 0 else -push]
"""
OFFLINE = """
import tiktoken

# Inspect's mock model counts tokens by a table that it downloads.
BYTES = tiktoken.Encoding(
    "bytes", pat_str=".", mergeable_ranks={bytes([each]): each for each in range(256)}, special_tokens={}
)
tiktoken.get_encoding = lambda name: BYTES
"""
PLAYS = f"""{OFFLINE}
import inspect_ai
from inspect_ai.model import ModelOutput, get_model

NAME = "mockllm/model"

def call(name, **arguments):
    return ModelOutput.for_tool_call(NAME, name, arguments)

outputs = [
    call("list_files"),
    call("read_file", path="../.gateway/bearer"),
    call("write_file", path="system/../AGENTS.md", content="no rules"),
    call("read_file", path="AGENTS.md", offset=1 << 70),
    call("write_file", path="system/" + "a/" * 1500 + "x", content=""),
    call("submit_episodes", env_instances=[0] * 9),
    call("write_file", path="system/policy.py", content={POLICY!r}),
    call("submit_episodes", env_instances=[0, 1]),
    call("read_file", path="feedback/submit_000/summary.json"),
    ModelOutput.from_content(NAME, "That is enough."),
    call("submit_episodes", env_instances=[2, 3]),
    ModelOutput.from_content(NAME, "Done."),
]
inspect_ai.eval(
    "evopolicy/core16",
    model=get_model(NAME, custom_outputs=outputs),
    sample_id="gym/continuouscar",
    task_args={{"budget": 4, "validation": 2, "heldout": 2, "exp_id": "one"}},
    log_dir="logs",
    display="plain",
)
"""
READS = """
import json, sys
from inspect_ai.log import list_eval_logs, read_eval_log

logs = [read_eval_log(info) for info in list_eval_logs(sys.argv[1])]
print(json.dumps([json.loads(log.model_dump_json(exclude_none=True)) for log in logs]))
"""


@pytest.fixture(scope="module")
def inspect() -> Path:
    """The command of an installation that has Inspect."""
    return python_with("inspect", "inspect-ai==0.3.285").with_name("inspect")


def surroundings(folder: Path) -> dict[str, str]:
    own = {"XDG_STATE_HOME": "state", "XDG_DATA_HOME": "data", "XDG_CACHE_HOME": "cache"}
    return os.environ | {name: str(folder / value) for name, value in own.items()}


def start(folder: Path, *command: str | Path, code: int = 0, **more: str) -> str:
    """What the command says, which ends with this status."""
    done = subprocess.run(
        [*map(str, command)],
        cwd=folder,
        env=surroundings(folder) | more,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if code == 0 else subprocess.STDOUT,
        text=True,
        check=False,
        timeout=500,
    )
    assert done.returncode == code, (done.stdout + (done.stderr or ""))[-6000:]
    return done.stdout


def logs_in(inspect: Path, folder: Path) -> list[Any]:
    """The logs below `folder`, as Inspect reads them."""
    return list(json.loads(start(folder.parent, inspect.with_name("python"), "-c", READS, folder)))


def test_a_model_of_inspect_plays_a_run_and_gets_its_score(inspect: Path, tmp_path: Path) -> None:
    start(tmp_path, inspect.with_name("python"), "-c", PLAYS)
    (log,) = logs_in(inspect, tmp_path / "logs")
    assert (log["status"], log["eval"]["task"]) == ("success", "evopolicy/core16")
    (sample,) = log["samples"]
    (folder,) = (tmp_path / "runs").glob("*/gym_continuouscar/one-1")
    record = json.loads((folder / "run.json").read_text())
    outcome = record["outcome"]
    assert (outcome["status"], outcome["budget_used"]) == ("completed", 4)
    assert (record["agent"]["harness"], record["jail"]) == ("remote", "none")
    assert record["hidden_isolation"] == "exclusive"
    (usage,) = sample["model_usage"].values()
    use, tokens = record["agent"]["model_use"], record["agent"]["tokens"]
    assert (use["metering"], use["limits"], use["requests"]) == ("agent", None, None)
    assert record["agent"]["model_string"] == "mockllm/model"
    assert record["agent"]["cli_version"].startswith("inspect_ai ")
    counts = ("input_noncached", "input_tokens"), ("output", "output_tokens")
    assert all(tokens[ours] == usage[theirs] > 0 for ours, theirs in counts)
    (score,) = sample["scores"].values()
    assert score["value"] == outcome["heldout_mean_return"] > 80
    assert score["metadata"]["run"] == str(folder)
    (shown,) = log["results"]["scores"]
    assert [one["value"] for one in shown["metrics"].values()] == [score["value"]]

    messages = sample["messages"]
    answers = [one for one in messages if one["role"] == "tool"]
    assert [number for number, one in enumerate(answers) if "error" in one] == [1, 2, 4, 5]
    assert len(answers) == 10
    assert "budget_invalid" in answers[5]["error"]["message"]
    assert "no rules" not in (folder / "workspace" / "AGENTS.md").read_text()
    asked = [one["content"] for one in messages if one["role"] == "user"]
    assert len(asked) == 2
    assert "2 episodes" in asked[1]
    # Nothing hidden was said to the model.
    assert str(score["value"]) not in json.dumps(messages)


def test_the_pages_commands_play(inspect: Path, tmp_path: Path) -> None:
    (line,) = re.findall(r"^inspect eval .*mockllm.*", PAGE.read_text(), re.MULTILINE)
    program = f"{OFFLINE}\nfrom inspect_ai._cli.main import main\nmain()"
    start(tmp_path, inspect.with_name("python"), "-c", program, *shlex.split(line)[1:], "--display", "plain")
    (log,) = logs_in(inspect, tmp_path / "logs")
    (sample,) = log["samples"]
    (score,) = sample["scores"].values()
    assert score["metadata"]["status"] == "no_ok_submit"
    assert math.isnan(score["value"])
    (folder,) = (tmp_path / "runs").glob("*/toy_line/*")
    assert json.loads((folder / "run.json").read_text())["outcome"]["budget_used"] == 0


def test_an_error_of_every_sample_ends_inspect_with_one_line(inspect: Path, tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    command: list[str | Path] = [
        inspect,
        "eval",
        "evopolicy/environments",
        "-T",
        "envs=toy/line",
        "-T",
        f"state={state}",
    ]
    command += ["--model", "mockllm/model", "--display", "plain"]
    away = {"HTTPS_PROXY": "http://127.0.0.1:1", "TIKTOKEN_CACHE_DIR": str(tmp_path / "none")}
    with (state / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        (tmp_path / "sitecustomize.py").write_text(OFFLINE)
        for more, expected in (
            (away, "set TIKTOKEN_CACHE_DIR to its path"),
            ({"PYTHONPATH": str(tmp_path)}, "choose another folder with -T state=FOLDER"),
        ):
            said = start(tmp_path, *command, code=1, **more)
            assert expected in " ".join(said.split())
            assert "Traceback" not in said
    assert not (tmp_path / "runs").exists()


def test_exported_logs_of_agents_are_listed_read_and_served_by_inspect(inspect: Path, tmp_path: Path) -> None:
    versions = [
        Version({"policy.py": "x = 1"}, (1.0, 2.0), 0.5, says="I begin."),
        Version({"policy.py": "x = 2"}, (3.0, 5.0), 2.5, says="It was too slow."),
    ]
    tokens = Tokens(input_noncached=100, cache_read=50, cache_creation=5, output=7)
    for kind in (*LOGS, None):
        write_run(
            tmp_path / "runs", versions, entry=f"By {kind}", log=kind, heldout=(4.0, 6.0), tokens=tokens
        )
    (tmp_path / "runs" / "By-None" / "gym_acrobot" / "exp" / "logs" / "agent.jsonl").write_bytes(ODD)
    # The page's command, with this installation's program.
    (line,) = re.findall(
        r"^evopolicy (export .*--to inspect .*)", (PAGE.parent / "export.md").read_text(), re.MULTILINE
    )
    for _ in range(2):
        start(tmp_path, inspect.with_name("python"), "-m", "evopolicy_gateway.cli", *shlex.split(line))
    logs = {log["eval"]["model"]: log for log in logs_in(inspect, tmp_path / "logs")}
    assert len(logs) == len(list((tmp_path / "logs").iterdir())) == len(LOGS) + 1
    for log in logs.values():
        assert (log["status"], log["eval"]["task"]) == ("success", "evopolicy/gym/acrobot")
        (sample,) = log["samples"]
        assert sample["scores"]["heldout"]["value"] == 5.0
        assert sample["metadata"]["best_submit"] == 1
        assert [usage["total_tokens"] for usage in sample["model_usage"].values()] == [162]
    for kind in LOGS:
        assert "It was too slow." in json.dumps(logs[f"by {kind}"]["samples"][0]["messages"])
    (sample,) = logs["by claude"]["samples"]
    said = [one for one in sample["messages"] if one["role"] == "assistant"]
    calls = [call for one in said for call in one.get("tool_calls", ())]
    assert [call["function"] for call in calls][:3] == ["Edit", "Bash", "Read"]
    answers = [one for one in sample["messages"] if one["role"] == "tool"]
    assert {one["tool_call_id"] for one in answers} <= {call["id"] for call in calls}

    port = free_port()
    command = [str(inspect), "view", "start", "--log-dir", "logs", "--host", "127.0.0.1", "--port", str(port)]
    out = tmp_path / "view.txt"
    with out.open("wb") as said_by_view:
        view = subprocess.Popen(
            command, cwd=tmp_path, env=surroundings(tmp_path), stdout=said_by_view, stderr=said_by_view
        )
    try:
        wait_until(lambda: view.poll() is not None or answers_at(port), out.read_text)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/logs", timeout=60) as answer:
            listed = json.load(answer)
        assert len(listed["files"]) == len(logs)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as answer:
            assert b"<html" in answer.read()
    finally:
        view.terminate()
        view.wait(timeout=60)


DEEP = b'{"a":' * 90 + b"1" + b"}" * 90
ODD = b"\n".join(
    [
        b"\xff\xfe",
        b'{"type": "stdout", "text": "\\ud800"}',
        b'{"type": "stdout", "text": "plain"}',
        b'{"type": "assistant", "message": {"content": [{"type": "tool_use", "input": "x"}]}}',
        b'{"type": "assistant", "message": {"content": [{"type": "thinking", "thinking": "Hm."}]}}',
        b'{"type": "user", "message": {"content": [{"type": "tool_result", "content": "no", "is_error": true}]}}',
        b'{"type": "paused", "why": ' + b"[" * 90 + b"]" * 90 + b"}",
        b'{"type": "assistant", "message": {"content": [{"type": "tool_use", "name": "f", "input": %s}]}}'
        % DEEP,
    ]
)
"""Lines that an agent of its own may write."""


def answers_at(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5):
            return True
    except OSError:
        return False
