"""The inputs that an agent's file declares: folders of skills, and MCP servers with their files.

They are read and digested before a run is opened. The digests are a setting of the run and covered by its commitment.
Files are those below the folder in which the command was started. Links are not followed, so the agent gets exactly the
digested files.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_common.errors import ConfigError, raised_as
from evopolicy_common.records.run_record import AgentInput
from evopolicy_common.regular_files import open_regular
from evopolicy_gateway.jail.settings import host

IN_JAIL = "/inputs"
"""Their folder in a jail."""
SKILL = "SKILL.md"
MAX_FILES = 2000
MAX_BYTES = 16 << 20
_NOT_READ = (".git", "__pycache__")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class McpServer(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A server of the Model Context Protocol that the agent starts in its jail."""

    command: str
    """Its program: on the PATH, or a file."""
    args: tuple[str, ...] = ()
    """Files and folders among them, below the folder in which the command was started, belong to its digest."""
    files: tuple[str, ...] = ()
    """Further files and folders that it needs."""
    environment: dict[str, str] = {}
    """Recorded in `run.json`: no secrets here."""
    hosts: tuple[str, ...] = ()
    """`HOST` (port 443) or `HOST:PORT`; the jail then allows them to the whole agent."""


class InputFile(NamedTuple):
    data: bytes
    executable: bool


class ServerCommand(msgspec.Struct, frozen=True):
    """How to start an MCP server in the jail."""

    command: str
    args: tuple[str, ...] = ()
    env: dict[str, str] = {}


class Content(NamedTuple):
    """One input with its files, by their paths below its folder."""

    recorded: AgentInput
    files: Mapping[str, InputFile]
    server: ServerCommand | None = None


def read_inputs(skills: Sequence[str], servers: Mapping[str, McpServer], started_in: Path) -> list[Content]:
    """All that is declared. Raises ConfigError that names the entry and its fault."""
    contents = [_skill(path, started_in) for path in skills]
    names = [each.recorded.name for each in contents]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"skills: there are two folders named {twice[0]!r}; rename one")
    return contents + [_server(name, server, started_in) for name, server in servers.items()]


def _skill(path: str, started_in: Path) -> Content:
    field = f"skills: {path}"
    folder = _below(field, path, started_in)
    _check_name("skills", folder.name)
    files = dict(_files(field, folder, ""))
    if SKILL not in files:
        raise ConfigError(f"{field}: the folder has no {SKILL}, so it is no skill")
    return Content(AgentInput(kind="skill", name=folder.name, digest=_digest(files)), files)


def _server(name: str, server: McpServer, started_in: Path) -> Content:
    field = f"mcp.{name}"
    _check_name("mcp", name)
    for text in server.hosts:
        host(text, f"{field}.hosts")
    roots = {path: _below(f"{field}.files", path, started_in) for path in server.files}
    words: list[str] = []
    for word in server.args:
        # Absolute paths are those of the jail.
        if word and not os.path.isabs(word) and os.path.lexists(started_in / word):
            place = _below(f"{field}.args", word, started_in)
            root = next((one for one in roots.values() if place.is_relative_to(one)), None)
            if root is None:
                root = roots[word] = place
            word = os.path.normpath(f"{IN_JAIL}/mcp/{name}/{root.name}/{place.relative_to(root)}")
        words.append(word)
    files: dict[str, InputFile] = {}
    for path, root in roots.items():
        if any(other.name == root.name and other != root for other in roots.values()):
            raise ConfigError(f"{field}: two of its files or folders are named {root.name!r}; rename one")
        files |= _files(f"{field}: {path}", root, root.name)
    own = started_in / server.command
    beside = "/" in server.command and own.is_file()
    program = os.path.abspath(own) if beside else shutil.which(server.command)
    if program is None:
        why = f"there is no program {server.command!r}, neither as a file nor on the PATH"
        raise ConfigError(f"{field}.command: {why}")
    with raised_as(ConfigError, f"{program} cannot be read", OSError), open(program, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    about = [os.path.basename(program), digest, words, sorted(server.environment.items())]
    recorded = AgentInput(kind="mcp", name=name, digest=_digest(files, about), hosts=server.hosts)
    return Content(recorded, files, ServerCommand(program, tuple(words), server.environment))


def _check_name(field: str, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{field}: the name {name!r} is not made of letters, digits, '_' and '-' (at most 64)"
        )


def _below(field: str, path: str, started_in: Path) -> Path:
    """The absolute path. ConfigError where it leads out of the folder, or over a link."""
    whole = Path(os.path.normpath(started_in / path))
    if not whole.is_relative_to(started_in) or whole == started_in:
        raise ConfigError(
            f"{field}: {whole} is not below {started_in}; copy it there, so that nothing else is shown"
        )
    for part in (whole, *whole.parents):
        if part == started_in:
            break
        if part.is_symlink():
            raise ConfigError(f"{field}: {part} is a symbolic link; put a copy in its place")
    if not whole.exists():
        raise ConfigError(f"{field}: {whole} does not exist")
    return whole


def _files(field: str, root: Path, prefix: str) -> Iterator[tuple[str, InputFile]]:
    """The files at `root`, by path from `prefix` on. ConfigError for links, devices, and too much."""
    remaining, n, pending = MAX_BYTES, 0, [(root, prefix)]
    while pending:
        path, name = pending.pop()
        with raised_as(ConfigError, f"{field}: {path}", OSError):
            mode = path.lstat().st_mode
            if stat.S_ISDIR(mode):
                pending += [
                    (inner, f"{name}/{inner.name}" if name else inner.name)
                    for inner in sorted(path.iterdir(), reverse=True)
                    if inner.name not in _NOT_READ
                ]
                continue
            if not stat.S_ISREG(mode):
                kind = "a symbolic link; put a copy in its place" if stat.S_ISLNK(mode) else "no regular file"
                raise ConfigError(f"{field}: {path} is {kind}")
            with open_regular(path) as file:
                data = file.read(remaining + 1)
        if any("\ud800" <= character <= "\udfff" for character in name):
            raise ConfigError(f"{field}: the name {str(path)!r} is not UTF-8; rename the file")
        remaining, n = remaining - len(data), n + 1
        if remaining < 0 or n > MAX_FILES:
            raise ConfigError(
                f"{field}: more than {MAX_BYTES >> 20} MiB or {MAX_FILES} files; leave out what the agent does not need"
            )
        yield name, InputFile(data, bool(mode & 0o100))


def _digest(files: Mapping[str, InputFile], about: object = None) -> str:
    listed = [
        (name, hashlib.sha256(file.data).hexdigest(), file.executable) for name, file in sorted(files.items())
    ]
    return f"sha256:{hashlib.sha256(msgspec.json.encode([listed, about])).hexdigest()}"
