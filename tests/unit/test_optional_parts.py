"""Each optional part is a folder: without it everything else is imported, and the commands are listed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("common", "coordinator", "agent_gateway")
OPTIONAL = {
    "exports": "agent_gateway/evopolicy/_exports",
    "Inspect": "agent_gateway/evopolicy/_inspect",
    "Harbor": "agent_gateway/evopolicy_gateway/harbor",
    "leaderboard": "coordinator/evopolicy_results/leaderboard",
}
IMPORT_ALL = """
import importlib, pathlib, sys
from evopolicy_common.entry import evopolicy
for room in sys.argv[1].split(":"):
    for path in sorted(pathlib.Path(room).rglob("*.py")):
        name = ".".join(path.relative_to(room).with_suffix("").parts).removesuffix(".__init__")
        if not name.endswith("__main__") and name.split(".")[:2] != ["evopolicy", "_inspect"]:
            # Inspect is no part of the tests' installation.
            assert pathlib.Path(importlib.import_module(name).__file__).is_relative_to(room), name
sys.argv = ["evopolicy", "--help"]
evopolicy()
"""


@pytest.mark.parametrize("part", OPTIONAL)
def test_the_rest_works_without_an_optional_part(part: str, tmp_path: Path) -> None:
    for room in ROOMS:
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.rmtree(tmp_path / OPTIONAL[part])
    path = ":".join(str(tmp_path / room) for room in ROOMS)
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, path],
        env={"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "HOME": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Play one run on this machine" in done.stdout
