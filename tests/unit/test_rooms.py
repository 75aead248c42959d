"""Who may import whom, read from the imports themselves (ARCHITECTURE.md, "Rooms")."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from evopolicy_common.simulators import SIMULATORS

ROOT = Path(__file__).parents[2]
ROOMS = {
    "evopolicy_common": ROOT / "common" / "evopolicy_common",
    "evopolicy_coordinator": ROOT / "coordinator" / "evopolicy_coordinator",
    "evopolicy_worker": ROOT / "worker" / "evopolicy_worker",
    "evopolicy_gateway": ROOT / "agent_gateway" / "evopolicy_gateway",
}


def imports_of(path: Path) -> set[str]:
    """Top-level names of everything that `path` imports, at any depth of its code."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute | ast.Name)
            and (node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id)
            in ("import_module", "__import__")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            found.add(str(node.args[0].value).split(".")[0])
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_what_it_may(room: str) -> None:
    allowed = {room, "evopolicy_common"}
    forbidden = set(ROOMS) - allowed | (set() if room == "evopolicy_worker" else set(SIMULATORS))
    for path in sorted(ROOMS[room].rglob("*.py")):
        assert not imports_of(path) & forbidden, f"{path.relative_to(ROOT)}"


def test_the_coordinators_core_does_no_io() -> None:
    banned = {
        *("asyncio", "socket", "zenoh", "sqlite3", "random", "time", "secrets", "logging", "structlog"),
        *("subprocess", "threading", "os", "pathlib", "tempfile", "datetime"),
    }
    for path in sorted((ROOMS["evopolicy_coordinator"] / "core").rglob("*.py")):
        assert not imports_of(path) & banned, f"{path.relative_to(ROOT)}"


def test_every_package_is_where_it_should_be() -> None:
    for name, folder in ROOMS.items():
        assert (folder / "__init__.py").is_file(), name
        assert (folder / "py.typed").is_file(), name
