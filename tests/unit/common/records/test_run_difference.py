"""What makes two run directories different, and what does not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evopolicy_common.records.run_difference import differences
from evopolicy_gateway.cli.main import app


def make_run(root: Path, name: str, **changes: Any) -> Path:
    folder = root / name
    summary = {"returns": [1.0], "submit_started_at": name, "wall_time_seconds": 1.0, **changes}
    record = {
        "exp_id": name,
        "timing": {"wall_time_seconds": len(name)},
        "rejected_submits": [{"status": "budget_invalid", "at": name}],
        "outcome": {"final_score": 1.0, "auxiliary": {"infrastructure_retries": len(name)}},
    }
    files = {
        "run.json": json.dumps(record),
        "logs/harness.log": name,
        "workspace/AGENTS.md": name,
        "workspace/system/policy.py": "class Policy: pass",
        "workspace/feedback/submit_000/summary.json": json.dumps(summary),
        "workspace/feedback/submit_000/episodes/ep_000/error.txt": json.dumps(
            {"timestamp": name, "message": "x"}
        ),
    }
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder


def pair(root: Path, **changes: Any) -> tuple[Path, Path]:
    """Two runs, of which `changes` concern the second."""
    return make_run(root, "a"), make_run(root, "bcd", **changes)


def diff(*args: object, code: int = 1) -> str:
    """The output of the command, which ends with `code`."""
    done = CliRunner().invoke(app, ["diff", *map(str, args)])
    assert done.exit_code == code, done.output
    return done.stdout


def test_times_logs_and_names_make_no_difference(tmp_path: Path) -> None:
    assert differences(*pair(tmp_path)) == []


def test_a_return_a_file_and_a_byte_each_make_one(tmp_path: Path) -> None:
    left, right = pair(tmp_path, returns=[2.0])
    (right / "workspace/system/policy.py").write_text("class Policy: 1")
    (right / "extra").touch()
    (left / "workspace/feedback/submit_000/episodes/ep_000/error.txt").write_text(
        json.dumps({"timestamp": "t", "message": "y"})
    )
    found = differences(left, right)
    assert [line.partition(":")[0] for line in found] == [
        "extra",
        "workspace/feedback/submit_000/episodes/ep_000/error.txt",
        "workspace/feedback/submit_000/summary.json",
        "workspace/system/policy.py",
    ]
    assert "returns: [1.0] and [2.0]" in found[2]


def test_other_isolation_and_hidden_cases_make_a_difference(tmp_path: Path) -> None:
    left, right = pair(tmp_path)
    for folder, isolation, cases in ((left, "exclusive", "shared"), (right, "waived", "per_run")):
        record = json.loads((folder / "run.json").read_text())
        record |= {"hidden_isolation": isolation, "experiment_dimensions": {"hidden_cases": cases}}
        (folder / "run.json").write_text(json.dumps(record))
    assert differences(left, right) == [
        'run.json: hidden_isolation: "exclusive" and "waived"',
        'run.json: experiment_dimensions.hidden_cases: "shared" and "per_run"',
    ]


def test_a_field_that_is_missing_is_a_difference(tmp_path: Path) -> None:
    found = differences(make_run(tmp_path, "a", extra=1), make_run(tmp_path, "b"))
    assert found == ["workspace/feedback/submit_000/summary.json: extra: 1 and nothing"]


@pytest.mark.parametrize(("cases", "differ"), [("shared", False), ("per_run", True)])
def test_a_missing_condition_counts_as_its_default(tmp_path: Path, cases: str, differ: bool) -> None:
    left, right = pair(tmp_path)
    for folder, dimensions in ((left, {"n_train": 64}), (right, {"n_train": 64, "hidden_cases": cases})):
        record = json.loads((folder / "run.json").read_text()) | {"experiment_dimensions": dimensions}
        (folder / "run.json").write_text(json.dumps(record))
    expected = ['run.json: experiment_dimensions.hidden_cases: nothing and "per_run"'] if differ else []
    assert differences(left, right) == expected


def test_json_without_end_of_nesting_is_a_difference_and_no_crash(tmp_path: Path) -> None:
    left, right = pair(tmp_path)
    for folder, deepest in ((left, "1"), (right, "2")):
        # The first is too deep to be read, the second to be compared.
        for name, opens, closes in (
            ("summary.json", "[" * 100_000, "]" * 100_000),
            ("error.txt", '{"a":' * 700, "}" * 700),
        ):
            (folder / "workspace" / name).write_text(opens + deepest + closes)
    found = differences(left, right)
    assert [line.partition(":")[0] for line in found] == ["workspace/error.txt", "workspace/summary.json"]


def test_file_names_neither_steer_the_terminal_nor_forge_lines(tmp_path: Path) -> None:
    left, right = pair(tmp_path)
    for name in (b"x\nno difference (times and logs aside)", b"\x1b]8;;evil\x1b\\", b"\xff[x]"):
        with open(bytes(left) + b"/" + name, "wb"):
            pass
    output = diff(left, right)
    assert len(output.splitlines()) == 3
    assert "\x1b" not in output
    assert len(json.loads(diff("--json", left, right))) == 3


def test_runs_that_are_equal_do_not_differ_until_a_file_is_added(tmp_path: Path) -> None:
    left, right = pair(tmp_path)
    diff(left, right, code=0)
    (right / "extra").touch()
    diff(left, right)
