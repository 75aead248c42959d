"""`--metrics ADDRESS`: serves a coordinator's `/metrics` and `/healthz` over HTTP, on the coordinator's event loop."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from evopolicy_common.errors import ConfigError
from evopolicy_common.wire.http import bound, serving
from evopolicy_coordinator.server.monitoring.metrics import CONTENT_TYPE, Meter


@contextlib.asynccontextmanager
async def metrics_server(address: str, meter: Meter, healthy: Callable[[], bool]) -> AsyncIterator[int]:
    """Serves inside the `async with`; yields the port.

    Raises ConfigError for an invalid address, or one that cannot be listened on.
    """
    host, colon, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or int(port) >= 1 << 16:
        raise ConfigError(f"--metrics {address!r}: use the form HOST:PORT, such as 127.0.0.1:9464")

    async def metrics(_: Request) -> Response:
        return Response(meter.text(), media_type=CONTENT_TYPE)

    async def health(_: Request) -> Response:
        return PlainTextResponse("ok\n") if healthy() else PlainTextResponse("no core is loaded\n", 503)

    app = Starlette(routes=[Route("/metrics", metrics), Route("/healthz", health)])
    try:
        sock = bound(host, int(port))
    except OSError as error:
        raise ConfigError(
            f"--metrics {address}: {error.strerror or error}; choose another address"
        ) from error
    number: int = sock.getsockname()[1]
    async with serving(app, sock):
        yield number
