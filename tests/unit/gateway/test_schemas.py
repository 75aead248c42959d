"""The JSON Schemas, held by the reference validator against files that evopolicy writes and reads."""

from __future__ import annotations

import copy
import json
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from invented.policies import Version
from invented.run_dirs import write_run
from jsonschema import Draft202012Validator
from program_runs import run_program

from evopolicy_common.records.suite_folder import Index, SweepRun
from evopolicy_gateway.cli import files
from evopolicy_gateway.suite.suite_index import save

ROOT = Path(__file__).parents[3]
SUITES = sorted((ROOT / "agent_gateway/evopolicy_gateway/suite/shipped").glob("*.toml"))
AGENTS = sorted((ROOT / "examples/agents").glob("*.toml"))


def problems(name: str, value: Any) -> list[str]:
    """The validator's complaints about a file's content."""
    return [error.message for error in Draft202012Validator(files.schema(name)).iter_errors(value)]


def written(folder: Path) -> dict[str, Any]:
    """One file of each JSON kind, as evopolicy writes it, by its name."""
    run = write_run(folder / "runs", [Version({"policy.py": "x = 1"}, (1.0, 2.0), 1.5)])
    entry = SweepRun(name="a", agent="codex", env="gym/acrobot", repeat=0, digest="0" * 64)
    save(folder, Index(suite="s", runs={"a": entry}))
    return {
        "run.json": json.loads((run / "run.json").read_bytes()),
        "summary.json": json.loads(next(run.glob("**/summary.json")).read_bytes()),
        "suite.json": json.loads((folder / "suite.json").read_bytes()),
    }


@pytest.mark.parametrize("name", files.KINDS)
def test_a_schema_is_one(name: str) -> None:
    made = files.schema(name)
    Draft202012Validator.check_schema(made)
    assert made["$id"].startswith(f"urn:evopolicy:schema:{name}:")


def test_written_files_are_valid(tmp_path: Path) -> None:
    for name, value in written(tmp_path).items():
        assert problems(name, value) == [], name


def test_a_file_of_wrong_types_is_not_valid(tmp_path: Path) -> None:
    for name, value in written(tmp_path).items():
        for field, one in value.items():
            wrong = 5 if isinstance(one, list) else [[]]
            assert one is None or problems(name, value | {field: wrong}), (name, field)


@pytest.mark.parametrize(
    ("name", "path"),
    [*(("suite.toml", path) for path in SUITES), *(("agent.toml", path) for path in AGENTS)],
    ids=lambda each: each.name if isinstance(each, Path) else each,
)
def test_shipped_files_are_valid_and_unknown_keys_are_not(name: str, path: Path) -> None:
    value = tomllib.loads(path.read_text())
    assert problems(name, value) == []
    for table in tables(value):
        wrong = copy.deepcopy(value)
        inner = wrong
        for step in table:
            inner = inner[step]
        inner["no_such_key"] = 1
        assert problems(name, wrong), table


def tables(value: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """The places of a file's tables that have keys of their own."""
    yield ()
    for name in ("defaults", "parallel", "caps"):
        if name in value:
            yield (name,)
    for name in ("agents", "overrides"):
        for k in range(len(value.get(name, ()))):
            yield name, k


def test_fields_have_the_words_of_their_docstrings() -> None:
    override = files.schema("suite.toml")["$defs"]["Override"]["properties"]
    assert override["agents"]["description"] == "Names or globs."
    assert files.schema("run.json")["$defs"]["RunRecord"]["properties"]["env"]["description"].startswith(
        "Suite id"
    )


def test_the_command_prints_a_schema_and_refuses_other_names() -> None:
    evopolicy = Path(sys.executable).with_name("evopolicy")
    done = run_program(evopolicy, "files", "schemas/run.json.schema.json")
    assert json.loads(done.stdout) == json.loads(msgspec.json.encode(files.schema("run.json")))
    wrong = run_program(evopolicy, "files", "schemas/runs")
    assert wrong.returncode == 2
    assert "no file 'schemas/runs'" in wrong.stderr
