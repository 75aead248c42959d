"""A coordinator's state folder with certificates, and machines' folders made from it, as `evopolicy-coordinator certs`
does."""

from __future__ import annotations

import datetime as dt
import socket
from pathlib import Path

import msgspec

from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials, MachineRole, Role
from evopolicy_coordinator.pki import machines

CLUSTER = "local"
DAYS = 30


def now() -> dt.datetime:
    return dt.datetime.now(dt.UTC).replace(microsecond=0)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class OwnCerts:
    """`root/state` with an authority, and `root/<role>-<name>` for each machine issued."""

    def __init__(self, root: Path, hosts: tuple[str, ...] = ("127.0.0.1", "localhost")) -> None:
        self.root = root
        self.state = root / "state"
        self.state.mkdir(parents=True, mode=0o700)
        self.endpoint = f"tls/127.0.0.1:{free_port()}"
        machines.init(self.state, CLUSTER, hosts, now(), DAYS, anew=False)

    def issue(
        self, role: MachineRole, name: str, made: dt.datetime | None = None, *, again: bool = False
    ) -> Path:
        """The folder of a machine, its certificate valid for a month from `made`."""
        folder = self.root / f"{role}-{name}"
        hosts = ("127.0.0.1",) if role == "router" else ()
        machines.issue(
            self.state,
            CLUSTER,
            role,
            name,
            (self.endpoint,),
            folder,
            made or now(),
            DAYS,
            hosts=hosts,
            again=again,
        )
        return folder

    def revoke(self, name: str) -> None:
        machines.revoke(self.state, name, now())


def of(folder: Path, role: Role = "worker", **changed: object) -> Credentials:
    """The credentials in a machine's folder, with some of them changed."""
    return msgspec.structs.replace(credentials.find(role, (), folder), **changed)
