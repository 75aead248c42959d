"""A skill and an MCP server, as an operator declares them."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from evopolicy_gateway.inputs.declared import McpServer

DESCRIPTION = "Use it when a lamp has to be read."


def declare(folder: Path) -> tuple[tuple[str, ...], dict[str, McpServer]]:
    """Writes both into a folder: the values of `skills` and `mcp` in an agent's file."""
    skill = folder / "skills" / "lamps"
    (skill / "scripts").mkdir(parents=True)
    (skill / "SKILL.md").write_text(
        f"---\nname: lamps\ndescription: {DESCRIPTION}\n---\n\nRead the lamp twice.\n"
    )
    (skill / "scripts" / "read.sh").write_text("#!/bin/sh\necho lit\n")
    (skill / "scripts" / "read.sh").chmod(0o755)
    tools = folder / "tools"
    tools.mkdir()
    shutil.copy(Path(__file__).with_name("mcp_server.py"), tools)
    (tools / "lamp.txt").write_text("42")
    # Base Python: the jail shows it, and the virtual environment only in part.
    server = McpServer(
        command=f"{sys.base_prefix}/bin/python3",
        args=("tools/mcp_server.py",),
        files=("tools",),
        environment={"UNIT": "lux"},
        hosts=("lamps.example.org",),
    )
    return ("skills/lamps",), {"lamp": server}


def as_toml(value: Any) -> str:
    """A setting as TOML on one line."""
    if isinstance(value, dict):
        known = {key: inner for key, inner in value.items() if inner is not None}
        return "{" + ", ".join(f"{json.dumps(key)} = {as_toml(inner)}" for key, inner in known.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return json.dumps(value)
