"""Credentials for a cluster, as files: `STATE/credentials/<role>.json`, mode 0600, never an argument or a variable.

The coordinator writes them for its own machine. It also records their folder in the user's registry folder, by
endpoint: a command with `--connect ENDPOINT` and without a credentials file looks there.

Another machine has a folder from `evopolicy-coordinator certs issue`: a credentials file beside its certificates, which
it names by relative paths. Wherever credentials are named, the file or its folder may be given.

Rule: tokens and results cross a network inside TLS only, unless the file states that its coordinator was started with
`--insecure-tcp`.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import os
import re
import stat
from pathlib import Path
from typing import Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, raised_as
from evopolicy_common.records.blobs import digest_of, write_atomically
from evopolicy_common.records.open_run import is_held
from evopolicy_common.regular_files import read_given

Role = Literal["worker", "gateway", "operator"]
MachineRole = Literal["worker", "gateway", "operator", "router"]
"""The subject of a machine's certificate: a role, or a router before the coordinator."""


class TlsFiles(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Paths of PEM files for mutual TLS between machines; in a file they may be relative to its folder."""

    root_ca: str
    certificate: str
    private_key: str

    def within(self, folder: Path) -> TlsFiles:
        """The same files with paths from `folder`."""
        names = (self.root_ca, self.certificate, self.private_key)
        root_ca, certificate, private_key = (str(folder / name) for name in names)
        return TlsFiles(root_ca=root_ca, certificate=certificate, private_key=private_key)


class Credentials(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything one role needs to connect to a cluster and be admitted."""

    cluster: str
    role: Role
    endpoints: tuple[str, ...]
    """Zenoh endpoints of the coordinator or of routers before it, such as `tls/10.0.0.5:7447`."""
    user: str
    password: str
    token: str
    """Worker: join token. Operator: operator token. Gateway: the run's capability; empty in the role's own file."""
    tls: TlsFiles | None = None
    insecure_tcp: bool = False
    """Whether `tcp/` is permitted beyond this machine: the coordinator's `--insecure-tcp`, recorded in its files."""


def default_state_dir() -> Path:
    """The coordinator's default state folder: `$EVOPOLICY_STATE`, or one in the user's state home."""
    return Path(os.environ.get("EVOPOLICY_STATE") or state_home() / "coordinator")


def local_state_dir() -> Path:
    """The default state folder of clusters that commands start themselves (`evopolicy local`, `try`, …)."""
    return state_home() / "local"


_MOST_BYTES = 1 << 20
"""Of a credentials file or a key."""
_LOOK_S = 0.02
SWEEP_STATE = ".cluster"
"""The state folder of `evopolicy suite --local`, in the sweep's folder."""
WORKERS = "workers"
"""Folder in a state folder: each worker of a local command holds the lock of its name there until it has ended."""


def write(credentials: Credentials, path: Path) -> None:
    """Writes the file with mode 0600, replacing an existing one."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_atomically(path, msgspec.json.format(msgspec.json.encode(credentials)), mode=0o600)


def read_credentials(path: Path) -> Credentials:
    """The credentials in `path`, with absolute paths. Raises ConfigError if missing, malformed or not
    private."""
    data = _read_private(path)
    with raised_as(ConfigError, f"{path} is not a credentials file", *DECODE_ERRORS):
        credentials = msgspec.json.decode(data, type=Credentials)
    if credentials.tls is None:
        return credentials
    tls = credentials.tls.within(Path(os.path.abspath(path.parent)))
    for name in (tls.root_ca, tls.certificate):
        if not Path(name).is_file():
            raise ConfigError(f"{name}, which {path} names, is missing: copy the whole folder")
    _read_private(Path(tls.private_key))
    return msgspec.structs.replace(credentials, tls=tls)


def at(credentials: Credentials, connect: tuple[str, ...]) -> Credentials:
    """The same credentials with the endpoints `connect`, if any. Raises ConfigError as `check_endpoints` does."""
    changed = msgspec.structs.replace(credentials, endpoints=connect) if connect else credentials
    check_endpoints(changed)
    return changed


def check_endpoints(credentials: Credentials) -> None:
    """Raises ConfigError for an endpoint that would carry secrets unencrypted, or that needs missing certificates."""
    for endpoint in credentials.endpoints:
        protocol = endpoint.partition("/")[0]
        if protocol == "tls":
            if credentials.tls is None:
                raise ConfigError(
                    f"{endpoint}: these credentials have no certificate; use a folder made by"
                    f" `evopolicy-coordinator certs issue {credentials.role} NAME`"
                )
        elif not (stays_on_machine(endpoint) or (protocol == "tcp" and credentials.insecure_tcp)):
            if protocol not in ("tcp", "unixsock-stream"):
                raise ConfigError(f"{endpoint!r} is not an endpoint; use the form tls/HOST:PORT")
            raise ConfigError(
                f"{endpoint} would send tokens unencrypted; use tls/HOST:PORT and a folder made by"
                f" `evopolicy-coordinator certs issue {credentials.role} NAME`"
            )


def stays_on_machine(endpoint: str) -> bool:
    """Whether data sent to a Zenoh endpoint stay on this machine: a unix socket, or tcp to a loopback address."""
    protocol, _, rest = endpoint.partition("/")
    if protocol != "tcp":
        return protocol == "unixsock-stream"
    host = re.split("[?#]", rest)[0].rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def host_and_port(option: str, value: str, example: str) -> tuple[str, int]:
    """The parts of `HOST:PORT`, the value of an option. Raises ConfigError for another form."""
    host, _, port = value.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or int(port) >= 1 << 16:
        raise ConfigError(f"{option} {value!r}: use the form HOST:PORT, such as {example}")
    return host, int(port)


def publish(endpoints: tuple[str, ...], folder: Path) -> None:
    """Registers `folder` for these endpoints, for this user's commands. Raises ConfigError if it cannot."""
    registry = state_home() / "clusters"
    try:
        registry.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        why = f"cannot make {registry}, where commands find this cluster: {error.strerror}"
        raise ConfigError(f"{why}; set XDG_STATE_HOME to a folder that you can write") from error
    for endpoint in endpoints:
        write_atomically(_registered(endpoint), str(folder.resolve()).encode(), mode=0o600, durable=False)


def withdraw(endpoints: tuple[str, ...]) -> None:
    """Reverts `publish`; missing entries are no error."""
    for endpoint in endpoints:
        _registered(endpoint).unlink(missing_ok=True)


def find(role: Role, connect: tuple[str, ...] = (), file: Path | None = None) -> Credentials:
    """The credentials of a command, with its `--connect` endpoints in place of the file's.

    Reads `file` if given (or, when that is a folder, the role's file in it), else the registry's entry for the
    endpoints, else the default state folder. Raises ConfigError that names the searched place and the remedy.
    """
    if file is not None and file.is_dir():
        held = ", ".join(sorted(path.stem for path in file.glob("*.json"))) or "none"
        file = file / f"{role}.json"
        if not file.exists():
            raise ConfigError(f"{file.parent} has no {role} credentials (roles there: {held})")
    if file is None:
        known = (entry for entry in map(_registered, connect) if entry.exists())
        folder = next((Path(entry.read_text()) for entry in known), default_state_dir() / "credentials")
        file = folder / f"{role}.json"
        if not file.exists():
            where = f" for {', '.join(connect)}" if connect else ""
            alone = role == "operator" and not connect
            local = ". A run on this machine alone needs none: evopolicy local --env gym/acrobot --agent"
            local = f"{local} llm:openai/MODEL" * alone
            raise ConfigError(
                f"no {role} credentials{where}: looked at {file}. Start evopolicy-coordinator on this machine, or name"
                f" a folder that `evopolicy-coordinator certs issue {role} NAME` wrote with --credentials{local}"
            )
    own = read_credentials(file)
    if own.role != role:
        raise ConfigError(f"{file} holds credentials of role {own.role!r}; this command needs {role!r}")
    return at(own, connect)


def find_running(connect: tuple[str, ...] = (), file: Path | None = None) -> Credentials:
    """As `find` for an operator. With neither argument, and no coordinator on the default state folder, those of the
    local cluster that a command of this user runs. ConfigError names them if there are several."""
    if not connect and file is None and not is_held(default_state_dir() / "lock"):
        folders: set[Path] = set()
        for entry in (state_home() / "clusters").glob("[!.]*"):
            with contextlib.suppress(OSError):  # its cluster has ended
                folder = Path(entry.read_text())
                folders |= {folder} if is_held(folder.parent / "lock") else set()
        if len(folders) > 1:
            several = " or ".join(f"--credentials {folder}" for folder in sorted(folders))
            raise ConfigError(f"{len(folders)} clusters run on this machine: name one with {several}")
        file = next(iter(folders), None)
    return find("operator", connect, file)


def _read_private(path: Path) -> bytes:
    data = read_given(path, f"credentials {path}", _MOST_BYTES)
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077:
        raise ConfigError(f"credentials {path} may be read by others (mode {mode:04o}): chmod 600 it")
    return data


def no_state(root: Path, missing: str) -> ConfigError:
    """The error of a command that reads the coordinator's state folder, where `root` is none."""
    local = local_state_dir()
    of_local = f"; that of `evopolicy local` is {local}" if local != root and local.exists() else ""
    return ConfigError(
        f"{root} is not a coordinator's state folder: it has no {missing}; name one with --state{of_local}"
    )


def state_home() -> Path:
    """Folder of this user's persistent files when a command is given no other."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state", "evopolicy")


def _registered(endpoint: str) -> Path:
    """The file by which this user's commands find a cluster of this machine."""
    return state_home() / "clusters" / digest_of(endpoint.encode())[:32]


class ReadyCluster(msgspec.Struct, frozen=True, kw_only=True):
    """How to reach a coordinator."""

    cluster: str
    endpoints: tuple[str, ...]
    """Endpoints for processes of this machine; those of `tls/`, which need certificates, come last."""
    credentials: dict[Role, str]
    """Paths of this machine's credentials files by role."""
    state: str
    note: str = ""
    """A note for the operator on the cases of new runs; empty for none."""


async def read_ready(path: Path, failed: asyncio.Future[None]) -> ReadyCluster:
    """Waits for the file and reads it. `failed` ends only with an error, which is raised here if it comes first."""
    while not path.exists():
        if failed.done():
            failed.result()
        await asyncio.sleep(_LOOK_S)
    return msgspec.json.decode(path.read_bytes(), type=ReadyCluster)
