"""What an agent writes: no log and no source stops a report, or takes time by the square of its length.

The sizes are such that a rule of quadratic time would not come to an end within these tests' patience.
"""

from __future__ import annotations

import json
import os
import random
from pathlib import Path

import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_results import report as writing
from evopolicy_results.behaviour.trace import Trace
from evopolicy_results.code import sources
from evopolicy_results.code.sources import n_changed, parse, reachable_modules, unified
from evopolicy_results.reading import agent_log
from evopolicy_results.reading.agent_log import read_agent_log
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.report import write_report
from evopolicy_results.studies.study import study

VERSIONS = [Version(policy(gain=1.0), (-200.0,), -180.0), Version(policy(gain=2.0), (-90.0,), -95.0)]
LONG = 1_000_000


def write_log(run: Path, *lines: object) -> None:
    text = "\n".join(line if isinstance(line, str) else json.dumps(line) for line in lines)
    (run / "logs" / "agent.jsonl").write_text(text + "\n")


def call(text: str) -> dict[str, object]:
    return {
        "type": "item.completed",
        "item": {"type": "command_execution", "command": text, "aggregated_output": text},
    }


HOSTILE_LINES = [
    '{"type": "stdout", "text": "x", "at": ' + "9" * 400 + "}",
    '{"turn": ' + "9" * 400 + ', "text": "x"}',
    '{"type": "stdout", "text": "x", "timestamp": "' + "9" * 400 + '"}',
    '{"type": "stdout", "text": "x", "timestamp": "0001-01-01T00:00:00+23:59"}',
    '{"type": "stdout", "text": "submit_' + "9" * 400 + '"}',
    "[" * 100_000,
    '{"payload": "' + "[" * 100_000 + '"}',
    '{"type": "assistant", "message": {"content": [' + "[" * 900 + "]" * 900 + "]}}",
    json.dumps(call("submit_id: " + "0" * 5000 + "1")),
]


def test_no_line_of_a_log_stops_a_report(tmp_path: Path) -> None:
    hostile = write_run(tmp_path / "runs", VERSIONS, entry="Hostile")
    write_run(tmp_path / "runs", VERSIONS, entry="Honest")
    write_log(hostile, *HOSTILE_LINES)
    found = study([tmp_path / "runs"])
    assert found.entries == ["Honest", "Hostile"]
    write_report(found, tmp_path / "report")
    (page,) = (tmp_path / "report" / "traces").glob("*Hostile*.html")
    assert "could not be made" not in page.read_text()


def test_an_unforeseen_failure_spoils_one_page_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(tmp_path / "runs", VERSIONS, entry="Hostile")
    write_run(tmp_path / "runs", VERSIONS, entry="Honest")
    real = writing.trace

    def fails(run: writing.PastRun) -> Trace:
        if run.entry == "Hostile":
            raise ArithmeticError("<b>unforeseen</b>")
        return real(run)

    monkeypatch.setattr(writing, "trace", fails)
    write_report(study([tmp_path / "runs"]), tmp_path / "report")
    (page,) = (tmp_path / "report" / "traces").glob("*Hostile*.html")
    assert "could not be made from what the run has left: ArithmeticError: &lt;b&gt;" in page.read_text()
    (page,) = (tmp_path / "report" / "traces").glob("*Honest*.html")
    assert "Feedback read" in page.read_text()


@pytest.mark.parametrize("number", ["9" * 400, "1e308", "-1e200"])
@pytest.mark.parametrize("field", ["final_score", "budget_used", "turns"])
def test_a_number_without_measure_leaves_its_run_out(tmp_path: Path, field: str, number: str) -> None:
    hostile = write_run(tmp_path / "runs", VERSIONS, entry="Hostile")
    write_run(tmp_path / "runs", VERSIONS, entry="Hostile", repeat=1)
    record = json.loads((hostile / "run.json").read_text())
    (record["agent"] if field == "turns" else record["outcome"])[field] = 1234567
    (hostile / "run.json").write_text(json.dumps(record).replace("1234567", number))
    loaded = load_runs([tmp_path / "runs"])
    assert [run.record.repeat for run in loaded.runs] == [1]
    assert len(loaded.left_out) == 1
    assert loaded.left_out[0].reason


def test_any_exception_while_a_run_is_read_leaves_out_that_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from evopolicy_results.reading import reader

    write_run(tmp_path, VERSIONS, entry="Hostile")
    write_run(tmp_path, VERSIONS, entry="Honest")
    real = reader.read_run

    def fails(folder: Path) -> reader.PastRun:
        if "Hostile" in str(folder):
            raise OverflowError("x" * 100_000)
        return real(folder)

    monkeypatch.setattr(reader, "read_run", fails)
    loaded = load_runs([tmp_path])
    assert [run.entry for run in loaded.runs] == ["Honest"]
    assert loaded.left_out[0].reason.startswith("OverflowError: xxx")
    assert len(loaded.left_out[0].reason) <= 1000


@pytest.mark.parametrize(
    "text",
    [
        "a" * LONG,
        ".png" * (LONG // 4),
        "a.pngx" * (LONG // 6),
        "feedback/" * (LONG // 9),
        "submit_id" + " " * LONG,
        "submit_id:" * (LONG // 10),
        "submit_" + "0" * LONG + "x",
        "submit_id:1 " * (LONG // 12),
    ],
)
def test_a_log_is_read_in_time_that_grows_with_its_length(tmp_path: Path, text: str) -> None:
    run = write_run(tmp_path, VERSIONS)
    write_log(run, call(text), {"type": "stdout", "text": text, "at": 1.0})
    read_agent_log(run / "logs" / "agent.jsonl", load_runs([tmp_path]).runs[0].submits)


def test_what_is_kept_of_a_log_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = write_run(tmp_path, VERSIONS)
    submits = load_runs([tmp_path]).runs[0].submits
    monkeypatch.setattr(agent_log, "MAX_PATHS", 10)
    monkeypatch.setattr(agent_log, "MAX_EVENTS", 50)
    many = [call(f"cat feedback/{i} {i}.png {'x' * 5000}.png") for i in range(100)]
    write_log(run, *many[:20], call("submit_id: submit_000"), *many)
    found = read_agent_log(run / "logs" / "agent.jsonl", submits).by_submit[0]
    assert (len(found.read), len(found.images)) == (10, 10)
    assert all(len(path) < 20 for path in found.images)


def test_sources_of_lines_that_look_alike_are_compared_in_bounded_time() -> None:
    rng = random.Random(1)
    old, new = ([rng.choice("ab") for _ in range(100_000)] for _ in range(2))
    same_lines = 2 * sum(min(old.count(letter), new.count(letter)) for letter in "ab")
    assert n_changed(old, new) == len(old) + len(new) - same_lines
    assert len(unified(old, new)) == 1 + len(old) + len(new)
    assert n_changed(["same"] * 100_000, ["same"] * 99_999) == 1
    assert len(old) ** 2 / 2 > sources.MAX_STEPS


def test_an_import_of_endless_parts_is_read_in_bounded_memory() -> None:
    endless = b"import " + b"a." * 200_000 + b"a\n"
    assert list(reachable_modules({"policy.py": endless, "a.py": b""})) == ["policy"]
    assert parse(b"import " + b"a. \\\n" * 200_000 + b"a\n") is None
    parts = ".".join(["pack"] + ["part"] * 80)
    files = {"policy.py": f"import {parts}\n".encode(), "pack/__init__.py": b"", "pack/part.py": b""}
    assert list(reachable_modules(files)) == ["pack", "pack.part", "policy"]


@pytest.mark.parametrize("piece", [b"a", b"a.", b"a \\\n", b"a.a ", b"(", b"x = a\n", b"a" * 99 + b"."])
def test_sources_are_parsed_in_time_that_grows_with_their_length(piece: bytes) -> None:
    parse(piece * (LONG // len(piece)))


def test_a_folder_whose_name_is_no_text_is_reported(tmp_path: Path) -> None:
    write_run(tmp_path / "runs", VERSIONS)
    broken = os.fsencode(tmp_path / "runs") + b"/\xff\xfe"
    os.makedirs(broken + b"/workspace")
    os.makedirs(broken + b"/logs")
    found = study([tmp_path / "runs"])
    assert len(found.left_out) == 1
    write_report(found, tmp_path / "report")
    assert "\\\\xff\\\\xfe" in (tmp_path / "report" / "report.json").read_text()
