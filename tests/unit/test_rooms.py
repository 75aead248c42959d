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


OWN_STDOUT = {
    "evopolicy_gateway/agents": "programs of their own, whose stdout is an agent's log",
    "evopolicy_gateway/jail/doorway.py": "inside the jail, with the standard library alone",
    "evopolicy_gateway/cli/serve.py": "URLs of its own, for a shell to read",
    "evopolicy_common/processes/leash.py": "becomes another program, with the standard library alone",
    "evopolicy_worker/episodes/loop.py": "speaks with the process that started it",
    "evopolicy_worker/slots/recording.py": "speaks with the process that started it",
    "evopolicy_worker/sandbox/inside": "inside the sandbox, with the standard library alone",
    "evopolicy_common/terminal.py": "is the one place",
}


def test_what_commands_print_goes_through_the_terminal_module() -> None:
    for room, folder in ROOMS.items():
        for path in sorted(folder.rglob("*.py")):
            name = f"{room}/{path.relative_to(folder).as_posix()}"
            if any(name.startswith(own) for own in OWN_STDOUT):
                continue
            calls = [
                node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)
            ]
            named = {call.id for call in calls if isinstance(call, ast.Name)}
            named |= {call.attr for call in calls if isinstance(call, ast.Attribute)} & {
                "echo",
                "secho",
                "Console",
            }
            assert not named & {"print", "echo", "secho", "Console"}, name


def test_every_package_is_where_it_should_be() -> None:
    for name, folder in ROOMS.items():
        assert (folder / "__init__.py").is_file(), name
        assert (folder / "py.typed").is_file(), name
