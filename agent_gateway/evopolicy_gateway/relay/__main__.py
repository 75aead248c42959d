"""The relay's process: `python -m evopolicy_gateway.relay FD`. FD is the listening socket; the order comes as a line on
stdin.

It prints events of `processes/child_messages.py` on stdout, and ends with its stdin.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import resource
import signal
import socket
import sys
from collections.abc import Awaitable, Callable

import msgspec

from evopolicy_common.cli.conventions import setup_logging
from evopolicy_common.wire.http import serving
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import AgentDoing, ModelBudgetSpent, Orders, StartRelay
from evopolicy_gateway.relay.limits import Used
from evopolicy_gateway.relay.service import Relay, RelaySetup
from evopolicy_gateway.relay.usage import Prices

_PR_SET_DUMPABLE = 4
_TELL_S = 60.0
"""Time between notes of the use so far, seconds."""
_DRAIN_S = 5.0
"""Time in which answers may still come, and be counted, after the run's end, seconds."""
MAX_MEMORY_BYTES = 1 << 30
"""Of the process: all that it may hold and one document that is read, with some space."""


async def tell(
    used: Used,
    prices: Prices | None,
    say: Callable[[str], None],
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> None:
    """Says how much was used so far, once a minute in which there were requests."""
    told = used.requests
    while True:
        await sleep(_TELL_S)
        if used.requests != told:
            told = used.requests
            cost = "" if prices is None else f", {used.cost(prices):,.2f} dollars"
            failed = f" ({used.failed:,} failed)" if used.failed else ""
            say(f"{told:,} requests{failed}, {used.usage.total:,} tokens{cost} so far")


async def _main(fd: int) -> None:
    orders = Orders()
    first = await orders.next()
    if not isinstance(first, StartRelay):
        return
    order = msgspec.convert(first.order, RelaySetup)

    def counted(note: str = "") -> None:
        used = relay.used
        tokens = used.recorded(order.prices) | {"requests": used.requests}
        child_messages.emit(AgentDoing(tokens=tokens, note=note))

    def spent(what: str) -> None:
        child_messages.emit(ModelBudgetSpent(what=what))

    relay = Relay(order, counted=counted, note=counted, spent=spent)
    counted()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, orders.end)
    async with serving(relay, socket.socket(fileno=fd)):
        # A stream that breaks off is no error of this program.
        logging.getLogger("uvicorn.error").disabled = True
        telling = asyncio.create_task(tell(relay.used, order.prices, counted))
        while await orders.next() is not None:
            pass
        telling.cancel()
    await relay.close(_DRAIN_S)


if __name__ == "__main__":
    # No other process of this user may read its memory, which has the key.
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY_BYTES, MAX_MEMORY_BYTES))
    setup_logging()
    asyncio.run(_main(int(sys.argv[1])))
