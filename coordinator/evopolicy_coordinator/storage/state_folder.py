"""The coordinator's state folder: its lock, its contents, and the credentials written from it.

    STATE/                        mode 0700, one coordinator at a time (`lock`)
      secret                      the 256 bits that hidden splits are derived from
      secret-unjailed             those for runs whose agents have no full jail and could read this folder
      identity.json               the cluster's name, and each role's password and token
      certs/                      the certificates of other machines: see machines.py
      passwords                   the same passwords, for Zenoh's router
      credentials/<role>.json     the credentials of workers, gateways and operators on this machine
      coordinator.sqlite          the authoritative state
      store                       the address of the PostgreSQL database that has it instead
      sealed                      what of this folder that database has too, for standbys: see sealing.py
      blobs/                      trajectories, videos and policy bundles
      blob-store                  the address of the object store, or the folder, that has them instead
      blob-copies/                unfinished uploads to an object store, and copies of blobs from there
      coordinator.sock            the socket for processes of this machine
      workers/<name>              locks of local commands' workers, which the kernel frees with the worker

All passwords, tokens and keys are made once, have mode 0600, and survive restarts, so that workers reconnect by
themselves.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import secrets
import socket
import stat
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, raised_as
from evopolicy_common.processes.preflight import check_writable, refused
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.open_run import is_held
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import WORKERS, Credentials, ReadyCluster, Role

ROLES: tuple[Role, ...] = ("worker", "gateway", "operator")
_SOCKET = "coordinator.sock"
_SOCKET_PATH_LIMIT = 100
"""Bytes. Linux allows 107 for a unix socket's path, and Zenoh puts a `.lock` beside it."""
_ANOTHER = (
    "choose another folder with --state; without --data, another state has other hidden cases, so its scores are not"
    " comparable"
)
_MOST_BYTES = 1 << 20
_WRITTEN_S, _LOOK_S = 0.5, 0.02
"""Within this time a process that has taken the lock has said so in the file."""
_ENDED_S = 3.0


class Identity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The cluster's identity, kept across restarts."""

    cluster: str
    passwords: dict[Role, str]
    worker_token: str
    """Join token: a client that holds it may offer slots."""
    operator_token: str


class Holder(msgspec.Struct, frozen=True, kw_only=True):
    """Content of the lock file while a coordinator has the folder."""

    process: int
    local: dict[str, str] | None = None
    """The options of a local cluster that its commands have to share, by name; None: another coordinator."""
    ready: ReadyCluster | None = None
    """None: it does not serve yet."""


class InUseError(ConfigError):
    """A process has the folder."""

    def __init__(self, root: Path, holder: Holder | None) -> None:
        super().__init__(
            f"state folder {root} is in use by another coordinator (process"
            f" {'unknown' if holder is None else holder.process}); wait for it, stop it, or {_ANOTHER}"
        )
        self.root, self.holder = root, holder

    def shared(self, local: Mapping[str, str] | None) -> ReadyCluster | None:
        """How a local cluster with these options reaches the coordinator that serves here; None: it is starting. Raises
        ConfigError when it is none of a local cluster, or has other options."""
        holder = self.holder
        if local is None or holder is None or holder.local is None:
            raise self
        names = sorted(name for name in {*local, *holder.local} if local.get(name) != holder.local.get(name))
        if names:
            given = "; ".join(
                f"{name}: {holder.local.get(name, 'not given')} there, {local.get(name, 'not given')} here"
                for name in names
            )
            raise ConfigError(
                f"the local cluster that runs on state folder {self.root} has other options ({given}): give the"
                f" same, wait until its commands have ended, or {_ANOTHER}"
            )
        return holder.ready


class StateFolder:
    """An opened state folder, locked until `close`."""

    def __init__(self, root: Path, lock_fd: int, holder: Holder, identity: Identity) -> None:
        self.root = root
        self.identity = identity
        self.passwords = root / "passwords"
        """The file that Zenoh's router reads: a line `user:password` for each role."""
        self.credentials = root / "credentials"
        """Folder of this machine's credentials, one file per role."""
        self._lock_fd, self._holder = lock_fd, holder
        self._link: Path | None = None

    @classmethod
    def open(cls, root: Path, local: dict[str, str] | None = None) -> StateFolder:
        """Creates the folder if it is missing, locks it and reads its identity. `local`: as in `Holder`. Raises
        InUseError when another coordinator holds the lock, ConfigError when others may enter the folder."""
        root = Path(os.path.abspath(root))
        _make_private(root)
        holder = Holder(process=os.getpid(), local=local)
        lock_fd = lock(root, holder)
        try:
            return cls(root, lock_fd, holder, identity_of(root))
        except BaseException:
            os.close(lock_fd)
            raise

    @property
    def socket_endpoint(self) -> str:
        """The Zenoh endpoint inside the folder, the same after every restart: through a link when its own
        path is too long for a unix socket. Raises ConfigError when there is no place for a link."""
        folder = self.root
        if not _fits(folder):
            folder = self._link = _linked(folder)
        return f"unixsock-stream/{folder / _SOCKET}"

    def write_credentials(
        self, endpoints: tuple[str, ...], *, insecure_tcp: bool = False
    ) -> dict[Role, Path]:
        """Writes the roles' files for `endpoints`, with `insecure_tcp` also for plain `tcp/`; returns their
        paths."""
        tokens = {"worker": self.identity.worker_token, "operator": self.identity.operator_token}
        paths: dict[Role, Path] = {}
        for role in ROLES:
            paths[role] = self.credentials / f"{role}.json"
            credentials.write(
                Credentials(
                    cluster=self.identity.cluster,
                    role=role,
                    endpoints=endpoints,
                    user=role,
                    password=self.identity.passwords[role],
                    token=tokens.get(role, ""),
                    insecure_tcp=insecure_tcp,
                ),
                paths[role],
            )
        return paths

    def write_passwords(self) -> None:
        """Writes the file that Zenoh's router reads."""
        lines = [f"{role}:{self.identity.passwords[role]}\n" for role in ROLES]
        write_atomically(self.passwords, "".join(lines).encode(), mode=0o600)

    def serving(self, ready: ReadyCluster) -> None:
        """Tells the coordinators of further local commands how to reach this one."""
        _write(self._lock_fd, msgspec.structs.replace(self._holder, ready=ready))

    def ended_workers(self) -> list[str]:
        """Names of the local workers that have ended: the kernel has freed their locks. Waits a few seconds for those
        whose command was killed, as they are ending."""
        late = time.monotonic() + _ENDED_S
        while True:
            locks = list((self.root / WORKERS).glob("[!.]*"))
            held = [lock for lock in locks if is_held(lock)]
            commands = [Path("/proc", lock.read_text()) for lock in held]
            if time.monotonic() > late or all(each.exists() for each in commands):
                return [lock.name for lock in locks if lock not in held]
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """Releases the folder for another coordinator."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.unlink()
                self._link.parent.rmdir()  # if it was the last
        os.ftruncate(self._lock_fd, 0)
        os.close(self._lock_fd)


def cluster_of(root: Path) -> str:
    """The name of a folder's cluster. Raises ConfigError as `StateFolder.open`."""
    _make_private(root)
    return identity_of(root).cluster


@contextlib.contextmanager
def held_folder(root: Path) -> Iterator[None]:
    """The folder, locked against others. Raises ConfigError as `StateFolder.open`."""
    _make_private(root)
    lock_fd = lock(root)
    try:
        yield
    finally:
        os.close(lock_fd)


def _make_private(root: Path) -> None:
    # A coordinator that restarts on a full disk waits for space.
    check_writable(root, "--state", may_be_full=(root / "identity.json").exists())
    try:
        root.mkdir(parents=True, mode=0o700, exist_ok=True)
        mode = stat.S_IMODE(root.stat().st_mode)
    except OSError as error:
        raise refused(error, f"cannot make state folder {root}: {error.strerror}") from error
    if mode & 0o077:
        raise ConfigError(
            f"state folder {root} may be entered by others (mode {mode:04o}); it holds hidden cases: chmod 700 {root}"
        )


def lock(root: Path, holder: Holder | None = None) -> int:
    """Locks the folder until the returned file descriptor is closed. Raises InUseError when it is in use."""
    fd = os.open(root / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    late = time.monotonic() + _WRITTEN_S
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            other = None
            with contextlib.suppress(*DECODE_ERRORS):
                other = msgspec.json.decode(os.pread(fd, _MOST_BYTES, 0), type=Holder)
            if other is not None or time.monotonic() > late:
                os.close(fd)
                raise InUseError(root, other) from error
            time.sleep(_LOOK_S)
        else:
            _write(fd, holder or Holder(process=os.getpid()))
            return fd


def _write(fd: int, holder: Holder) -> None:
    with contextlib.suppress(OSError):  # on a full disk no further command can join
        os.ftruncate(fd, 0)
        os.pwrite(fd, msgspec.json.encode(holder) + b"\n", 0)


def identity_of(root: Path) -> Identity:
    """The identity of a state folder, made for a new one. Raises ConfigError for a damaged one."""
    path = root / "identity.json"
    try:
        return msgspec.json.decode(path.read_bytes(), type=Identity)
    except FileNotFoundError:
        identity = Identity(
            cluster="local",
            passwords={role: secrets.token_urlsafe(24) for role in ROLES},
            worker_token=secrets.token_urlsafe(32),
            operator_token=secrets.token_urlsafe(32),
        )
        write_atomically(path, msgspec.json.encode(identity), mode=0o600)
        return identity
    except DECODE_ERRORS as error:
        raise ConfigError(f"{path} is damaged: {error}; restore it from a backup") from error


def _fits(folder: Path) -> bool:
    return len(os.fsencode(folder / _SOCKET)) <= _SOCKET_PATH_LIMIT


def _linked(root: Path) -> Path:
    """Returns a short link to `root`, always the same path, in a folder that only this user can change."""
    name = hashlib.sha256(os.fsencode(root)).hexdigest()[:16]
    places = (credentials.state_home() / "sockets", Path("/tmp") / f"evopolicy-{os.getuid()}")
    for folder in 2 * places:  # twice: another coordinator that ends may remove an empty one meanwhile
        link = folder / name
        with contextlib.suppress(OSError):
            if _fits(link):
                folder.mkdir(parents=True, mode=0o700, exist_ok=True)
                status = folder.lstat()
                if (
                    stat.S_ISDIR(status.st_mode)
                    and status.st_uid == os.getuid()
                    and not status.st_mode & 0o022
                ):
                    for other in folder.iterdir():  # of deleted state folders
                        if other.is_symlink() and not other.exists():
                            other.unlink(missing_ok=True)
                    new = folder / f"{name}.{os.getpid()}"
                    new.unlink(missing_ok=True)
                    new.symlink_to(root)
                    new.replace(link)
                    return link
    raise ConfigError(
        f"state folder {root} has too long a path for a unix socket; choose a shorter one with --state"
    )


def resolve_listen(endpoints: list[str]) -> tuple[str, ...]:
    """The endpoints with port 0 replaced by a free port: Zenoh does not report the port that it picks."""
    resolved = []
    for endpoint in endpoints:
        protocol, slash, address = endpoint.partition("/")
        if not slash or protocol not in ("tcp", "tls", "unixsock-stream"):
            raise ConfigError(f"--listen {endpoint!r}: use the form tls/HOST:PORT or tcp/HOST:PORT")
        if protocol == "unixsock-stream":
            resolved.append(endpoint)
            continue
        host, colon, port = address.rpartition(":")
        if not colon or not host or not port.isdecimal() or int(port) > 65535:
            raise ConfigError(
                f"--listen {endpoint!r}: use the form {protocol}/HOST:PORT, such as {protocol}/0.0.0.0:7447"
            )
        resolved.append(f"{protocol}/{host}:{port if int(port) else _free_port(endpoint, host)}")
    return tuple(resolved)


def _free_port(endpoint: str, host: str) -> int:
    bare = host.strip("[]")
    with raised_as(ConfigError, f"--listen {endpoint!r}", OSError):
        family, kind, _, _, address = socket.getaddrinfo(bare, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
            return int(probe.getsockname()[1])


def reachable(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """The endpoints that processes of this machine can connect to: wildcard addresses become loopback addresses."""
    return tuple(each.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for each in endpoints)
