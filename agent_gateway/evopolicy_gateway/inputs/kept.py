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
    _check_unchanged([each.recorded for each in declared], expected)
    if not (folder / "mcp.json").exists():
        remove_tree(folder)
        _write(declared, folder)
    for each in declared:
        _check_copy(each, folder)
    skills_named = tuple(each.recorded.name for each in declared if each.recorded.kind == "skill")
    return Kept(folder=folder, skills=skills_named, servers=_servers(declared))


def _check_unchanged(now: Sequence[AgentInput], then: Sequence[AgentInput]) -> None:
    differing = {(each.kind, each.name) for each in set(now) ^ set(then)}
    if differing:
        names = ", ".join(f"{kind} {name}" for kind, name in sorted(differing))
        raise ConfigError(
            f"{names} in the agent's file changed after the run was opened: restore what was there, or start the run"
            " anew with --overwrite"
        )


def _place(folder: Path, about: AgentInput) -> Path:
    return folder / ("skills" if about.kind == "skill" else "mcp") / about.name


def _check_copy(content: Content, folder: Path) -> None:
    """Raises ConfigError when a copy does not have the content."""
    about, place = content.recorded, _place(folder, content.recorded)
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
        for name, file in each.files.items():
            path = _place(folder, each.recorded) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(file.data)
            path.chmod(0o555 if file.executable else 0o444)
    folder.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {"mcpServers": msgspec.to_builtins(_servers(declared))}
    # Written last and atomically: it marks the copies as complete.
    write_atomically(folder / "mcp.json", json.dumps(document, indent=2).encode())


def _servers(declared: Sequence[Content]) -> dict[str, Server]:
    return {
        each.recorded.name: Server(command=each.words[0], args=each.words[1:], env=dict(each.environment))
        for each in declared
        if each.recorded.kind == "mcp"
    }
