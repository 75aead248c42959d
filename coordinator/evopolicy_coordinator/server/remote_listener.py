"""The session that other machines reach over TLS, separate from the one for this machine.

Rules:
- It has its own passwords and access rules. Credentials of this machine's processes are not valid here, and vice
  versa.
- Zenoh reads passwords, rules and certificates when it opens a session. So when a machine is issued or revoked, this
  session is closed, which cuts every link, and reopened. Machines that are still admitted reconnect within a second.
  No request is lost, as our clients retry all of them.
- If the session cannot be reopened (its port is not free yet), opening is retried until it succeeds.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from evopolicy_common.errors import ConfigError, TransportError
from evopolicy_common.logs import log
from evopolicy_common.wire import keys, transport
from evopolicy_common.wire.transport import IncomingQuery, Server
from evopolicy_coordinator.pki.machines import Machines

CHECK_S = 0.5
"""Interval between checks for issued or revoked machines."""
_PAUSE_S = 0.25


def declare_all(server: Server, cluster: str, on_liveliness: Callable[[str, bool], None]) -> None:
    """Declares the keys that a coordinator's session answers, and the liveliness tokens that it watches."""
    server.declare(keys.requests(cluster).values())
    server.watch_liveliness(keys.liveliness_key(cluster, "*"), on_liveliness)


@contextlib.asynccontextmanager
async def remote_listener(
    cluster: str,
    listen: tuple[str, ...],
    machines: Machines,
    on_queries: Callable[[list[IncomingQuery]], None],
    on_liveliness: Callable[[str, bool], None],
) -> AsyncIterator[None]:
    """Listens on these `tls/` endpoints inside the `async with`; without endpoints it does nothing.

    Raises ConfigError before `certs init`, TransportError when it cannot listen on an endpoint.
    """
    if not listen:
        yield
        return
    opened = asyncio.get_running_loop().create_future()

    async def keep() -> None:
        while True:
            try:
                seen, tls = machines.stamp(), machines.tls
                if tls is None:
                    raise ConfigError(
                        f"--listen {listen[0]}: no certificates yet; make them: evopolicy-coordinator certs init"
                    )
                machines.write_passwords()
                listed = [(machine.role, machine.identity) for machine in machines.admitted()]
                config = transport.server_config(cluster, listen, machines.passwords, listed, tls)
                async with transport.serve(config, on_queries) as server:
                    declare_all(server, cluster, on_liveliness)
                    if opened.done():
                        log.info("machines changed; listening again", machines=len(listed))
                    else:
                        opened.set_result(None)
                    while machines.stamp() == seen:  # noqa: ASYNC110 - another process changes the file
                        await asyncio.sleep(CHECK_S)
            except Exception as error:
                if not opened.done():
                    opened.set_exception(error)
                    return
                log.error("cannot listen for other machines; trying again", why=str(error))
                await asyncio.sleep(_PAUSE_S)

    keeping = asyncio.create_task(keep())
    try:
        await opened
        yield
    finally:
        keeping.cancel()
        with contextlib.suppress(asyncio.CancelledError, TransportError, ConfigError):
            await keeping
