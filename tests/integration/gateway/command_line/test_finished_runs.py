"""No failure after a run's last episode costs the run: its result is written now or by `--resume`, without its
agent."""

from __future__ import annotations

import asyncio
import errno
import inspect
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from commands import agent, record_in, run_dir
from rigs.finished_run import plan_in

from evopolicy_common.console import Terminal
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.records.policies import checkpoints
from evopolicy_common.records.run_difference import differences
from evopolicy_gateway.operator.cluster import ChosenCluster
from evopolicy_gateway.run import record
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.watch import RunView
from evopolicy_gateway.suite import runs, sweep

pytestmark = pytest.mark.system

FUNCTIONS = sorted(
    name
    for name, value in vars(record).items()
    if inspect.isfunction(value) and name != "write" and value.__module__.startswith("evopolicy")
)
"""Every function that the module calls, its own and others': each is a step that may fail."""
SPARED = (
    "_env_log",
    "_from_journal",
    "_meta",
    "_own_bundle",
    "_put_in_place",
    "count_transitions",
)
"""Steps without which a result is complete."""


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command tries each step once."""
    monkeypatch.setattr(sweep, "FINISH_AGAIN_S", ())


def plan_of(root: Path, **more: Any) -> Plan:
    names = {"env": "toy/line", "entry": "a", "model": "a", "exp_id": "t"}
    settings = RunSettings(**names, budget=6, n_validation=2, n_heldout=2)
    agent_name = f"command:python3 {root / 'agent.py'}"
    return plan_in(root, settings, agent=agent_name, runs=root / "runs", **more)


def played(plan: Plan, operator_file: Path) -> tuple[str, str]:
    """State of the run in its command, and the command's output."""
    output = io.StringIO()
    done = asyncio.run(
        runs.play_plans([plan], ChosenCluster(file=operator_file), 1, Terminal(file=output, width=300))
    )
    return done.index.runs[plan.name].state, output.getvalue()


@pytest.fixture(scope="module")
def finished(operator_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Path]:
    """A run whose episodes are all played and whose files are not written; and the same run, written."""
    root = tmp_path_factory.mktemp("f")
    agent(root, "open('starts', 'a').write('x')\nsubmit([0, 1])\nsubmit([2, 3, 4, 5])")
    plan = plan_of(root)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sweep, "FINISH_AGAIN_S", ())
        patched.setattr(record, "write", raises(RuntimeError("a bug")))
        assert played(plan, operator_file)[0] == "error"
    unwritten = root / "unwritten"
    shutil.copytree(plan.runs, unwritten, symlinks=True)
    plan = msgspec.structs.replace(plan, resume=True)
    assert played(plan, operator_file)[0] == "completed"
    return plan, unwritten


@pytest.fixture
def copied(finished: tuple[Plan, Path], tmp_path: Path) -> Plan:
    """A copy of the run whose files are not written."""
    plan, unwritten = finished
    shutil.copytree(unwritten, tmp_path / "runs", symlinks=True)
    return msgspec.structs.replace(plan, runs=tmp_path / "runs")


def raises(error: Exception) -> Callable[..., Any]:
    def step(*_: object, **__: object) -> Any:
        raise error

    return step


def check(plan: Plan, whole: Plan) -> None:
    """Its result is that of the run whose steps all succeeded, and its agent was started once."""
    mine, other = record_in(plan.folder.root), record_in(whole.folder.root)
    results = [
        (one.outcome.status, one.outcome.final_score, one.outcome.heldout_returns, one.outcome.val_scores)
        for one in (mine, other)
    ]
    assert results[0] == results[1]
    assert (plan.folder.workspace / "starts").read_text() == "x"
    assert not plan.folder.state.exists()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_bug_in_a_step_costs_no_more_than_its_file(
    copied: Plan, finished: tuple[Plan, Path], operator_file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(record, name, raises(RuntimeError("a bug")))
        state, said = played(copied, operator_file)
    if name in SPARED:
        assert state == "completed", said
        assert "is left out: RuntimeError: a bug" in said
    if state != "completed":
        assert "--resume" in said
        assert played(copied, operator_file)[0] == "completed"
    check(copied, finished[0])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_full_disk_at_a_step_leaves_the_run_to_be_resumed(
    copied: Plan, finished: tuple[Plan, Path], operator_file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(record, name, raises(OSError(errno.ENOSPC, "No space left on device")))
        state, said = played(copied, operator_file)
    if state != "completed":
        assert "--resume" in said
        assert played(copied, operator_file)[0] == "completed"
    check(copied, finished[0])
    if name != "remove_tree":
        assert differences(copied.folder.root, finished[0].folder.root) == []


def test_a_run_without_code_metrics_tells_so_and_keeps_its_score(
    copied: Plan, finished: tuple[Plan, Path], operator_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoints, "code_metrics", raises(SystemError("recursion depth mismatch")))
    state, said = played(copied, operator_file)
    assert state == "completed"
    assert "submit_000" in said
    assert "recursion depth mismatch" in said
    check(copied, finished[0])
    auxiliary = record_in(copied.folder.root).outcome.auxiliary
    assert auxiliary["code_metrics_best"] is None
    assert auxiliary["code_metrics_by_submit"] == {"0": None, "1": None}
    assert auxiliary["code_metrics_trend"]["tree_hash"] == [None, None]
    checkpoint = copied.folder.checkpoints / "submit_000"
    assert json.loads((checkpoint / "_meta.json").read_text())["import_scan"] is None
    assert not (checkpoint / "metrics.json").exists()
    whole = finished[0].folder.checkpoints / "submit_000"
    assert checkpoints.bundle_of(checkpoint).digest == checkpoints.bundle_of(whole).digest
    assert "Traceback" in copied.folder.harness_log.read_text()


def test_a_bug_before_the_run_is_closed_does_not_cancel_it(
    operator_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(tmp_path, "open('starts', 'a').write('x')\nsubmit([0, 1, 2, 3, 4, 5])")
    monkeypatch.setattr(record, "told_at_close", raises(TypeError("tokens of no known form")))
    state, said = played(plan_of(tmp_path), operator_file)
    assert state == "completed"
    assert "does not commit to this side of run.json: TypeError: tokens of no known form" in said
    assert (run_dir(tmp_path) / "workspace" / "starts").read_text() == "x"


def test_a_failing_view_after_the_last_episode_cancels_no_run(
    operator_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(tmp_path, "open('starts', 'a').write('x')\nsubmit([0, 1, 2, 3, 4, 5])")
    plan = plan_of(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(RunView, "phase", raises(UnicodeEncodeError("utf-8", "\ud800", 0, 1, "surrogates")))
        state, said = played(plan, operator_file)
    assert state == "error"
    assert "--resume" in said
    assert played(msgspec.structs.replace(plan, resume=True), operator_file)[0] == "completed"
    assert (run_dir(tmp_path) / "workspace" / "starts").read_text() == "x"
