"""Each optional part is a folder, which no other imports: without all of them the rest works."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from program_runs import run_python

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
        if not name.endswith("__main__"):
            assert pathlib.Path(importlib.import_module(name).__file__).is_relative_to(room), name
sys.argv = ["evopolicy", "--help"]
evopolicy()
"""


@pytest.mark.parametrize("part", OPTIONAL.values(), ids=OPTIONAL)
def test_no_other_module_imports_an_optional_part(part: str) -> None:
    package, name = part.split("/")[1:]
    imported = re.compile(
        rf"^\s*(from|import) ({package}\.{name}\b|({package}|\.) import .*\b{name}\b)", re.MULTILINE
    )
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            assert path.is_relative_to(ROOT / part) or imported.search(path.read_text()) is None, path


def test_the_rest_works_without_optional_parts(tmp_path: Path) -> None:
    for room in ROOMS:
        shutil.copytree(ROOT / room, tmp_path / room)
    for part in OPTIONAL.values():
        shutil.rmtree(tmp_path / part)
    path = ":".join(str(tmp_path / room) for room in ROOMS)
    variables = {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "HOME": str(tmp_path)}
    done = run_python(IMPORT_ALL, path, env=variables, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Play one run on this machine" in done.stdout
