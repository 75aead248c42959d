"""Which files a program's jail shows, and which it covers.

Attacks, each with its defence:
- leaves a link in its home or /tmp where its next start mounts something, so that bubblewrap follows it to
  the machine: links on the way to a mount are removed before each start.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from program_runs import put_program, run_program

from evopolicy_gateway.jail.installs import hidden_below, needs_of
from evopolicy_gateway.jail.view import JailView


def arguments(tmp_path: Path, **fields: object) -> list[str]:
    return view(tmp_path, **fields).arguments()


def view(tmp_path: Path, command: tuple[str, ...] = (), **fields: object) -> JailView:
    workspace = tmp_path / "runs" / "w"
    (workspace / "feedback").mkdir(parents=True)
    (workspace / "AGENTS.md").touch()
    usual: dict[str, object] = {"workspace": workspace, "private": tmp_path / "private"}
    usual |= {"home": "/home/somebody", "needs": needs_of(command, None), "read": (), "write": ()}
    usual |= {"hidden": (tmp_path / "runs",), "open_network": False}
    return JailView(**(usual | fields))  # type: ignore[arg-type]


def triples(words: list[str], option: str) -> list[tuple[str, str]]:
    return [(words[i + 1], words[i + 2]) for i, word in enumerate(words) if word == option]


def test_a_program_brings_its_installation_and_the_interpreter_of_its_first_line(tmp_path: Path) -> None:
    node = put_program(tmp_path / "node" / "bin" / "node", "")
    (tmp_path / "node" / "lib").mkdir()
    modules = tmp_path / "npm" / "lib" / "node_modules"
    cli = put_program(modules / "cli" / "cli.js", f"#!/usr/bin/env -S {node} --flag\n")
    link = tmp_path / "npm" / "bin" / "cli"
    link.parent.mkdir()
    link.symlink_to("../lib/node_modules/cli/cli.js")
    needs = needs_of([str(link)], None)
    assert str(cli.parents[1]) in needs.paths
    assert str(tmp_path / "node") in needs.paths
    assert needs.links[str(link)] == "../lib/node_modules/cli/cli.js"


def test_a_lone_program_brings_itself_and_the_files_its_command_names(tmp_path: Path) -> None:
    tool, data = put_program(tmp_path / "tools" / "tool", ""), tmp_path / "data.json"
    data.touch()
    (tmp_path / "tools" / "secret").touch()
    needs = needs_of([str(tool), "--data", str(data), "/no/such/file", "word"], None)
    paths = {path for path in needs.paths if path.startswith(str(tmp_path))}
    assert paths == {str(tool), str(data)}


def test_our_environments_packages_are_not_shown_as_a_whole() -> None:
    needs = needs_of([sys.executable], None)
    assert not any("site-packages" in path for path in needs.paths)
    assert sys.prefix not in needs.paths or sys.prefix == sys.base_prefix


@pytest.mark.parametrize(
    "place", ["lib/python3.11", "versions/3.12.1/lib/python3.12", "local/lib/python3.13"]
)
def test_simulators_are_found_wherever_a_python_keeps_its_packages(tmp_path: Path, place: str) -> None:
    site = tmp_path / place / "site-packages"
    for name in ("gymnasium", "numpy", "mujoco", "gymnasium-1.0.dist-info"):
        (site / name).mkdir(parents=True)
    (site / "Box2D.so").touch()
    names = {Path(path).name for path in hidden_below(str(tmp_path))}
    assert names == {"gymnasium", "mujoco", "Box2D.so"}


def test_hidden_folders_are_covered_in_a_folder_that_the_operator_shows(tmp_path: Path) -> None:
    words = arguments(tmp_path, read=(str(tmp_path),))
    covers = [words[i + 1] for i, word in enumerate(words) if word == "--tmpfs"]
    assert str(tmp_path / "runs") in covers
    shown = words.index(str(tmp_path))
    assert shown < words.index(str(tmp_path / "runs"), shown) < words.index(str(tmp_path / "runs" / "w"))


def test_hidden_folders_are_covered_behind_a_link_too(tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path)
    words = arguments(tmp_path, read=(str(link),))
    assert str(link / "runs") in [words[i + 1] for i, word in enumerate(words) if word == "--tmpfs"]


def test_feedback_and_rules_lie_read_only_over_the_writable_workspace(tmp_path: Path) -> None:
    words = arguments(tmp_path)
    workspace = str(tmp_path / "runs" / "w")
    assert (workspace, workspace) in triples(words, "--bind")
    for name in ("feedback", "AGENTS.md"):
        assert (f"{workspace}/{name}", f"{workspace}/{name}") in triples(words, "--ro-bind")
        assert words.index(workspace) < words.index(f"{workspace}/{name}")


def test_only_an_open_network_shares_this_machines(tmp_path: Path) -> None:
    assert "--unshare-net" in arguments(tmp_path / "a")
    assert "--unshare-net" not in arguments(tmp_path / "b", open_network=True)


def test_an_agents_second_program_finds_the_firsts_links(tmp_path: Path) -> None:
    for n, home in enumerate(("/home/somebody", str(tmp_path))):
        shown = view(tmp_path / str(n), home=home, hidden=())
        shown.needs.links |= dict.fromkeys(("/tmp/some/python", f"{home}/some/python"), "/usr/bin/env")
        shown.prepare()
        for _ in range(2):
            done = run_program(*shown.arguments(), "/tmp/some/python", f"{home}/some/python", "true")
            assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("what", ["inputs", "read"])
def test_links_towards_a_mount_are_removed_before_bubblewrap_follows(tmp_path: Path, what: str) -> None:
    """bubblewrap creates missing folders of a mount's place while it sees the whole machine, and follows links
    meanwhile."""
    private, outside, home = tmp_path / "private", tmp_path / "outside", tmp_path / "home"
    skill = home / ".agents" / "skills" / "lamps"
    for folder in (private / "home", outside, skill):
        folder.mkdir(parents=True)
    (private / "home" / ".agents").symlink_to(f"/oldroot{outside}")
    (skill / "SKILL.md").write_text("Read the lamp twice.")
    shown = {"inputs": ((str(skill), str(skill)),), "read": (str(skill),)}
    shown_in = view(tmp_path, ("sh",), **{"home": str(home), what: shown[what]})
    shown_in.prepare()
    script = f"cat {skill}/SKILL.md; echo x >> {skill}/SKILL.md || echo refused"
    done = run_program(*shown_in.arguments(), "--", "sh", "-c", script)
    assert done.stdout == "Read the lamp twice.refused\n", done.stderr
    assert list(outside.iterdir()) == []


def test_links_on_the_way_to_a_link_are_removed_likewise(tmp_path: Path) -> None:
    private, outside, home = tmp_path / "private", tmp_path / "outside", tmp_path / "home"
    for folder in (private / "home", outside):
        folder.mkdir(parents=True)
    (private / "home" / ".local").symlink_to(f"/oldroot{outside}")
    shown = view(tmp_path, ("sh",), home=str(home))
    shown.needs.links[f"{home}/.local/bin/cli"] = "/bin/sh"
    shown.prepare()
    done = run_program(*shown.arguments(), "--", f"{home}/.local/bin/cli", "-c", "echo started")
    assert list(outside.iterdir()) == []
    assert done.stdout == "started\n", done.stderr
