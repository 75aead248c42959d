"""A run's own copies of its declared inputs, which the jail shows read-only.

The copies are made at the agent's first start, outside the agent's view, and compared with the run's digests at each
start: inputs must not change while a run is open.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_record import AgentInput
from evopolicy_gateway.inputs.declared import IN_JAIL, Content, McpServer, read

MCP_FILE = f"{IN_JAIL}/mcp.json"
"""The servers in the form that many CLIs read, `{"mcpServers": {…}}`."""


class Server(msgspec.Struct, frozen=True, kw_only=True):
    """How to start an MCP server in the jail."""

    command: str
    args: tuple[str, ...] = ()
    env: dict[str, str] = {}


class Kept(msgspec.Struct, frozen=True, kw_only=True):
    """The inputs of one run's agent."""

    folder: Path | None = None
    skills: tuple[str, ...] = ()
    """Names of skills."""
    servers: Mapping[str, Server] = {}

    def __bool__(self) -> bool:
        return bool(self.skills or self.servers)

    @property
    def commands(self) -> list[tuple[str, ...]]:
        """The servers' command lines, whose programs the jail shows."""
        return [(server.command,) for server in self.servers.values()]

    def shown(self, skills_at: str) -> list[tuple[str, str]]:
        """Each copy with its place in the jail; `skills_at`: folder in which the agent looks for skills."""
        if self.folder is None or not self:
            return []
        binds = [(str(self.folder / "skills" / name), f"{skills_at}/{name}") for name in self.skills]
        own = [name for name in self.servers if (self.folder / "mcp" / name).is_dir()]
        binds += [(str(self.folder / "mcp" / name), f"{IN_JAIL}/mcp/{name}") for name in own]
        return [*binds, (str(self.folder / "mcp.json"), MCP_FILE)]


def keep(
    skills: Sequence[str],
    servers: Mapping[str, McpServer],
    started_in: Path,
    folder: Path,
    expected: Sequence[AgentInput],
) -> Kept:
    """The copies in `folder`, made where there are none. ConfigError when the declared files, or the copies, are not
    those with which the run was opened."""
    declared = read(skills, servers, started_in)
    _compare([each.recorded for each in declared], expected, "in the agent's file")
    if not (folder / "mcp.json").exists():
        remove_tree(folder)
        _write(declared, folder)
    for each in declared:
        _check_copy(each, folder)
    return Kept(
        folder=folder,
        skills=tuple(each.recorded.name for each in declared if each.recorded.kind == "skill"),
        servers={each.recorded.name: _start(each) for each in declared if each.recorded.kind == "mcp"},
    )


def changed(now: Sequence[AgentInput], then: Sequence[AgentInput]) -> str:
    """Which inputs differ, for an error; empty for none."""
    known = {(each.kind, each.name): each for each in then}
    here = {(each.kind, each.name): each for each in now}
    differing = [
        f"{kind} {name}"
        for kind, name in sorted(known.keys() | here.keys())
        if known.get((kind, name)) != here.get((kind, name))
    ]
    return ", ".join(differing)


def _compare(now: Sequence[AgentInput], then: Sequence[AgentInput], where: str) -> None:
    if differing := changed(now, then):
        raise ConfigError(
            f"{differing} {where} changed after the run was opened: restore what was there, or start the run anew with"
            " --overwrite"
        )


def _check_copy(content: Content, folder: Path) -> None:
    """Raises ConfigError when a copy does not have the content."""
    about = content.recorded
    place = folder / ("skills" if about.kind == "skill" else "mcp") / about.name
    copies = {
        path.relative_to(place).as_posix(): path
        for path in place.rglob("*")
        if path.is_symlink() or not path.is_dir()
    }
    same = copies.keys() == content.files.keys() and all(
        not path.is_symlink() and path.is_file() and path.read_bytes() == content.files[name].data
        for name, path in copies.items()
    )
    if not same:
        raise ConfigError(
            f"the run's copy of {about.kind} {about.name} in {place} was changed: start the run anew with --overwrite"
        )


def _write(declared: Sequence[Content], folder: Path) -> None:
    for each in declared:
        place = folder / ("skills" if each.recorded.kind == "skill" else "mcp") / each.recorded.name
        for name, file in each.files.items():
            path = place / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(file.data)
            path.chmod(0o555 if file.executable else 0o444)
    folder.mkdir(parents=True, exist_ok=True)
    servers = {each.recorded.name: _start(each) for each in declared if each.recorded.kind == "mcp"}
    document: dict[str, Any] = {"mcpServers": msgspec.to_builtins(servers)}
    # Written last and atomically: it marks the copies as complete.
    write_atomically(folder / "mcp.json", json.dumps(document, indent=2).encode())


def _start(content: Content) -> Server:
    return Server(command=content.words[0], args=content.words[1:], env=dict(content.environment))
