"""SECURITY.md's tables and the cheats that are tested name each other."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "SECURITY.md").read_text()
CHEATS = ROOT / "tests" / "conformance" / "cheats"


def names_below(folder: Path) -> set[str]:
    found: set[str] = set()
    for path in folder.rglob("test_*.py"):
        tree = ast.parse(path.read_text())
        found |= {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    return {name for name in found if name.startswith("test_")}


def attempts() -> set[str]:
    """What the cheating agent calls its cheats."""
    return set(re.findall(r'^@attempt\("(.*)"\)$', (CHEATS / "cheating_agent.py").read_text(), re.MULTILINE))


def test_every_test_that_a_table_names_is_there() -> None:
    known = names_below(ROOT / "tests")
    named = set(re.findall(r"::(test_\w+)`", TEXT))
    assert len(named) > 40
    assert named <= known, named - known
    for name in re.findall(r"`(tests/[\w/]+\.py)", TEXT):
        assert (ROOT / name).is_file(), name
    files = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    assert set(re.findall(r"`(test_\w+\.py)", TEXT)) <= files


def test_every_file_of_cheats_and_every_attempt_of_the_cheating_agent_is_named() -> None:
    for path in CHEATS.glob("test_*.py"):
        assert f"{path.name}" in TEXT, path.name
    assert len(attempts()) > 25
    assert {name for name in attempts() if name not in TEXT} == set()
