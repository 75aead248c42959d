"""`evopolicy-coordinator certs`: certificates for the coordinator and for every machine that joins it."""

from __future__ import annotations

import contextlib
import datetime as dt
import socket
from pathlib import Path
from typing import Annotated

import typer

from evopolicy_common.cli.conventions import State
from evopolicy_common.cli.frame import App
from evopolicy_common.console import table, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.terminal import counted, say
from evopolicy_common.wire.credentials import MachineRole, default_state_dir
from evopolicy_coordinator.pki import certs, machines
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.storage.state_folder import cluster_of

app = App(help="Certificates for the machines of a cluster.", no_args_is_help=True)

PORT = 7447
"""A coordinator's default address."""
DAYS = {"coordinator": 730, "machine": 398}
"""Validity of certificates."""
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


@app.command(epilog="Example: evopolicy-coordinator certs init --host coordinator.lab --host 10.0.0.5")
def init(
    state: State = None,
    host: Annotated[
        list[str] | None,
        typer.Option(
            help="Name or address at which other machines reach the coordinator; may be repeated."
            " Default: this machine's address and name."
        ),
    ] = None,
    renew: Annotated[
        bool,
        typer.Option("--renew", help="Renew the coordinator's certificate; those of machines stay valid."),
    ] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="Make a new authority too: the folders of all machines become invalid."),
    ] = False,
) -> None:
    """Make the cluster's certificate authority and the coordinator's certificate, in the state folder.

    The authority's key never leaves that folder: keep it, and its backups, as private as the hidden cases.
    """
    root = state or default_state_dir()
    name = cluster_of(root)
    old = machines.coordinators_certificate(root)
    if old is not None and not (renew or force):
        raise ConfigError(
            f"{root}/certs holds the coordinator's certificate already (for {', '.join(old.hosts)}, until"
            f" {old.expires:%Y-%m-%d}); --renew makes that anew, --force a new authority, which voids every"
            " machine's folder"
        )
    hosts = host or (old.hosts if old is not None else _own_hosts())
    machines.init(
        root, name, tuple(dict.fromkeys((*hosts, *_LOOPBACK))), _now(), DAYS["coordinator"], anew=force
    )
    made = _certificate(root)
    say(f"authority: {root}/certs/ca.pem{' (new: issue every machine again)' if force else ''}")
    say(f"coordinator: {', '.join(made.hosts)}, until {made.expires:%Y-%m-%d}")
    say(f"next: evopolicy-coordinator --listen tls/0.0.0.0:{PORT}{_state_option(state)}")
    say(f"and for each machine: evopolicy-coordinator certs issue worker NAME{_state_option(state)}")


@app.command(epilog="Example: evopolicy-coordinator certs issue worker gpu-7 --out ./gpu-7")
def issue(
    role: Annotated[MachineRole, typer.Argument(help="Role of the machine.", show_default=False)],
    name: Annotated[str, typer.Argument(help="The machine's name.", show_default=False)],
    state: State = None,
    out: Annotated[Path | None, typer.Option(help="New folder to write [./ROLE-NAME].")] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(help="For a router: name or address at which other machines reach it; may be repeated."),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Endpoint that the machine connects to; default: the coordinator's first --host, port {PORT}."
        ),
    ] = None,
    renew: Annotated[
        bool,
        typer.Option(
            "--renew", help="Replace the folder issued earlier under this name, which becomes invalid."
        ),
    ] = False,
) -> None:
    """Write the folder that a machine needs to join: certificates, key, user and password.

    Copy the folder to that machine (scp -rp) and name it with --credentials there. A running coordinator admits the
    machine within seconds. An operator's folder also starts gateways.
    """
    root = state or default_state_dir()
    usual = first_endpoint(root)  # first: it makes no folder of a wrong --state
    cluster, folder, endpoints = (
        cluster_of(root),
        out or Path(f"{role}-{name}"),
        tuple(connect or (usual,)),
    )
    made = machines.issue(
        root,
        cluster,
        role,
        name,
        endpoints,
        folder,
        _now(),
        DAYS["machine"],
        hosts=tuple(host or ()),
        again=renew,
    )
    say(
        f"{folder}: {' and '.join(one.identity for one in made)}, until {made[0].expires:%Y-%m-%d}"
        f" (a secret: scp -rp {folder} MACHINE:)"
    )
    if role == "worker":
        say(f"there: evopolicy-worker --env core16 --credentials {folder.name}")
    elif role == "operator":
        say(f"there: evopolicy run --env gym/acrobot --agent evolve --credentials {folder.name}")
    elif role == "router":
        say(f"next: evopolicy-coordinator router-config {name} --folder {folder}{_state_option(state)}")


@app.command(epilog="Example: evopolicy-coordinator certs revoke gpu-7")
def revoke(
    name: Annotated[str, typer.Argument(help="NAME for all its roles, or ROLE/NAME.", show_default=False)],
    state: State = None,
) -> None:
    """Revoke a machine's certificate. The coordinator closes its connections within seconds and refuses new ones.

    Other workers play the jobs that its worker holds. Revoke at your routers as well, where there are any.
    """
    gone = machines.revoke(state or default_state_dir(), name, _now())
    say(f"revoked: {', '.join(one.identity for one in gone)}")


@app.command("list", epilog="Example: evopolicy-coordinator certs list")
def list_(state: State = None) -> None:
    """List all issued certificates, with expiry date and revocation."""
    root = state or default_state_dir()
    own, issued, now = _certificate(root), Machines(root).all(), _now()
    shown = table("name", "role", "expires", "state")
    for name, role, expires, revoked in (
        (", ".join(own.hosts), "coordinator", own.expires, None),
        *((one.name, one.role, one.expires, one.revoked) for one in issued),
    ):
        valid = "expired" if expires <= now else f"{counted((expires - now).days, 'day')} left"
        state_now = valid if revoked is None else f"revoked {revoked:%Y-%m-%d}"
        shown.add_row(name, role, f"{expires:%Y-%m-%d}", state_now)
    terminal().print(shown)


def first_endpoint(root: Path) -> str:
    """The coordinator's address. Raises ConfigError before `certs init`."""
    host = _certificate(root).hosts[0]
    return f"tls/[{host}]:{PORT}" if ":" in host else f"tls/{host}:{PORT}"


def _certificate(root: Path) -> certs.CertFields:
    own = machines.coordinators_certificate(root)
    if own is None:
        raise ConfigError(f"{root} has no certificate authority yet: evopolicy-coordinator certs init")
    return own


def _own_hosts() -> list[str]:
    """This machine's address on the way out, if it has one, and its names."""
    hosts = []
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # on a datagram socket it sends nothing, and only selects the route
        hosts.append(str(probe.getsockname()[0]))
    for name in (socket.getfqdn(), socket.gethostname()):
        with contextlib.suppress(ConfigError):
            certs.general_name(name)
            hosts.append(name)
    return hosts


def _state_option(state: Path | None) -> str:
    return "" if state is None else f" --state {state}"


def _now() -> dt.datetime:
    return dt.datetime.now(dt.UTC).replace(microsecond=0)
