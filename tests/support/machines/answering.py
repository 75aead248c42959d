"""A coordinator's listener that answers every key, and clients that are answered or not."""

from __future__ import annotations

import asyncio
import contextlib

from evopolicy_common.errors import TransportError
from evopolicy_common.wire import keys
from evopolicy_common.wire.credentials import Role
from evopolicy_common.wire.transport import IncomingQuery, Link
from machines.own_certs import CLUSTER

KEYS: dict[Role, str] = {
    "worker": keys.worker_key(CLUSTER, "lease"),
    "gateway": keys.gateway_key(CLUSTER, "run1", "state"),
    "operator": keys.operator_key(CLUSTER, "status"),
}
"""A key of each role."""


class Asked(list[str]):
    """The keys that a listener was asked; as `on_queries` it answers them."""

    def __call__(self, queries: list[IncomingQuery]) -> None:
        for query in queries:
            self.append(query.key)
            query.reply(b"coordinator")


async def answered(link: Link, key: str, timeout_s: float = 20.0, attempts: int = 1) -> bool:
    """Whether the coordinator answers; more attempts where a router may not have reached it yet."""
    for attempt in range(attempts):
        if attempt:
            await asyncio.sleep(0.1)
        with contextlib.suppress(TransportError):
            return await link.query(key, b"?", timeout_s) == b"coordinator"
    return False
