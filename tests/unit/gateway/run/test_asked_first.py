"""A run that takes another's place is opened before that one is gone."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import pytest
from rigs.finished_run import plan_in

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import CreateRun, RunCreated
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_gateway.run.lifecycle import RunLifecycle


class Operations:
    """Opens a run for each key, and refuses on request."""

    def __init__(self) -> None:
        self.open: dict[str, RunSettings] = {}
        self.refuses = False

    async def create(self, wanted: CreateRun) -> RunCreated:
        if self.refuses:
            raise ConfigError("the cases are public")
        self.open[wanted.key] = wanted.settings
        return RunCreated(run=wanted.key, capability="c")

    async def cancel(self, run: str) -> None:
        del self.open[run]


async def ask(folder: Path, operations: Operations, budget: int = 8) -> str:
    """The key of the run that a command opens before it is killed."""
    settings = RunSettings(env="toy/line", entry="a", model="a", exp_id="t", budget=budget)
    plan = plan_in(folder, settings, overwrite=True)
    plan.folder.root.mkdir(parents=True, exist_ok=True)
    (plan.folder.run_json).write_text("earlier")
    nothing: Any = object()
    lifecycle = RunLifecycle(plan, operations, nothing, nothing)  # type: ignore[arg-type]
    key = (await lifecycle._ask(CreateRun(key=uuid.uuid4().hex, settings=settings))).key
    assert plan.folder.run_json.read_text() == "earlier"
    return key


async def test_a_command_killed_after_it_asked_finds_its_run_again(tmp_path: Path) -> None:
    operations = Operations()
    first = await ask(tmp_path, operations)
    assert await ask(tmp_path, operations) == first
    other = await ask(tmp_path, operations, budget=4)
    assert [*operations.open] == [other]
    assert other != first


async def test_a_refused_run_leaves_no_request_and_the_earlier_run(tmp_path: Path) -> None:
    operations = Operations()
    operations.refuses = True
    with pytest.raises(ConfigError, match="are public"):
        await ask(tmp_path, operations)
    files = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert files == ["run.json"]
