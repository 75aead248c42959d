"""Arguments of the public functions that cannot be: refused by name and value, before any process starts."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evopolicy as evp
from evopolicy import _arguments
from evopolicy_common.messages.episode import ResourceLimits

RUN: dict[str, Any] = {"env": "toy/line", "agent": "random"}
WRONG_RUNS: dict[str, list[Any]] = {
    "agent": [None, ""],
    "env": [None, ["toy/line"]],
    "budget": [0, -1, "8", True],
    "slots": [None, 1.5],
    "runs": [None],
    "repeat": [-1],
    "validation": [0],
    "tier": [None],
    "replays": ["some"],
    "agent_wall_s": [float("nan")],
    "exp_id": [3],
    "overwrite": ["yes"],
    "policy_packages": ["scipy", (3,)],
    "progress": ["no"],
}
WRONG_EVALUATIONS: dict[str, list[Any]] = {
    "policy": [None, dict],
    "env": [3],
    "cases": [3, "0-3"],
    "tier": ["x"],
    "limits": [{"act_wall_s": None}, 3],
    "slots": ["2"],
    "progress": [None],
}


WRONG = [
    (call, name, value)
    for call, arguments in (("run", WRONG_RUNS), ("evaluate", WRONG_EVALUATIONS))
    for name, values in arguments.items()
    for value in values
]


@pytest.fixture(autouse=True)
def _no_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    async def opened(_: evp.Cluster) -> None:
        pytest.fail("a cluster was opened")

    monkeypatch.setattr(evp.Cluster, "_open", opened)


@pytest.mark.parametrize(("call", "name", "value"), WRONG, ids=str)
def test_a_wrong_argument_is_named(call: str, name: str, value: Any, tmp_path: Path) -> None:
    (tmp_path / "policy.py").write_text("class Policy: pass")
    usual = {"run": {"runs": tmp_path / "runs"} | RUN, "evaluate": {"policy": tmp_path, "env": "toy/line"}}
    with pytest.raises(evp.ConfigError) as error:
        getattr(evp, call)(**usual[call] | {name: value})
    assert str(error.value).startswith(f"{name} is {value!r}: give ")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"env": "gym/nothing"}, "gym/nothing"),
        ({"budgets": 8}, "unknown argument budgets: did you mean budget"),
        ({"policy_packages": ("no-such-package",)}, "'no-such-package' is not installed"),
        ({"agent": "replay:nowhere"}, "is not a folder"),
        ({"profile": "published"}, "profile published plays .*: give data FOLDER"),
    ],
    ids=str,
)
def test_a_run_that_cannot_be_played_starts_no_cluster(
    wrong: dict[str, Any], text: str, tmp_path: Path
) -> None:
    with pytest.raises(evp.ConfigError, match=text):
        evp.run(**({"runs": tmp_path / "runs"} | RUN | wrong))


def test_errors_name_keywords_in_place_of_options(tmp_path: Path) -> None:
    (tmp_path / "runs/random/toy_line/t").mkdir(parents=True)
    (tmp_path / "runs/random/toy_line/t/run.json").write_text("{}")
    with pytest.raises(evp.ConfigError, match="choose another exp_id, or replace it with overwrite=True"):
        evp.run(**({"runs": tmp_path / "runs", "exp_id": "t"} | RUN))


def test_a_missing_folder_of_case_files_is_refused(tmp_path: Path) -> None:
    with pytest.raises(evp.ConfigError, match="none is not a folder: give one"):
        evp.Cluster.local(data=tmp_path / "none")


@pytest.mark.parametrize("path", [None, 3, ["runs"]], ids=str)
def test_a_folder_of_runs_is_a_path(path: Any) -> None:
    with pytest.raises(evp.ConfigError, match="give the path of a folder"):
        evp.load_runs(path)


def test_numbers_of_numpy_are_taken_as_pythons() -> None:
    assert _arguments.taken(budget=np.int64(8), cases=np.arange(2)) == {"budget": 8, "cases": (0, 1)}
    assert type(_arguments.check_argument("budget", np.int64(8))) is int


def test_every_argument_has_its_rule() -> None:
    functions = (evp.run, evp.evaluate, evp.Cluster.local, evp.Cluster.connect, evp.Cluster.evaluate)
    named = {name for each in functions for name in inspect.signature(each).parameters}
    assert named - {"self", "endpoints", "options"} <= _arguments.RULES.keys()


def test_keywords_for_type_checkers_are_the_declared_options() -> None:
    paths = {Path: _arguments.AnyPath, ResourceLimits: Mapping[str, float] | None}
    given = typing.get_type_hints(evp.RunKeywords)
    wanted = [name for name in _arguments.OPTIONS if name != "agent"]
    assert [*given] == wanted, "RunKeywords in evopolicy/_arguments.py has the fields of RunOptions, in order"
    for name, kind in given.items():
        declared = _arguments.OPTIONS[name].type
        optional = type(None) in typing.get_args(declared)
        plain = typing.get_args(declared)[0] if optional else declared
        assert kind == (paths.get(plain, plain) | None if optional else paths.get(plain, plain)), name
        assert f"`{name}`: " in (evp.RunKeywords.__doc__ or "")
