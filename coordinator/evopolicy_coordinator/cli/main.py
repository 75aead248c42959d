"""`evopolicy-coordinator`: the process that owns budgets, hidden cases, queue, checkpoints and results."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from evopolicy_common.cli.conventions import State, setup_logging
from evopolicy_common.cli.frame import App, Version, run_app
from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.packages import checked_names
from evopolicy_common.records.blobs import announcing
from evopolicy_common.terminal import counted, say
from evopolicy_common.wire.credentials import ReadyCluster, default_state_dir
from evopolicy_coordinator.cli import certs as certs_cli
from evopolicy_coordinator.cli import doctor as doctor_cli
from evopolicy_coordinator.cli import epochs as epochs_cli
from evopolicy_coordinator.cli import router_config
from evopolicy_coordinator.cli import worlds as worlds_cli
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.server import process
from evopolicy_coordinator.server.process import CoordinatorOptions
from evopolicy_coordinator.storage.backup import back_up
from evopolicy_coordinator.storage.moving import move, move_blobs

app = App()
app.add_typer(certs_cli.app, name="certs")
app.add_typer(epochs_cli.app, name="epoch")
app.command(epilog="Example: evopolicy-coordinator identity --state /var/lib/evopolicy")(epochs_cli.identity)
app.command(
    "accept-worlds", epilog="Example: evopolicy-coordinator accept-worlds --state /var/lib/evopolicy"
)(worlds_cli.accept_worlds)
app.command(
    epilog="Example: evopolicy-coordinator doctor --store postgresql://evopolicy@db/evopolicy",
)(doctor_cli.doctor)
app.command(
    "router-config",
    epilog="Example: evopolicy-coordinator router-config berlin --folder router-berlin"
    " --installed-at /etc/evopolicy/router",
)(router_config.router_config)


@app.callback(
    invoke_without_command=True,
    epilog="Example: evopolicy-coordinator --listen tls/0.0.0.0:7447 --state /var/lib/evopolicy",
)
def serve(
    context: typer.Context,
    listen: Annotated[
        list[str] | None,
        typer.Option(
            help="Endpoint for other machines, such as tls/0.0.0.0:7447 (see `certs`; port 0: a"
            " free one); may be repeated. Default: only a socket in the state folder."
        ),
    ] = None,
    state: State = None,
    store: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="PostgreSQL database: postgresql://USER@HOST/DATABASE, with the password in"
            " ~/.pgpass. Default: the state folder's; SQLite for a new one.",
        ),
    ] = None,
    seal_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Share the cluster's secrets with standbys: they are kept in the PostgreSQL database, sealed with the"
            " key in this file (openssl rand -base64 32).",
        ),
    ] = None,
    blobs: Annotated[
        str | None,
        typer.Option(
            metavar="PLACE",
            help="Keep bundles, trajectories, and videos in an object store (s3://BUCKET/PREFIX, gs://, az://; keys"
            " come from environment variables) or another folder. Default: as the state folder says.",
        ),
    ] = None,
    direct_blobs: Annotated[
        bool,
        typer.Option(
            "--direct-blobs",
            help="Let workers and gateways read blobs from the object store, by addresses that name one blob each and"
            " end after a minute. Without it, and where they cannot reach it, the coordinator sends them.",
        ),
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of split files (see `evopolicy data`); default: cases derived from a"
            " secret in the state folder."
        ),
    ] = None,
    insecure_tcp: Annotated[
        bool,
        typer.Option(
            "--insecure-tcp",
            help="Allow tcp/ to other machines: tokens and results can then be read on the network.",
        ),
    ] = False,
    policy_package: Annotated[
        list[str] | None,
        typer.Option(help="Package that policies may import in addition to numpy; may be repeated."),
    ] = None,
    hidden_isolation: Annotated[
        Literal["related", "strict", "off"],
        typer.Option(
            help="Agents and train episodes that share no kernel with hidden episodes: those of"
            " runs that share a hidden case (related), all (strict), or none (off; run.json"
            " says `shared`)."
        ),
    ] = "related",
    hidden_wait: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="SECONDS",
            help="After hidden episodes of closed runs have waited this long, one machine starts"
            " no related agent until they are played.",
        ),
    ] = CoreSettings().hidden_wait_s,
    agent_wait: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="SECONDS",
            help="Cancel a run that is open this long after its agent's start, if hidden episodes"
            " of closed runs wait for the agent. Choose more than your agents' longest wall"
            " limit.",
        ),
    ] = CoreSettings().agent_wait_s,
    ready_file: Annotated[
        Path | None,
        typer.Option(
            hidden=True, help="When ready, write the addresses and credentials to this file, as JSON."
        ),
    ] = None,
    log_level: Annotated[
        Literal["debug", "info", "warning", "error"], typer.Option(help="Lowest level that is logged.")
    ] = "info",
    unjailed_agents: Annotated[
        bool,
        typer.Option(
            "--unjailed-agents",
            hidden=True,
            help="Agents may be able to read this state folder: give their runs cases of their own, and later"
            " runs new cases.",
        ),
    ] = False,
    local: Annotated[
        str | None,
        typer.Option(
            hidden=True,
            help="Options that the commands of a local cluster share, as JSON. While a coordinator with the same ones"
            " serves from this state folder, this one waits to take its place.",
        ),
    ] = None,
    trust_workers: Annotated[
        bool,
        typer.Option("--trust-workers", help="Accept unapproved environments that workers announce."),
    ] = False,
    _: Version = False,
) -> None:
    """Run the coordinator of a cluster.

    Workers and gateways connect to it with the credentials that it writes. It exits after SIGTERM or Ctrl-C, and
    continues when it is started again on the same folder.
    """
    if context.invoked_subcommand is not None:
        return
    setup_logging(log_level)
    options = CoordinatorOptions(
        state=state or default_state_dir(),
        data=data,
        store=store,
        seal_key=seal_key,
        blobs=blobs,
        direct_blobs=direct_blobs,
        listen=tuple(listen or ()),
        insecure_tcp=insecure_tcp,
        allowed_packages=checked_names(policy_package),
        unjailed=unjailed_agents,
        trust_workers=trust_workers,
        local=None if local is None else msgspec.json.decode(local, type=dict[str, str]),
        core=CoreSettings(
            hidden_isolation=hidden_isolation,
            hidden_wait_s=hidden_wait,
            agent_wait_s=agent_wait,
        ),
    )
    with announcing(ready_file) as announce:
        asyncio.run(_run(options, announce))


@app.command(epilog="Example: evopolicy-coordinator backup /backup/monday --state /var/lib/evopolicy")
def backup(
    target: Annotated[Path, typer.Argument(help="New folder for the backup.", show_default=False)],
    state: State = None,
) -> None:
    """Copy the state folder: a consistent database, blobs and keys. The coordinator may be running.

    To restore: stop the coordinator, put the backup in place of its state, start it again. Later episodes are then
    played again. Keep backups as private as the state: they hold the hidden cases.
    """
    copied = back_up(state or default_state_dir(), target)
    say(f"{copied.path}: database and {counted(copied.blobs, 'blob')}, {copied.bytes:,} bytes")


@app.command(
    "move",
    epilog="Example: evopolicy-coordinator move --to postgresql://evopolicy@db/evopolicy --state /var/lib/evopolicy",
)
def move_(
    to: Annotated[
        str | None,
        typer.Option(
            help="Move the rows: postgresql://USER@HOST/DATABASE of an empty database, or `sqlite`.",
            show_default=False,
        ),
    ] = None,
    blobs: Annotated[
        str | None,
        typer.Option(
            metavar="PLACE",
            help="Move the blobs: an object store's address (see `--blobs` of the coordinator), or a folder.",
            show_default=False,
        ),
    ] = None,
    state: State = None,
) -> None:
    """Move the rows of a stopped coordinator into PostgreSQL or back, and its blobs into an object store or back.

    The copy is read back and compared before the state folder names it. Keys stay in the folder.
    """
    if to is None and blobs is None:
        raise ConfigError("name the new place of the rows with --to, or that of the blobs with --blobs")
    root = state or default_state_dir()
    if to is not None:
        moved = move(root, to)
        n_rows = counted(sum(moved.rows.values()), "row")
        say(f"{n_rows} moved from {moved.source} to {moved.target}; journal head {moved.head}")
    if blobs is not None:
        say(f"{counted(move_blobs(root, blobs), 'blob')} moved to {blobs}")
    say("next: start the coordinator on the same state folder")


async def _run(options: CoordinatorOptions, announce: Callable[[bytes], None]) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)

    def on_ready(ready: ReadyCluster) -> None:
        endpoint = ready.endpoints[-1]
        command = (
            f"evopolicy-worker --env core16 --connect {endpoint} --credentials {ready.credentials['worker']}"
        )
        if endpoint.startswith("tls/"):
            command = f"evopolicy-coordinator certs issue worker NAME --state {ready.state}"
        say(f"ready: cluster {ready.cluster}, state {ready.state}; workers join with: {command}")
        announce(msgspec.json.format(msgspec.json.encode(ready)) + b"\n")

    await process.run(options, stop, on_ready)


def main() -> None:
    run_app(app)
