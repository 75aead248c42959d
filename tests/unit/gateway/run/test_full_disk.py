"""A full disk costs what helps an agent, never the agent or its run. A folder that is gone refuses as a full disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from evopolicy_gateway.harnesses.coding_agents import session
from evopolicy_gateway.run.children import SupervisedAgent
from evopolicy_gateway.run.times import Stopwatch
from evopolicy_gateway.run_folder.layout import RunFolder


def test_an_agent_goes_on_when_its_session_cannot_be_kept(tmp_path: Path) -> None:
    path = tmp_path / "gone" / "session.json"
    session.save(path, session.SessionState(session="s-1"))
    assert session.load(path) == session.SessionState()


def test_a_run_goes_on_when_its_left_limits_cannot_be_kept(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    harness = SimpleNamespace(model=None)
    plan = SimpleNamespace(harness=lambda: harness, wall_limit_s=60.0)
    run: Any = SimpleNamespace(plan=plan, folder=folder, stopwatch=Stopwatch(tmp_path / "times.json"))
    agent = SupervisedAgent(run)
    agent._keep_left()
    assert not folder.left.exists()
    folder.left.parent.mkdir()
    agent._keep_left()
    assert folder.left.read_bytes() == b'{"wall_time_s":60}'
