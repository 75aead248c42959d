"""Writes the configuration of a site's own Zenoh router, `zenohd`, from the coordinator's own rules.

A site's machines connect to its router, which connects to the coordinator. The router restricts the machines behind it
to their roles, as the coordinator does, because access rules see only the next neighbour.

    FOLDER/                      the router's folder, from `evopolicy-coordinator certs issue router NAME --out FOLDER`
      ca.pem, cert.pem, key.pem
      zenohd.json                the file for `zenohd --config`; holds the router's own password
      passwords                  of the machines that may connect to it, and of no others
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from evopolicy_common.cli.conventions import State
from evopolicy_common.errors import ConfigError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.terminal import say
from evopolicy_common.wire import transport
from evopolicy_common.wire.credentials import TlsFiles, default_state_dir
from evopolicy_coordinator.cli.certs import PORT, first_endpoint
from evopolicy_coordinator.pki import certs
from evopolicy_coordinator.pki.machines import Machines, write_passwords
from evopolicy_coordinator.storage.state_folder import cluster_of


def _nested(settings: Mapping[str, object]) -> dict[str, Any]:
    """Converts settings by key, such as `listen/endpoints`, to the tree of a configuration file."""
    tree: dict[str, Any] = {}
    for key, value in settings.items():
        *above, last = key.split("/")
        branch = tree
        for part in above:
            branch = branch.setdefault(part, {})
        branch[last] = value
    return tree


def router_config(
    name: Annotated[
        str, typer.Argument(help="The router's name, as in `certs issue router NAME`.", show_default=False)
    ],
    folder: Annotated[Path, typer.Option(help="The router's folder, which that command made.")],
    state: State = None,
    listen: Annotated[
        list[str] | None,
        typer.Option(help=f"Endpoint for the site's machines [tls/0.0.0.0:{PORT}]; may be repeated."),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Endpoint to connect to; default: the coordinator's first --host, port {PORT}; may be repeated."
        ),
    ] = None,
    admit: Annotated[
        list[str] | None,
        typer.Option(
            help="Machine to admit, such as worker/gpu-7; may be repeated. Default: all except routers."
        ),
    ] = None,
    installed_at: Annotated[
        Path | None, typer.Option(help="Path of the folder on the router's host, if it differs.")
    ] = None,
) -> None:
    """Write the configuration and passwords of a site's Zenoh router, from the coordinator's access rules.

    Repeat this, and restart zenohd, whenever a machine of the site is issued or revoked.
    """
    root = state or default_state_dir()
    upstream = tuple(connect or (first_endpoint(root),))
    known = {machine.identity: machine for machine in Machines(root).admitted()}
    own = known.get(f"router/{name}")
    if own is None:
        raise ConfigError(
            f"router/{name} is not admitted: evopolicy-coordinator certs issue router {name}"
            f" --host ITS_ADDRESS --out {folder}"
        )
    for identity in admit or ():
        if identity not in known:
            raise ConfigError(f"{identity!r} is not admitted; there are: {', '.join(known)}")
    if not (folder / "key.pem").exists():
        raise ConfigError(f"{folder} is not the folder of router/{name}: it has no key.pem")
    admitted = tuple(
        machine
        for machine in known.values()
        if (machine.identity in admit if admit else machine.role != "router")
    )
    there = (installed_at or folder).absolute()
    settings = transport.site_router_settings(
        cluster_of(root),
        tuple(listen or (f"tls/0.0.0.0:{PORT}",)),
        there / "passwords",
        [(machine.role, machine.identity) for machine in admitted],
        TlsFiles(root_ca="ca.pem", certificate="cert.pem", private_key="key.pem").within(there),
        upstream,
        certs.COORDINATOR,
        own.identity,
        own.password,
    )
    write_passwords(folder / "passwords", admitted)
    content = json.dumps(_nested(settings), indent=2).encode() + b"\n"
    write_atomically(folder / "zenohd.json", content, mode=0o600)
    say(f"{folder}/zenohd.json lets in: {', '.join(one.identity for one in admitted) or 'nobody'}")
    say(f"there: zenohd --config {there}/zenohd.json --rest-http-port none --adminspace-permissions none")
