"""One coordinator process: everything opened in order, and closed in reverse.

The state folder is locked first and released last; workers are told nothing before the core is loaded.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path

import msgspec
import structlog

from evopolicy_common import credentials, keys, transport
from evopolicy_common.blobs import BlobStore
from evopolicy_common.credentials import Role
from evopolicy_common.errors import ConfigError
from evopolicy_coordinator.answers import Answers
from evopolicy_coordinator.core.settings import CoreSettings
from evopolicy_coordinator.intake import Intake
from evopolicy_coordinator.service import Service
from evopolicy_coordinator.splits import SplitSource, load_or_create_secret
from evopolicy_coordinator.state import ROLES, StateFolder, reachable, resolve_listen
from evopolicy_coordinator.store import Store

log: structlog.stdlib.BoundLogger = structlog.get_logger()

SIMULATORS = ("gymnasium", "gymnasium_robotics", "mujoco", "Box2D", "minigrid", "highway_env", "pygame")
"""What policies may not import: the workers' sandboxes do not show it to them."""


_LOOPBACK = ("tcp/127.", "tcp/localhost:", "tcp/[::1]:")


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """What a coordinator is started with."""

    state: Path
    data: Path | None = None
    """Folder of split files; None derives the splits from the state folder's secret."""
    listen: tuple[str, ...] = ()
    """Endpoints beside the unix socket in the state folder; port 0 takes a free one."""
    cluster: str | None = None
    allowed_packages: tuple[str, ...] = ()
    """What workers let policies import beside numpy; told in `/info`."""
    core: CoreSettings = CoreSettings()


class Ready(msgspec.Struct, frozen=True, kw_only=True):
    """Where a coordinator that serves can be reached; what `--ready-file` holds."""

    cluster: str
    endpoints: tuple[str, ...]
    """As processes of this machine dial them."""
    credentials: dict[Role, str]
    """Paths of the credentials files by role."""
    state: str


async def run(options: Options, stop: asyncio.Event, on_ready: Callable[[Ready], None]) -> None:
    """Serves until `stop` is set, then makes all durable and returns.

    Raises ConfigError for wrong options or a folder that is in use, StorageError when the store cannot be read,
    TransportError when an endpoint cannot be listened on.
    """
    with contextlib.ExitStack() as opened:
        state = StateFolder.open(options.state, options.cluster)
        opened.callback(state.close)
        source = SplitSource(data=options.data, secret=load_or_create_secret(state.root))
        listen = _listen(state, options.listen)
        store = Store(state.database)
        opened.callback(store.close)
        blobs = BlobStore(state.root / "blobs")
        blobs.drop_unfinished()
        intake = Intake(
            state.identity,
            blobs,
            source,
            allowed_imports=("numpy", *options.allowed_packages),
            denied_imports=SIMULATORS,
        )
        service = Service(state.identity.cluster, store, Answers(state.database, blobs), intake, options.core)
        try:
            await service.start()
            await _serve(state, listen, service, stop, on_ready)
        finally:
            await service.stop()
        log.info("stopped; everything is on disk", state=str(state.root))


async def _serve(
    state: StateFolder,
    listen: tuple[str, ...],
    service: Service,
    stop: asyncio.Event,
    on_ready: Callable[[Ready], None],
) -> None:
    cluster = state.identity.cluster
    state.write_passwords()
    endpoints = reachable(listen)
    files = state.write_credentials(endpoints)
    config = transport.server_config(cluster, listen, state.passwords, {role: role for role in ROLES})
    async with transport.serve(config, service.on_queries) as server:
        server.declare((keys.worker_expr(cluster), keys.gateway_expr(cluster), keys.operator_expr(cluster)))
        server.watch_liveliness(keys.liveliness_expr(cluster), service.on_liveliness)
        credentials.publish(endpoints, state.credentials)
        try:
            on_ready(
                Ready(
                    cluster=cluster,
                    endpoints=endpoints,
                    credentials={role: str(path) for role, path in files.items()},
                    state=str(state.root),
                )
            )
            await stop.wait()
            log.info("stopping")
        finally:
            credentials.withdraw(endpoints)
            # While the session is still open: what was handled is answered, everyone else is let go.
            await service.stop()


def _listen(state: StateFolder, wanted: tuple[str, ...]) -> tuple[str, ...]:
    """The state folder's socket, always, and what was asked for."""
    listen = resolve_listen(list(wanted))
    for endpoint in listen:
        if endpoint.startswith("tcp/") and not endpoint.startswith(_LOOPBACK):
            log.warning(
                "passwords and results travel in the clear; keep to a trusted network", endpoint=endpoint
            )
    try:
        return (state.socket_endpoint, *listen)
    except ConfigError as error:
        if not listen:
            raise
        log.warning("not listening on a unix socket", why=str(error))
        return listen
