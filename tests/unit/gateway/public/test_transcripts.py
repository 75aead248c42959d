"""Agents' logs as steps, and as trajectories in Harbor's format (ATIF)."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from invented.agent_logs import LOGS
from invented.policies import Version
from invented.run_dirs import write_run

from evopolicy import load_runs
from evopolicy._exports.steps import read_steps
from evopolicy._exports.tracking import Curve, Point, track
from evopolicy._exports.transcripts import write_atif, write_inspect
from evopolicy_common.records.run_record import Tokens
from evopolicy_common.records.secrets import PASSED, note_passed

VERSIONS = [
    Version({"policy.py": "x = 1"}, (1.0, 2.0), 0.5, says="I begin."),
    Version({"policy.py": "x = 2"}, (3.0, 5.0), 2.5, says="It was too slow."),
]
FIELDS: dict[str, tuple[set[str], set[str]]] = {
    "trajectory": (
        {"schema_version", "agent", "steps"},
        {"session_id", "trajectory_id", "notes", "final_metrics", "continued_trajectory_ref", "extra"}
        | {"subagent_trajectories"},
    ),
    "agent": ({"name", "version"}, {"model_name", "tool_definitions", "extra"}),
    "step": (
        {"step_id", "source", "message"},
        {"timestamp", "model_name", "reasoning_effort", "reasoning_content", "tool_calls", "observation"}
        | {"metrics", "is_copied_context", "llm_call_count", "extra"},
    ),
    "call": ({"tool_call_id", "function_name", "arguments"}, {"extra"}),
    "result": (set(), {"source_call_id", "content", "subagent_trajectory_ref", "extra"}),
    "metrics": (
        set(),
        {"total_prompt_tokens", "total_completion_tokens", "total_cached_tokens", "total_cost_usd"}
        | {"total_steps", "extra"},
    ),
}
"""Required and optional fields of the published format, version 1.7."""


def log_of(tmp_path: Path, *lines: object) -> Path:
    path = tmp_path / "agent.jsonl"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"\n".join(one if isinstance(one, bytes) else json.dumps(one).encode() for one in lines))
    return path


def test_claude_codes_blocks_of_one_message_are_one_step_with_its_results(tmp_path: Path) -> None:
    def assistant(identity: str, *blocks: dict[str, Any]) -> dict[str, Any]:
        return {"type": "assistant", "message": {"id": identity, "content": list(blocks)}}

    texts = [{"type": "text", "text": text} for text in "ab"]
    result = {"type": "tool_result", "tool_use_id": "t", "content": texts, "is_error": True}
    steps = read_steps(
        log_of(
            tmp_path,
            {"type": "system", "subtype": "init"},
            {"type": "prompt", "turn": 0, "message": "Begin."},
            assistant("m1", {"type": "thinking", "thinking": "Hm."}),
            assistant("m1", {"type": "text", "text": "I look."}),
            assistant("m1", {"type": "tool_use", "id": "t", "name": "Bash", "input": {"command": "ls"}}),
            {"type": "user", "message": {"content": [result]}},
            {"type": "turn_failed", "kind": "passing", "message": "it broke"},
            # A resumed program begins to count anew.
            assistant("m1", {"type": "tool_use", "id": "t", "name": "Bash", "input": {"command": "pwd"}}),
        )
    )
    assert [(one.source, one.text) for one in steps] == [
        ("user", "Begin."),
        ("agent", "I look."),
        ("system", 'turn_failed: {"kind":"passing","message":"it broke"}'),
        ("agent", ""),
    ]
    assert steps[1].reasoning == ["Hm."]
    assert [(one.text, one.failed, one.call) for one in steps[1].results] == [
        ("a\nb", True, steps[1].calls[0])
    ]
    assert len({steps[1].calls[0].id, steps[3].calls[0].id}) == 2


def test_codex_items_are_calls_with_their_results(tmp_path: Path) -> None:
    def item(**fields: Any) -> dict[str, Any]:
        return {"type": "item.completed", "item": fields}

    steps = read_steps(
        log_of(
            tmp_path,
            item(id="item_0", type="reasoning", text="Hm."),
            item(id="item_1", type="command_execution", command="ls", aggregated_output="a", exit_code=1),
            item(id="item_2", type="file_change", changes=[{"path": "system/policy.py", "kind": "update"}]),
            item(id="item_3", type="mcp_tool_call", server="s", tool="t", arguments={"x": 1}, result="r"),
            item(id="item_4", type="agent_message", text="Done."),
        )
    )
    assert [call.name for one in steps for call in one.calls] == ["shell", "file_change", "s.t"]
    assert [(r.text, r.failed) for one in steps for r in one.results] == [("a", True), ("r", False)]
    assert steps[-1].text == "Done."


def test_lines_of_one_stream_are_one_step(tmp_path: Path) -> None:
    lines = [{"type": "stdout", "text": str(k)} for k in range(3)] + [{"type": "stderr", "text": "oh"}]
    steps = read_steps(log_of(tmp_path, *lines, {"turn": 1, "text": "said", "stop": True}))
    assert [(one.source, one.text) for one in steps] == [
        ("agent", "0\n1\n2"),
        ("system", "oh"),
        ("agent", "said"),
    ]


BEGIN = b'{"type":"assistant","message":{"content":[{"type":"tool_use","input":'
DEPTHS = [b"[" * depth + b"]" * depth for depth in (*range(1, sys.getrecursionlimit() + 10), 5000)]
"""A depth that one step of an export just reads must not be too deep for the next one."""
ODD: dict[str, list[object]] = {
    "nested": [BEGIN + each + b"}]}}" for each in DEPTHS]
    + [b'{"type":"paused","why":' + each + b"}" for each in DEPTHS],
    "odd": [
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"type": "stdout", "text": "\\ud800"}',
        [1],
        {"type": ["assistant"], "message": {}},
        {"type": "assistant", "message": {"id": 3, "content": [None, 5, {"type": "tool_use", "input": "x"}]}},
        {"type": "assistant", "message": {"content": [{"type": "text", "text": {"text": [[[1]]]}}]}},
        {"type": "user", "message": {"content": [{"type": "tool_result", "tool_use_id": {}, "content": 3}]}},
        {"type": "item.completed", "item": {"type": None, "text": [1]}},
        {"type": "prompt", "message": None, "timestamp": "yesterday"},
        {"turn": 1, "text": "x", "timestamp": 9e99},
    ],
}


@pytest.mark.parametrize("kind", ODD)
def test_whatever_an_agent_wrote_is_no_error(tmp_path: Path, kind: str) -> None:
    (run,) = load_runs(write_run(tmp_path / "runs", VERSIONS))
    log_of(run.folder / "logs", *ODD[kind])
    (path,) = write_atif(load_runs(tmp_path / "runs"), tmp_path / "out")
    check(json.loads(path.read_text()))


def test_a_log_that_is_a_link_or_a_pipe_is_not_read(tmp_path: Path) -> None:
    link, pipe = tmp_path / "agent.jsonl", tmp_path / "pipe"
    link.symlink_to(log_of(tmp_path / "other", {"type": "stdout", "text": "another's"}))
    os.mkfifo(pipe)
    assert read_steps(link) == read_steps(pipe) == []


def test_ids_of_calls_are_unique_whatever_the_log_says(tmp_path: Path) -> None:
    names = ["a-3", "a", "a", "call-5", "", "", "a"]
    blocks = [{"type": "tool_use", "id": name, "name": "x"} for name in names]
    (step,) = read_steps(log_of(tmp_path, {"type": "assistant", "message": {"content": blocks}}))
    assert len({call.id for call in step.calls}) == len(names)


@pytest.mark.parametrize("log", [*LOGS, None])
def test_trajectories_have_the_fields_of_the_published_format(tmp_path: Path, log: str | None) -> None:
    tokens = Tokens(input_noncached=100, cache_read=50, cache_creation=5, output=7, cost=0.5)
    write_run(tmp_path / "runs", VERSIONS, log=log, tokens=tokens, heldout=(4.0, 6.0))
    (path,) = write_atif(load_runs(tmp_path / "runs"), tmp_path / "out")
    document = json.loads(path.read_text())
    check(document)
    assert document["final_metrics"]["total_prompt_tokens"] == 155
    assert document["extra"]["evopolicy"]["score"] == 5.0
    if log is not None:
        assert "It was too slow." in "".join(step["message"] for step in document["steps"])


def check(document: dict[str, Any]) -> None:
    """The published fields and rules; and Harbor's own models, where these are installed."""

    def fields(kind: str, one: dict[str, Any]) -> None:
        required, optional = FIELDS[kind]
        assert required <= one.keys() <= required | optional, (kind, one.keys())

    fields("trajectory", document)
    assert document["schema_version"] == "ATIF-v1.7"
    fields("agent", document["agent"])
    fields("metrics", document["final_metrics"])
    assert [step["step_id"] for step in document["steps"]] == [*range(1, len(document["steps"]) + 1)]
    assert document["steps"]
    known: set[str] = set()
    for step in document["steps"]:
        fields("step", step)
        assert isinstance(step["message"], str)
        assert step["source"] == "agent" or (
            step["source"] in ("user", "system") and "tool_calls" not in step
        )
        own = {call["tool_call_id"] for call in step.get("tool_calls", ())}
        assert not own & known
        known |= own
        for call in step.get("tool_calls", ()):
            fields("call", call)
            assert isinstance(call["arguments"], dict)
        for result in step.get("observation", {"results": ()})["results"]:
            fields("result", result)
            assert result.get("source_call_id") in {None, *own}
    try:
        from harbor.models.trajectories import Trajectory
    except ModuleNotFoundError:
        return
    Trajectory.model_validate(document)


def test_a_run_whose_times_are_none_is_exported_with_the_others(tmp_path: Path) -> None:
    folders = [write_run(tmp_path / "runs", VERSIONS, entry=f"agent {n}") for n in range(2)]
    for folder, time in zip(folders, ("yesterday", "0001-01-01T00:00:00+23:00"), strict=True):
        record = json.loads((folder / "run.json").read_text())
        record["timing"] |= {"start_time": time, "end_time": time}
        (folder / "run.json").write_text(json.dumps(record))
    written = write_inspect(load_runs(tmp_path / "runs"), tmp_path / "out")
    assert [path.name[:10] for path in written] == ["1970-01-01"] * 2
    times: list[float] = []

    class Times:
        """A tracker that keeps the points' times."""

        def n_known(self, curve: Curve) -> int:
            return 0

        def add(self, curve: Curve, points: list[Point]) -> None:
            times.extend(point.time_s for point in points)

        def close(self) -> None:
            pass

    list(track([tmp_path / "runs"], Times(), follow=False))
    assert min(times) <= 0.0


def test_transcripts_hold_no_keys_and_no_values_that_the_run_passed(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", VERSIONS)
    folder = next((tmp_path / "runs").rglob("run.json")).parent
    key, phrase = "hf_" + "a1B2c3D4e5" * 3, 'correct "horse" battery'
    note_passed(folder / PASSED, [phrase])
    log_of(folder / "logs", {"type": "prompt", "turn": 0, "message": f"Use {key}, or say {phrase}."})
    runs = load_runs(tmp_path / "runs")
    for written in (*write_atif(runs, tmp_path / "atif"), *write_inspect(runs, tmp_path / "inspect")):
        text = written.read_text()
        json.loads(text)
        assert "Use [redacted], or say [redacted]." in text
