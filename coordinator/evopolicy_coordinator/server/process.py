"""One coordinator process: opens all its parts in order and closes them in reverse.

The state folder is locked first and released last. Workers get no replies before the core is loaded.

Of several coordinators on one PostgreSQL database one leads. The others wait, and listen only when they lead. A leader
that another replaced, or that cannot reach the database for `core_host.LEAD_S`, closes its listeners and waits too.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, DamagedStoreError, LeadLostError, StorageError
from evopolicy_common.logs import log
from evopolicy_common.processes.packages import SIMULATORS
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.credentials import ReadyCluster
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.pki.identity import SIGNING_KEY
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.server.definitions import Definitions
from evopolicy_coordinator.server.reader import ServiceReader
from evopolicy_coordinator.server.remote_listener import declare_all, remote_listener
from evopolicy_coordinator.server.request_parser import RequestParser
from evopolicy_coordinator.server.run_requests import RunRequests
from evopolicy_coordinator.server.service import Service
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.splits import SplitSource, load_or_create_secret, secret_of
from evopolicy_coordinator.storage.engines import (
    BLOBS,
    ROWS,
    Place,
    checked_address,
    chosen_place,
    place_of,
    record_place,
)
from evopolicy_coordinator.storage.objects import ObjectBlobs, blobs_of, checked_blobs
from evopolicy_coordinator.storage.sealing import APPROVED, SharedFiles
from evopolicy_coordinator.storage.state_folder import (
    ROLES,
    InUseError,
    StateFolder,
    held_folder,
    reachable,
    resolve_listen,
)
from evopolicy_coordinator.storage.store import Store
from evopolicy_coordinator.worlds import JOURNAL

_JOINED = "another command's local cluster runs on this state folder: both share it and the slots of both"
_PAUSE_S = 0.1
"""Between attempts to lead, seconds."""


class CoordinatorOptions(msgspec.Struct, frozen=True, kw_only=True):
    state: Path
    data: Path | None = None
    """Folder of split files; None: derive the splits from the state folder's secret."""
    store: str | None = None
    """Address of a PostgreSQL database; None: as the state folder says, else SQLite."""
    seal_key: Path | None = None
    """File with the key that seals the secrets in the database; None: they are not shared."""
    blobs: str | None = None
    """Address of an object store, or a folder; None: as the state folder says, else its own."""
    direct_blobs: bool = False
    """Whether workers and gateways read from the object store."""
    listen: tuple[str, ...] = ()
    """Endpoints besides the unix socket in the state folder; port 0 picks a free port."""
    insecure_tcp: bool = False
    """Whether to allow `tcp/` beyond this machine, where tokens and results can be read on the wire."""
    allowed_packages: tuple[str, ...] = ()
    """Packages that workers let policies import besides numpy; listed in `/info`."""
    unjailed: bool = False
    """Whether agents of its runs may read the state folder. Such runs play cases of their own; see
    `splits.secret_of`."""
    trust_workers: bool = False
    """Accept any environment definition that workers announce."""
    local: dict[str, str] | None = None
    """For a local cluster's coordinator: see `state_folder.Holder`."""
    core: CoreSettings = CoreSettings()


async def run(
    options: CoordinatorOptions, stop: asyncio.Event, on_ready: Callable[[ReadyCluster], None]
) -> None:
    """Serves until `stop` is set, then makes everything durable and returns.

    Raises ConfigError for wrong options or a folder that is in use, StorageError when the store cannot be read,
    TransportError when it cannot listen on an endpoint, PartFailedError when a part cannot continue.
    """
    if options.store is not None:
        checked_address(options.store)  # before anything is created
    place, why = chosen_place(options.state.absolute(), ROWS, options.store), ""
    shared = SharedFiles(options.state.absolute(), options.seal_key)
    if isinstance(place, str):
        with held_folder(options.state.absolute()):  # before the folder gets an identity of its own
            await asyncio.to_thread(shared.join, place)
    elif options.seal_key is not None:
        raise ConfigError(
            "--seal-key: a store in the state folder is not shared; name a database with --store"
        )
    opened = await _opened(options, stop, on_ready)
    if opened is None:
        return
    with contextlib.closing(opened) as state:
        machines = Machines(state.root)
        listen = _listen(state, options, machines)
        blobs = None if options.blobs is None else checked_blobs(options.blobs)
        where = chosen_place(state.root, BLOBS, blobs)
        while not stop.is_set():
            try:
                await _lead(options, state, (place, where), shared, machines, listen, stop, on_ready)
                break
            except DamagedStoreError:
                raise
            except StorageError as error:
                if not (why or isinstance(error, LeadLostError)):
                    raise
                if str(error) != why:
                    why = str(error)
                    log.warning("standby: waiting to lead", why=why)
            await _pause(stop)
    log.info("stopped; everything is on disk", state=str(state.root))


async def _opened(
    options: CoordinatorOptions, stop: asyncio.Event, on_ready: Callable[[ReadyCluster], None]
) -> StateFolder | None:
    """The state folder, None at `stop`. While another command's coordinator of the same local cluster has it, this one
    names that one as ready, and waits to take its place."""
    known = False
    while not stop.is_set():
        try:
            return StateFolder.open(options.state, options.local)
        except InUseError as error:
            ready = error.shared(options.local)
            if ready is not None and not known:
                known = True
                note = "; ".join(filter(None, (_JOINED, ready.note)))
                on_ready(msgspec.structs.replace(ready, note=note))
        await _pause(stop)
    return None


async def _pause(stop: asyncio.Event) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_PAUSE_S):
            await stop.wait()


async def _lead(
    options: CoordinatorOptions,
    state: StateFolder,
    places: tuple[Place, Place],
    shared: SharedFiles,
    machines: Machines,
    listening: tuple[tuple[str, ...], tuple[str, ...]],
    stop: asyncio.Event,
    on_ready: Callable[[ReadyCluster], None],
) -> None:
    """Serves while this coordinator leads, until `stop`. `places`: of rows and blobs. Raises LeadLostError when another
    one leads."""
    (place, where), (listen, remote) = places, listening
    async with contextlib.AsyncExitStack() as opened:
        if isinstance(place, str):
            await asyncio.to_thread(shared.join, place)  # while another one leads
        store = await asyncio.to_thread(Store, place, state.identity.operator_token)
        opened.callback(store.close)
        if isinstance(place, str):
            await asyncio.to_thread(lambda: shared.take_sealed(store.sealed()))
        secret, note = secret_of(state.root, unjailed=options.unjailed)
        if options.data is not None:
            note = ""
        elif note:
            log.warning(note)
        source = SplitSource(data=options.data, secret=secret, journal=state.root / JOURNAL)
        load_or_create_secret(
            state.root / SIGNING_KEY
        )  # now, so that every backup has it: runs are named from it
        record_place(state.root, ROWS, place)
        # Otherwise agents would wait for `silent_bar_s`, as a worker of an earlier command might still play.
        ended = [] if options.local is None else await asyncio.to_thread(state.ended_workers)
        if ended:
            store.forget_kernels(ended)
        for name in ended:
            (state.root / credentials.WORKERS / name).unlink()
        blobs = blobs_of(state.root, place, where, lambda: store.incarnation, direct=options.direct_blobs)
        if isinstance(blobs, ObjectBlobs) and where != place_of(state.root, BLOBS):
            await asyncio.to_thread(blobs.claim, state.identity.operator_token)
        record_place(state.root, BLOBS, where)
        blobs.drop_unfinished()
        uploads = Uploads()
        reader = ServiceReader(place, blobs, uploads, state.root)
        allowed = ("numpy", *options.allowed_packages)
        runs = RunRequests(reader, blobs, source, allowed_imports=allowed, denied_imports=SIMULATORS)
        definitions = Definitions(
            state.root / APPROVED,
            shipped=catalogue.digests(),
            trusting=options.trust_workers,
        )
        parser = RequestParser(state.identity, blobs, uploads, runs, machines, definitions)
        cluster = state.identity.cluster
        service = Service(cluster, store, reader, parser, options.core)
        opened.push_async_callback(service.stop)
        await service.start()
        if isinstance(place, str):
            service.host.shared = shared
            await service.host.share()
            watching = asyncio.create_task(service.host.watch_lead())
            opened.callback(watching.cancel)
        queries, liveliness = service.on_queries, service.on_liveliness
        # Other machines have a listener of their own.
        await opened.enter_async_context(remote_listener(cluster, remote, machines, queries, liveliness))
        state.write_passwords()
        endpoints = reachable(listen)
        files = state.write_credentials(endpoints, insecure_tcp=options.insecure_tcp)
        config = transport.server_config(cluster, listen, state.passwords, [(role, role) for role in ROLES])
        server = await opened.enter_async_context(transport.serve(config, queries))
        # While the sessions are still open: handled queries get their replies, all others are dropped.
        opened.push_async_callback(service.stop)
        declare_all(server, cluster, liveliness)
        credentials.publish(endpoints, state.credentials)
        opened.callback(credentials.withdraw, endpoints)
        ready = ReadyCluster(
            cluster=cluster,
            endpoints=(*endpoints, *reachable(remote)),
            credentials={role: str(path) for role, path in files.items()},
            state=str(state.root),
            note=note,
        )
        state.serving(ready)
        on_ready(ready)
        try:
            await _until(stop, service)
        except LeadLostError:
            store.abort()  # nothing waits for an operation in flight
            raise
        log.info("stopping")


async def _until(stop: asyncio.Event, service: Service) -> None:
    """Waits for `stop`. Raises PartFailedError as soon as the service cannot continue."""
    stopped = asyncio.create_task(stop.wait())
    waiting: set[asyncio.Future[Any]] = {stopped, service.host.failed}
    try:
        done, _ = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        for each in done:
            each.result()
    finally:
        stopped.cancel()


def _listen(
    state: StateFolder, options: CoordinatorOptions, machines: Machines
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the endpoints for this machine (with the state folder's socket if possible) and for others."""
    for endpoint in options.listen:
        if endpoint.startswith("tls/"):
            if machines.tls is None:
                raise ConfigError(
                    f"--listen {endpoint}: there are no certificates in {machines.folder}; make them first with"
                    f" evopolicy-coordinator certs init --state {machines.folder.parent}"
                )
        elif endpoint.startswith("tcp/") and not credentials.stays_on_machine(endpoint):
            if not options.insecure_tcp:
                raise ConfigError(
                    f"--listen {endpoint} would send tokens and results unencrypted; run `evopolicy-coordinator certs"
                    f" init` once and listen on {endpoint.replace('tcp/', 'tls/', 1)} (or, on a network that you"
                    " trust, add --insecure-tcp)"
                )
            log.warning(
                "tokens and results travel unencrypted; use a trusted network only", endpoint=endpoint
            )
    wanted = resolve_listen(list(options.listen))
    remote = tuple(endpoint for endpoint in wanted if endpoint.startswith("tls/"))
    listen = tuple(endpoint for endpoint in wanted if endpoint not in remote)
    try:
        return (state.socket_endpoint, *listen), remote
    except ConfigError as error:
        if not listen:
            raise
        log.warning("not listening on a unix socket", why=str(error))
        return listen, remote
