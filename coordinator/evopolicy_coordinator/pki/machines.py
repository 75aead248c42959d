"""The machines of a cluster: `STATE/certs`, and the folders issued from it.

    STATE/certs/
      ca.pem, ca-key.pem                  the cluster's authority
      coordinator.pem, coordinator-key.pem
      machines.json                       every machine issued: password, token, and its certificate's serial number
      passwords                           the passwords of admitted machines, for Zenoh's router

Rules:
- A machine is `ROLE/NAME`: its certificate's common name and its user name. It has its own password and token, so
  that each machine can be revoked by itself.
- A revoked machine is in none of the coordinator's lists: neither in the passwords nor in the access rules. Its
  token, and sessions opened with it, are refused (also when a router stands between).
- Issuing a name again invalidates its earlier certificate and credentials.
- `machines.json` is reloaded whenever it changes, so that `certs issue` and `certs revoke` need no restart.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import fcntl
import hmac
import os
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, raised_as
from evopolicy_common.logs import log
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.wire import credentials, keys
from evopolicy_common.wire.credentials import Credentials, MachineRole, Role, TlsFiles
from evopolicy_coordinator.pki import certs

BESIDE: dict[MachineRole, tuple[Role, ...]] = {"operator": ("gateway",)}
"""Roles issued in the same folder: an operator's machine starts gateways, which get rights of their own."""


class Machine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    role: MachineRole
    name: str
    password: str
    token: str
    """Token of a worker or an operator; empty for a gateway, which has its run's capability instead."""
    serial: str
    """The certificate's serial number: unique, so it also distinguishes successive issues of a name."""
    issued: dt.datetime
    expires: dt.datetime
    revoked: dt.datetime | None = None

    @property
    def identity(self) -> str:
        """The common name in the machine's certificate, and its user name."""
        return f"{self.role}/{self.name}"


class Machines:
    """The current machines of a state folder. Cheap to query: reads the file only when it has changed."""

    def __init__(self, state: Path) -> None:
        self.folder = state / "certs"
        self.passwords = self.folder / "passwords"
        """The file that Zenoh's session for other machines reads."""
        self._stamp: tuple[int, ...] = ()
        self._all: dict[str, Machine] = {}
        self._serials: dict[str, Machine] = {}

    @property
    def tls(self) -> TlsFiles | None:
        """The coordinator's own certificate; None before `certs init`."""
        key = "coordinator-key.pem"
        files = TlsFiles(root_ca="ca.pem", certificate="coordinator.pem", private_key=key)
        return files.within(self.folder) if (self.folder / key).exists() else None

    def all(self) -> tuple[Machine, ...]:
        """Every machine, including revoked ones, sorted by identity."""
        self._refresh()
        return tuple(self._all[identity] for identity in sorted(self._all))

    def admitted(self) -> tuple[Machine, ...]:
        """Machines that are not revoked. Expiry is left to TLS."""
        return tuple(machine for machine in self.all() if machine.revoked is None)

    def stamp(self) -> tuple[int, ...]:
        """A value that changes whenever a machine is issued or revoked, or the coordinator's certificate is renewed."""
        return (*_stat(self.folder / "machines.json"), *_stat(self.folder / "coordinator.pem"))

    def write_passwords(self) -> None:
        """Writes the file that Zenoh's router reads."""
        write_passwords(self.passwords, self.admitted())

    def holder(self, role: Role, token: str) -> Machine | None:
        """The admitted machine of this role with this token; compared in constant time."""
        mine = [machine for machine in self.admitted() if machine.role == role and machine.token]
        same = [each for each in mine if hmac.compare_digest(each.token.encode(), token.encode())]
        return same[-1] if same else None

    def session_for(self, token: str) -> str:
        """A new session for a worker that registers; it names the machine's certificate if the token is a machine's."""
        machine = self.holder("worker", token)
        made = secrets.token_urlsafe(16)
        return made if machine is None else f"{machine.serial}:{made}"

    def is_shut_out(self, session: str) -> bool:
        """Whether the session's machine has since been revoked, or issued again."""
        serial, colon, _ = session.partition(":")
        if not colon:
            return False
        self._refresh()
        machine = self._serials.get(serial)
        return machine is None or machine.revoked is not None

    def _refresh(self) -> None:
        path = self.folder / "machines.json"
        stamp = _stat(path)
        if stamp == self._stamp:
            return
        try:
            self._all = {machine.identity: machine for machine in _read(path)}
        except ConfigError as error:
            if not self._stamp:
                raise
            # A running coordinator continues with the machines that it knew.
            log.error("the list of machines cannot be read", why=str(error))
        self._serials = {machine.serial: machine for machine in self._all.values()}
        self._stamp = stamp


def write_passwords(path: Path, admitted: Iterable[Machine]) -> None:
    """Writes a router's file of passwords. Never an empty one: that would admit clients that name no user."""
    lines = [f"{machine.identity}:{machine.password}\n" for machine in admitted]
    lines.append(f"nobody:{secrets.token_urlsafe(24)}\n")
    write_atomically(path, "".join(lines).encode(), mode=0o600)


def init(
    state: Path, cluster: str, hosts: tuple[str, ...], now: dt.datetime, days: int, *, anew: bool
) -> None:
    """Makes the coordinator's certificate, and the authority if missing or `anew`, which removes all
    machines."""
    (state / "certs").mkdir(mode=0o700, exist_ok=True)
    with _changing(state) as folder:
        kept = not anew and (folder / "ca-key.pem").exists()
        authority = _authority(folder) if kept else certs.make_authority(cluster, now)
        own = certs.issue(authority, certs.COORDINATOR, now, days, hosts=hosts, serves=True)
        if not kept:
            _write(folder / "machines.json", b"[]")
            _write(folder / "ca-key.pem", authority.private_key)
            _write(folder / "ca.pem", authority.certificate)
        _write(folder / "coordinator-key.pem", own.private_key)
        # Last: a running coordinator watches this file.
        _write(folder / "coordinator.pem", own.certificate)


def issue(
    state: Path,
    cluster: str,
    role: MachineRole,
    name: str,
    endpoints: tuple[str, ...],
    out: Path,
    now: dt.datetime,
    days: int,
    *,
    hosts: tuple[str, ...] = (),
    again: bool = False,
) -> tuple[Machine, ...]:
    """Writes the folder `out` for a machine and admits it; everything issued to it before becomes invalid.

    Raises ConfigError for an invalid name, a name that was already issued unless `again`, a folder that is not empty,
    or before `init`.
    """
    if not keys.valid_name(name):
        raise ConfigError(f"NAME {name!r}: letters, digits, '.', '_' and '-' only, 63 at most")
    roles: tuple[MachineRole, ...] = (role, *BESIDE.get(role, ()))
    with _changing(state) as folder:
        authority = _authority(folder)
        listed = {machine.identity: machine for machine in _read(folder / "machines.json")}
        for old in (listed.get(f"{one}/{name}") for one in roles):
            if old is not None and not again:
                how = f"until {old.expires:%Y-%m-%d}" if old.revoked is None else "and revoked"
                raise ConfigError(
                    f"{old.identity} was issued already ({how}); --renew makes it a new folder and voids the old one"
                )
        made = [_make(authority, one, name, hosts, now, days) for one in roles]
        with raised_as(ConfigError, f"cannot make folder {out}", OSError):
            out.mkdir(parents=True, mode=0o700, exist_ok=True)
            if any(out.iterdir()) and not (again and (out / "ca.pem").exists()):
                raise ConfigError(f"{out} already contains files; name another folder with --out")
            out.chmod(0o700)
        for machine, pair in made:
            listed[machine.identity] = machine
            prefix = "" if machine.role == role else f"{machine.role}-"
            _write_folder(out, machine, pair, prefix, cluster, endpoints)
        _write(out / "ca.pem", authority.certificate)
        _write_machines(folder, listed)
    return tuple(machine for machine, _ in made)


def revoke(state: Path, name: str, now: dt.datetime) -> tuple[Machine, ...]:
    """Revokes the machine `ROLE/NAME`, or all roles of `NAME`. Raises ConfigError when there is no such machine."""
    with _changing(state) as folder:
        listed = {machine.identity: machine for machine in _read(folder / "machines.json")}
        meant = [machine for machine in listed.values() if name in (machine.name, machine.identity)]
        if not meant:
            known = ", ".join(sorted(listed)) or "none"
            raise ConfigError(f"no machine {name!r} was issued; there are: {known}")
        for machine in meant:
            if machine.revoked is None:
                listed[machine.identity] = msgspec.structs.replace(machine, revoked=now)
        _write_machines(folder, listed)
    return tuple(listed[machine.identity] for machine in meant)


def coordinators_certificate(state: Path) -> certs.CertFields | None:
    """The coordinator's own certificate; None before `init`."""
    try:
        return certs.describe((state / "certs" / "coordinator.pem").read_bytes())
    except FileNotFoundError:
        return None


def _make(
    authority: certs.KeyPair,
    role: MachineRole,
    name: str,
    hosts: tuple[str, ...],
    now: dt.datetime,
    days: int,
) -> tuple[Machine, certs.KeyPair]:
    common_name = f"{role}/{name}"
    if len(common_name) > 64:
        raise ConfigError(f"NAME {name!r} is too long: {common_name!r} has over 64 characters")
    pair = certs.issue(authority, common_name, now, days, hosts=hosts, serves=role == "router")
    described = certs.describe(pair.certificate)
    machine = Machine(
        role=role,
        name=name,
        password=secrets.token_urlsafe(24),
        token=secrets.token_urlsafe(32) if role in ("worker", "operator") else "",
        serial=described.serial,
        issued=now,
        expires=described.expires,
    )
    return machine, pair


def _write_folder(
    out: Path, machine: Machine, pair: certs.KeyPair, prefix: str, cluster: str, endpoints: tuple[str, ...]
) -> None:
    _write(out / f"{prefix}cert.pem", pair.certificate)
    _write(out / f"{prefix}key.pem", pair.private_key)
    if machine.role == "router":  # `router_config.py` writes its password into its zenohd's configuration
        return
    credentials.write(
        Credentials(
            cluster=cluster,
            role=machine.role,
            endpoints=endpoints,
            user=machine.identity,
            password=machine.password,
            token=machine.token,
            tls=TlsFiles(root_ca="ca.pem", certificate=f"{prefix}cert.pem", private_key=f"{prefix}key.pem"),
        ),
        out / f"{machine.role}.json",
    )


@contextlib.contextmanager
def _changing(state: Path) -> Iterator[Path]:
    """The folder of certificates, locked for one command at a time."""
    folder = state / "certs"
    if not folder.is_dir():
        raise ConfigError(
            f"{state} has no certificates yet: evopolicy-coordinator certs init --state {state}"
        )
    fd = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield folder
    finally:
        os.close(fd)


def _authority(folder: Path) -> certs.KeyPair:
    try:
        return certs.KeyPair((folder / "ca.pem").read_bytes(), (folder / "ca-key.pem").read_bytes())
    except FileNotFoundError as error:
        raise ConfigError(
            f"{folder.parent} has no certificate authority yet: evopolicy-coordinator certs init"
        ) from error


def _read(path: Path) -> list[Machine]:
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[Machine])
    except FileNotFoundError:
        return []
    except DECODE_ERRORS as error:
        raise ConfigError(f"{path} is damaged: {error}; restore it from a backup") from error


def _write_machines(folder: Path, listed: dict[str, Machine]) -> None:
    machines = [listed[identity] for identity in sorted(listed)]
    _write(folder / "machines.json", msgspec.json.format(msgspec.json.encode(machines)))


def _write(path: Path, data: bytes) -> None:
    write_atomically(path, data, mode=0o600)


def _stat(path: Path) -> tuple[int, ...]:
    try:
        status = path.stat()
    except FileNotFoundError:
        return (0, 0, 0)
    return (status.st_mtime_ns, status.st_ino, status.st_size)
