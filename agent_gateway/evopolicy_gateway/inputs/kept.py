"""A run's own copies of its declared inputs, which the jail shows read-only.

The copies are made at the agent's first start, outside the agent's view, and compared with the run's digests at each
start: inputs must not change while a run is open.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_record import AgentInput
from evopolicy_gateway.inputs.declared import IN_JAIL, Content, McpServer, ServerCommand, read_inputs

MCP_FILE = f"{IN_JAIL}/mcp.json"
"""The servers in the form that many CLIs read, `{"mcpServers": {…}}`."""


class KeptInputs(msgspec.Struct, frozen=True, kw_only=True):
    """The inputs of one run's agent."""

    folder: Path | None = None
    skills: tuple[str, ...] = ()
    servers: Mapping[str, ServerCommand] = {}

    def __bool__(self) -> bool:
        return bool(self.skills or self.servers)

    def shown(self, skills_at: str) -> list[tuple[str, str]]:
        """Each copy with its place in the jail; `skills_at`: folder in which the agent looks for skills."""
        if self.folder is None or not self:
            return []
        places = {f"skills/{name}": f"{skills_at}/{name}" for name in self.skills}
        own = [f"mcp/{name}" for name in self.servers if (self.folder / "mcp" / name).is_dir()]
        places |= {path: f"{IN_JAIL}/{path}" for path in own} | {"mcp.json": MCP_FILE}
        return [(str(self.folder / path), place) for path, place in places.items()]


def keep(
    skills: Sequence[str],
    servers: Mapping[str, McpServer],
    started_in: Path,
    folder: Path,
    expected: Sequence[AgentInput],
) -> KeptInputs:
    """The copies in `folder`, made if missing. ConfigError when the inputs differ from `expected`."""
    declared = read_inputs(skills, servers, started_in)
    if changed := {(each.kind, each.name) for each in {each.recorded for each in declared} ^ set(expected)}:
        names = ", ".join(f"{kind} {name}" for kind, name in sorted(changed))
        raise ConfigError(
            f"{names} in the agent's file changed after the run was opened: restore what was there, or start the run"
            " anew with --overwrite"
        )
    started = {each.recorded.name: each.server for each in declared if each.server is not None}
    if not (folder / "mcp.json").exists():
        remove_tree(folder)
        _write(declared, started, folder)
    for each in declared:
        about, place = each.recorded, _place(folder, each.recorded)
        paths = (path for path in place.rglob("*") if path.is_symlink() or not path.is_dir())
        copies = {path.relative_to(place).as_posix(): path for path in paths}
        if copies.keys() != each.files.keys() or any(
            path.is_symlink() or not path.is_file() or path.read_bytes() != each.files[name].data
            for name, path in copies.items()
        ):
            raise ConfigError(
                f"the run's copy of {about.kind} {about.name} in {place} was changed: start the run anew with"
                " --overwrite"
            )
    skills_named = tuple(each.recorded.name for each in declared if each.recorded.kind == "skill")
    return KeptInputs(folder=folder, skills=skills_named, servers=started)


def _place(folder: Path, about: AgentInput) -> Path:
    return folder / ("skills" if about.kind == "skill" else "mcp") / about.name


def _write(declared: Sequence[Content], servers: dict[str, ServerCommand], folder: Path) -> None:
    for each in declared:
        for name, file in each.files.items():
            path = _place(folder, each.recorded) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(file.data)
            path.chmod(0o555 if file.executable else 0o444)
    folder.mkdir(parents=True, exist_ok=True)
    # Written last and atomically: it marks the copies as complete.
    document = json.dumps({"mcpServers": msgspec.to_builtins(servers)}, indent=2)
    write_atomically(folder / "mcp.json", document.encode())
