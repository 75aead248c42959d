"""The HTTP service's address, on loopback or at the operator's `Listener`; it stays the same after every restart."""

from __future__ import annotations

import asyncio
import secrets
import socket

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.preflight import LOOPBACK, no_loopback
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.wire.http import bound
from evopolicy_gateway.run_folder.layout import RunFolder, save, saved
from evopolicy_gateway.run_folder.listener import Listener
from evopolicy_gateway.workspace.agents_md import Urls, base_url, urls_below

_REBIND_TRIES = 20
_REBIND_PAUSE_S = 0.25


class Address(msgspec.Struct, frozen=True, kw_only=True):
    """A run's service address, kept across restarts."""

    host: str
    port: int
    token: str
    """128 random bits, hex: the first part of every path."""
    bearer: str = ""
    """256 random bits, hex, required in every request; empty on loopback without a `Listener`."""
    url: str = ""
    """URL for the agent; empty for `http://host:port`."""

    def urls(self) -> Urls:
        base = self.url or base_url(self.host, self.port)
        return urls_below(base, self.token, bearer=bool(self.bearer))


async def bind(folder: RunFolder) -> tuple[socket.socket, Address]:
    """A socket bound to the last start's port, or to a new one that is saved. ConfigError if taken."""
    if folder.service.exists():
        address = saved(folder.service, Address)
        for _ in range(_REBIND_TRIES):
            try:
                return bound(address.host, address.port), address
            except OSError as error:
                reason = error
            await asyncio.sleep(_REBIND_PAUSE_S)
        raise ConfigError(
            f"port {address.port} on {address.host}, which is the address of this run's agent, cannot be used:"
            f" {reason.strerror}; end what listens there and start the gateway again"
        )
    named, bearer = Listener(host=LOOPBACK, port=0), ""
    if folder.listener.exists():
        named, bearer = saved(folder.listener, Listener), secrets.token_hex(32)
    try:
        sock = bound(named.host, named.port)
    except OSError as error:
        if not bearer:
            raise ConfigError(no_loopback(error)) from error
        where = f"{named.host}:{named.port}"
        raise ConfigError(f"--http {where}: cannot listen there: {error.strerror or error}") from error
    token, port = secrets.token_hex(16), sock.getsockname()[1]
    address = Address(host=named.host, port=port, token=token, bearer=bearer, url=named.url)
    if bearer:
        write_atomically(folder.bearer, f"{bearer}\n".encode(), mode=0o600)
    save(folder.service, address)
    return sock, address
