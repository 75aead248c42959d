"""Accounts of finished runs: the index's bytes, the documents of `--json`, the exit code with its reasons, the
report."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rigs.finished_run import finished, plan_in, record_in

from evopolicy_common.console import Terminal
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import Index, SweepRun
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.suite import suite_index
from evopolicy_gateway.suite.runs import PlayedRuns, documents, report
from evopolicy_gateway.suite.suite_file import expand, read_suite
from evopolicy_gateway.suite.suite_index import entry_of, exit_code
from evopolicy_results.statistics.intervals import difference

FILE = """
name = "s"
environments = ["toy/line"]
[defaults]
budget = 8
[[agents]]
name = "evolve"
agent = "evolve"
"""
GOLDEN_INDEX = Path(__file__).with_name("golden_index.json").read_text().rstrip()
"""Of version 1, which later versions go on with: hosts of a sweep may be of several."""
NEVER_PLAYED = {
    "status": "no_ok_submit",
    "final_score": None,
    "best_submit_index": None,
    "closed_reason": "agent_failed",
    "budget_used": 0,
    "heldout_returns": (),
    "submits": (),
}


def one_run(root: Path, **fields: Any) -> tuple[Plan, RunRecord]:
    path = root / "s.toml"
    path.write_text(FILE)
    (plan,) = expand(read_suite(str(path)), root / "runs", root)
    for index in range(3):
        (plan.folder.checkpoints / f"submit_{index:03d}").mkdir(parents=True)
    return plan, record_in(plan, finished(settings=plan.settings, **fields), None, Times(open_s=9.0))


def test_the_index_keeps_its_bytes(tmp_path: Path) -> None:
    plan, record = one_run(tmp_path)
    settings = msgspec.to_builtins(plan.defining)
    entry = msgspec.structs.replace(entry_of(plan, record), settings=settings, host="h", run="r")
    index = Index(suite="s", runs={plan.name: entry})
    assert msgspec.json.format(msgspec.json.encode(index), indent=2).decode() == GOLDEN_INDEX
    (tmp_path / "suite.json").write_text(GOLDEN_INDEX)
    assert suite_index.load(tmp_path, "s") == index


def test_a_script_is_told_of_a_run_by_the_same_names(tmp_path: Path) -> None:
    plan, record = one_run(tmp_path)
    index = Index(suite="", runs={plan.name: entry_of(plan, record)})
    played = PlayedRuns([plan], index, {plan.name: record}, set())
    assert json.loads(msgspec.json.encode(documents(played))) == [
        {
            "env": "toy/line",
            "run_directory": str(plan.folder.root),
            "status": "completed",
            "error": None,
            "final_score": 2.0,
            "random_score": 0.5,
            "above_random": {
                "value": 1.5,
                "low": None,
                "high": None,
                "method": "none",
                "over": "cases",
                "p": None,
                "reason": "too few cases",
            },
            "best_submit_index": 1,
            "n_submits": 3,
            "budget_used": 8,
            "closed_reason": "budget_spent",
            "wall_s": 12.5,
            "wrong_option": False,
        }
    ]


@pytest.mark.parametrize(
    ("returns", "begin", "end"),
    [
        ((2.0, 3.0, 4.0, 3.5, 2.5), "3 (95 % interval ", " better than random"),
        ((-2.0, -3.0, -4.0, -3.5, -2.5), "3 (95 % interval ", " worse than random"),
        ((1.0, -1.0, 0.5, -0.5, 0.1), "not distinguishable from random: 0.02 (95 % interval -", " better"),
        ((2.0, 2.0), "score − random = 2, without an interval", ": too few cases"),
    ],
)
def test_the_difference_from_random_is_told_with_its_interval(
    tmp_path: Path, returns: tuple[float, ...], begin: str, end: str
) -> None:
    zeros = (0.0,) * len(returns)
    mean = sum(returns) / len(returns)
    plan, record = one_run(tmp_path, final_score=mean, heldout_returns=returns, random_heldout_returns=zeros)
    index = Index(suite="", runs={plan.name: entry_of(plan, record)})
    played, out = PlayedRuns([plan], index, {plan.name: record}, set()), io.StringIO()
    report(played, tmp_path, Terminal(file=out, width=80))
    (line,) = (line for line in out.getvalue().splitlines() if line.startswith("toy/line: "))
    assert line.startswith(f"toy/line: {begin}")
    assert line.endswith(end)
    # A report has the same numbers.
    shown = difference(np.array([returns]), np.array([zeros]))
    assert documents(played)[0]["above_random"] == msgspec.structs.replace(shown, p=None)


def test_a_sweep_plays_again_what_its_agent_never_played(tmp_path: Path) -> None:
    plan, record = one_run(tmp_path, **NEVER_PLAYED)
    entry = entry_of(plan, record)
    assert (entry.state, entry.closed_reason, entry.score) == ("error", "agent_failed", None)
    assert "failed before its first submit" in (entry.error or "")


def test_exit_codes_and_report_tell_the_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends: list[tuple[dict[str, Any], int]] = [
        ({"state": "completed", "score": 1.0, "random": 0.5}, 0),
        ({"state": "no_ok_submit"}, 3),
        ({"state": "completed", "closed_reason": "agent_failed"}, 4),
        ({"state": "cancelled", "closed_reason": "agent_failed"}, 5),
        ({"state": "error", "error": "worker lost"}, 1),
    ]
    plans: list[Plan] = []
    index = Index(suite="")
    for name, (status, code) in zip("abcde", ends, strict=True):
        settings = RunSettings(env=name, entry="evolve", model="none", exp_id="t")
        plans.append(plan_in(tmp_path, settings))
        more = {"agent": "evolve", "env": name, "repeat": 0, "digest": "", "directory": f"evolve/{name}/t"}
        index.runs[name] = SweepRun(name=name, **more | status)
        assert exit_code(plans, index) == code
        # Whatever is no success is explained where nobody has to look for it.
        printed = capsys.readouterr().err.splitlines()
        assert [line.partition(":")[0] for line in printed] == [one.name for one in plans[1:]]
    assert printed == [
        f"b: the agent made no submit, or none had a working policy; see {tmp_path}/evolve/b/t",
        f"c: its agent failed; see {tmp_path}/evolve/c/t",
        f"d: it was cancelled; see {tmp_path}/evolve/d/t",
        f"e: worker lost; see {tmp_path}/evolve/e/t",
    ]
    out = io.StringIO()
    report(PlayedRuns(plans, index, {}, set()), Path("my runs"), Terminal(file=out, width=200))
    assert "evopolicy report 'my runs' --out report" in out.getvalue()
    for needed in ("no working submit", f"run directory: {tmp_path}/evolve/a/t", "agent failed", "cancelled"):
        assert needed in out.getvalue()
    assert exit_code(plans[:1], Index(suite="")) == 1
    assert capsys.readouterr().err == "a: it was not begun\n"
