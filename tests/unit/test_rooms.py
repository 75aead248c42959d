"""Who may import whom, read from the imports themselves (ARCHITECTURE.md, "Rooms")."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from evopolicy_common.processes.packages import SIMULATORS

ROOT = Path(__file__).parents[2]
ROOMS = {
    "evopolicy_common": ROOT / "common" / "evopolicy_common",
    "evopolicy_coordinator": ROOT / "coordinator" / "evopolicy_coordinator",
    "evopolicy_results": ROOT / "coordinator" / "evopolicy_results",
    "evopolicy_worker": ROOT / "worker" / "evopolicy_worker",
    "evopolicy_gateway": ROOT / "agent_gateway" / "evopolicy_gateway",
    "evopolicy": ROOT / "agent_gateway" / "evopolicy",
}


ALSO = {"evopolicy": {"evopolicy_gateway"}, "evopolicy_coordinator": {"evopolicy_results"}}
"""A package's further imports, from another package of the same room."""


@cache
def nodes_of(path: Path) -> tuple[ast.Import | ast.ImportFrom | ast.Call, ...]:
    """All imports and calls of a module, at any depth of its code."""
    tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return tuple(node for node in tree if isinstance(node, ast.Import | ast.ImportFrom | ast.Call))


def imports_of(path: Path) -> set[str]:
    """Top-level names of everything that `path` imports, at any depth of its code."""
    found: set[str] = set()
    for node in nodes_of(path):
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
    allowed |= ALSO.get(room, set())
    forbidden = set(ROOMS) - allowed | (set() if room == "evopolicy_worker" else set(SIMULATORS))
    for path in sorted(ROOMS[room].rglob("*.py")):
        assert not imports_of(path) & forbidden, f"{path.relative_to(ROOT)}"


def test_the_core_and_the_ticket_machine_do_no_io() -> None:
    banned = {
        *("asyncio", "socket", "zenoh", "sqlite3", "random", "time", "secrets", "logging", "structlog"),
        *("subprocess", "threading", "os", "pathlib", "tempfile", "datetime"),
    }
    core = sorted((ROOMS["evopolicy_coordinator"] / "core").rglob("*.py"))
    for path in [*core, ROOMS["evopolicy_gateway"] / "submits" / "tickets.py"]:
        assert not imports_of(path) & banned, f"{path.relative_to(ROOT)}"


def modules() -> dict[str, Path]:
    """Every module of the product by its full name, packages by theirs."""
    found: dict[str, Path] = {}
    for folder in ROOMS.values():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder.parent).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the product that a module imports anywhere in its code, under `TYPE_CHECKING` too."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found: set[str] = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = (
                ".".join(package.split(".")[: len(package.split(".")) - node.level + 1]) if node.level else ""
            )
            source = ".".join(part for part in (base, node.module or "") if part)
            within = {f"{source}.{alias.name}" for alias in node.names}
            found |= (within & known.keys()) or {source}
            if not within <= known.keys():
                found.add(source)
    return (found & known.keys()) - {name}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Sets of modules that import each other, by Tarjan's algorithm: strongly connected components of more than one."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        order[name] = lowest[name] = len(order)
        path.append(name)
        for other in graph[name]:
            if other not in order:
                visit(other)
            if other in path:
                lowest[name] = min(lowest[name], lowest[other])
        if lowest[name] == order[name]:
            circle = path[path.index(name) :]
            del path[path.index(name) :]
            if len(circle) > 1:
                found.append(sorted(circle))

    for name in graph:
        if name not in order:
            visit(name)
    return found


def test_a_circle_is_found_where_there_is_one() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"d"}}
    assert circles(graph) == [["a", "b", "c"]]


def test_no_module_of_the_product_is_in_an_import_circle() -> None:
    known = modules()
    assert circles({name: imported(name, path, known) for name, path in known.items()}) == []


CORE = "evopolicy_coordinator.core"
CORE_LAYERS = (
    ("contract",),
    ("structures",),
    ("tables",),
    ("isolation",),
    ("leasing",),
    ("agents",),
    ("workers",),
    ("runs",),
    ("status", "machine"),
)
"""From the ground up, as in ARCHITECTURE.md."""


def test_the_cores_modules_build_on_those_below_them_only() -> None:
    floor = {part: number for number, parts in enumerate(CORE_LAYERS) for part in parts}
    known = modules()
    for name, path in known.items():
        if not name.startswith(f"{CORE}."):
            continue
        part = name.removeprefix(f"{CORE}.").split(".")[0]
        for other in imported(name, path, known):
            if other.startswith(f"{CORE}."):
                below = other.removeprefix(f"{CORE}.").split(".")[0]
                assert floor[below] <= floor[part], f"{name} imports {other}"


OWN_STDOUT = {
    "evopolicy_gateway/agents": "programs of their own, whose stdout is an agent's log",
    "evopolicy_gateway/jail/entry.py": "inside the jail, with the standard library alone",
    "evopolicy_common/processes/parent_death.py": "becomes another program, with the standard library alone",
    "evopolicy_worker/environments/interface/calls.py": "speaks with the process that started it",
    "evopolicy_worker/sandbox/inside": "inside the sandbox, with the standard library alone",
    "evopolicy_common/terminal.py": "is the one place",
    "evopolicy_common/console.py": "is the one place for tables and live views",
}


def test_what_commands_print_goes_through_the_terminal_module() -> None:
    for room, folder in ROOMS.items():
        for path in sorted(folder.rglob("*.py")):
            name = f"{room}/{path.relative_to(folder).as_posix()}"
            if any(name.startswith(own) for own in OWN_STDOUT):
                continue
            calls = [node.func for node in nodes_of(path) if isinstance(node, ast.Call)]
            named = {call.id for call in calls if isinstance(call, ast.Name)}
            named |= {call.attr for call in calls if isinstance(call, ast.Attribute)} & {
                "echo",
                "secho",
                "Console",
            }
            assert not named & {"print", "echo", "secho", "Console"}, name


def test_no_folder_of_the_product_is_in_an_import_circle() -> None:
    """A package's own modules are one folder; what two folders share lies in a third, below both."""
    known = modules()
    folder = {n: n if p.name == "__init__.py" else n.rpartition(".")[0] for n, p in known.items()}
    graph: dict[str, set[str]] = {each: set() for each in folder.values()}
    for name, path in known.items():
        graph[folder[name]] |= {folder[other] for other in imported(name, path, known)} - {folder[name]}
    assert circles(graph) == []


def test_folders_import_only_from_rows_above_them_in_the_architecture() -> None:
    """The table of folders in ARCHITECTURE.md: packages, and their folders from the ground up."""
    place: dict[str, int] = {}
    package = ""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").partition("| package | folder |")[2]
    for number, line in enumerate(text.partition("\n\n")[0].splitlines()[2:]):
        package = (re.findall(r"`(evopolicy_\w+)`", line.split("|")[1]) or [package])[0]
        for folder in re.findall(r"`(\w+)/`", line.split("|")[2]):
            place[f"{package}.{folder}"] = number
        if "(root)" in line:
            place[package] = number
    known = modules()
    top = {
        n: ".".join((n if p.name == "__init__.py" else n.rpartition(".")[0]).split(".")[:2])
        for n, p in known.items()
    }
    for name, path in known.items():
        for other in imported(name, path, known):
            ours, theirs = top[name], top[other]
            if ours != theirs and ours in place and theirs.startswith(ours.partition(".")[0] + "."):
                assert place[theirs] <= place[ours], f"{name} imports {other}"
    assert {
        each for each in top.values() if "." in each and not each.startswith("evopolicy.")
    } <= place.keys()


def test_every_package_is_where_it_should_be() -> None:
    for name, folder in ROOMS.items():
        assert (folder / "__init__.py").is_file(), name
        assert (folder / "py.typed").is_file(), name


def test_no_two_test_files_have_the_same_name() -> None:
    """pytest collects one of two such files alone, and then only where a layer has both."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, n in names.items() if n > 1] == []


def test_a_tests_name_has_at_most_twelve_words_and_ninety_characters() -> None:
    names = (
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^\s*(?:async )?def (test_\w+)\(", path.read_text(), re.MULTILINE)
    )
    assert [name for name in names if len(name) > 90 or name.count("_") > 12] == []


def test_a_class_of_the_product_has_a_name_of_its_own() -> None:
    """But private ones, those of `evopolicy`, whose names are for users, and each policy program's `Policy`."""
    places: dict[str, list[str]] = {}
    inner = {name: path for name, path in modules().items() if not name.startswith("evopolicy.")}
    for module, path in inner.items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_") and node.name != "Policy":
                places.setdefault(node.name, []).append(module)
    assert {name: found for name, found in places.items() if len(found) > 1} == {}
