"""Run directories of all Core16 environments pass the published checker, and hold the documented artifacts to the
letter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from commands import agent, evopolicy
from published_checker import check_run
from published_checker import code_metrics as published_metrics

from evopolicy_common import catalogue
from evopolicy_common.records.code_metrics import code_metrics

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[3]

CORE16 = catalogue.suites()["core16"].environments
AGENT = """
from pathlib import Path

system = Path("system")
good = (system / "policy.py").read_text()
(system / "helpers").mkdir()
(system / "helpers" / "test_shape.py").write_text("def shape(x):\\n    # long?\\n    return [1 for y in x if y and x] or 0\\n")
(system / "helpers" / ".keep").write_text("")
(system / "weights.json").write_text("[1, 2]")
(system / "metrics.json").write_text("the agent's own")
submit("0")
(system / "policy.py").write_text("import numpy\\nraise RuntimeError('never imported')\\n")
submit([1])
"""  # noqa: E501


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small run of each environment, on one cluster."""
    root = tmp_path_factory.mktemp("core16")
    words = ["local", "--env", "core16", "--entry", "small", "--agent", agent(root, AGENT), "--jail", "none"]
    words += ["--budget", "2", "--validation", "1", "--heldout", "1", "--hidden-isolation", "off"]
    done = evopolicy(root, *words, "--exp-id", "t", "--parallel", "4", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "runs" / "small"


@pytest.mark.parametrize(
    "folder", ["common/evopolicy_common/records", "examples/policies", "tests/conformance/hostile"]
)
def test_code_metrics_agree_with_the_published_checker(folder: str) -> None:
    root = ROOT / folder
    files = {
        path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }
    ours = json.loads(
        json.dumps({name: getattr(code_metrics(files), name) for name in published_metrics(root)})
    )
    assert ours == published_metrics(root)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("env", CORE16)
def test_run_directory_passes_the_published_checker(runs: Path, env: str) -> None:
    folder = runs / env.replace("/", "_") / "t"
    assert check_run(folder) == []
    first, second = (read(folder / "checkpoints" / f"submit_00{index}" / "_meta.json") for index in (0, 1))
    assert first["validation_status"] == "ok"
    assert second["validation_status"] == "import_error"
    assert (first["remaining_budget_before"], second["remaining_budget_after"]) == (2, 0)
    summary = read(folder / "workspace" / "feedback" / "submit_001" / "summary.json")
    assert summary["env_instances"] == [1]


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_bytes())
    return found
