"""Child processes of an operator's command that exchange the lines of `child_messages.py`; ending their orphans."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from evopolicy_common.processes import child_process
from evopolicy_common.processes.child_process import ChildProcess
from evopolicy_gateway.processes import trees as processes
from evopolicy_gateway.processes.child_messages import AnyEvent, Order, event_of, line


async def end_orphans() -> list[int]:
    """Ends children inherited from dead parents; returns the ids of survivors, which the kernel holds."""
    async with child_process.starting():
        return await asyncio.to_thread(processes.end_orphans, frozenset(child_process.live))


class Child(ChildProcess):
    """A running child, started with `talks=True`."""

    async def events(self) -> AsyncIterator[AnyEvent]:
        """Yields the child's events until it ends."""
        assert self._process.stdout is not None
        while data := await self._process.stdout.readline():
            yield event_of(data)

    async def tell(self, order: Order) -> None:
        """Sends an order; dropped when the child is gone."""
        stdin = self._process.stdin
        assert stdin is not None
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            stdin.write(line(order))
            await stdin.drain()
