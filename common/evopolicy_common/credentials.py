"""Who may speak to a cluster, as files: `STATE/credentials/<role>.json`, mode 0600, never an argument or a variable.

The coordinator writes them. So that commands on the same machine find the cluster they are pointed at, it also leaves a
copy's path under the user's own registry folder, by endpoint; a command given `--connect ENDPOINT` and no credentials
file looks there.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Literal

import msgspec

from evopolicy_common.blobs import digest_of, write_atomically
from evopolicy_common.errors import ConfigError

Role = Literal["worker", "gateway", "operator"]


class TlsFiles(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Paths of PEM files for mutual TLS between machines."""

    root_ca: str
    certificate: str
    private_key: str


class Credentials(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one role needs to reach a cluster and to be let in."""

    cluster: str
    role: Role
    endpoints: tuple[str, ...]
    """Zenoh endpoints of the coordinator or of routers before it, such as `tcp/10.0.0.5:7447`."""
    user: str
    password: str
    token: str
    """Worker: join token. Operator: operator token. Gateway: the run's capability; empty in the role's own file."""
    tls: TlsFiles | None = None


def default_state_dir() -> Path:
    """The coordinator's state folder when none is named: `$EVOPOLICY_STATE` or one in the user's state home."""
    named = os.environ.get("EVOPOLICY_STATE")
    return Path(named) if named else _state_home() / "coordinator"


def registry_dir() -> Path:
    """Where this user's clusters on this machine are found by endpoint."""
    return _state_home() / "clusters"


def write(credentials: Credentials, path: Path) -> None:
    """Writes the file with mode 0600, replacing what was there."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_atomically(path, msgspec.json.format(msgspec.json.encode(credentials)), mode=0o600)


def read(path: Path) -> Credentials:
    """The credentials in `path`; ConfigError when it is missing, malformed, or readable by others."""
    try:
        mode = path.stat().st_mode
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read credentials {path}: {error.strerror}") from error
    if stat.S_IMODE(mode) & 0o077:
        raise ConfigError(
            f"credentials {path} may be read by others (mode {stat.S_IMODE(mode):04o}): chmod 600 it"
        )
    try:
        return msgspec.json.decode(data, type=Credentials)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path} is not a credentials file: {error}") from error


def publish(endpoints: tuple[str, ...], folder: Path) -> None:
    """Tells this user's commands that the credentials of these endpoints lie in `folder`."""
    registry = registry_dir()
    registry.mkdir(parents=True, exist_ok=True, mode=0o700)
    for endpoint in endpoints:
        write_atomically(_registered(endpoint), str(folder.resolve()).encode(), mode=0o600, durable=False)


def withdraw(endpoints: tuple[str, ...]) -> None:
    """Takes `publish` back; what is not there is no error."""
    for endpoint in endpoints:
        _registered(endpoint).unlink(missing_ok=True)


def find(role: Role, connect: tuple[str, ...] = (), file: Path | None = None) -> Credentials:
    """The credentials that a command uses, with its `--connect` endpoints put in place of the file's.

    Looks at `file` if one is named, else at the registry for the endpoints, else at the default state folder.
    ConfigError says where it looked and what to do.
    """
    if file is None:
        folder = next(filter(None, map(_folder_of, connect)), None)
        file = (folder or default_state_dir() / "credentials") / f"{role}.json"
        if not file.exists():
            where = f" for {', '.join(connect)}" if connect else ""
            raise ConfigError(
                f"no {role} credentials{where}: looked at {file}. Start evopolicy-coordinator on this machine, or copy"
                f" its STATE/credentials/{role}.json here and name it with --credentials"
            )
    found = read(file)
    if found.role != role:
        raise ConfigError(f"{file} holds credentials of role {found.role!r}; this command needs {role!r}")
    return msgspec.structs.replace(found, endpoints=connect) if connect else found


def _state_home() -> Path:
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "evopolicy"


def _registered(endpoint: str) -> Path:
    return registry_dir() / digest_of(endpoint.encode())[:32]


def _folder_of(endpoint: str) -> Path | None:
    path = _registered(endpoint)
    return Path(path.read_text()) if path.exists() else None
