"""The listener for other machines, where what it reads cannot be read."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from evopolicy_coordinator.server.remote_listener import remote_listener


class Unreadable:
    """Machines whose list cannot be looked at."""

    def stamp(self) -> Any:
        raise PermissionError("certs/machines.json")


async def test_a_list_of_machines_that_cannot_be_read_is_reported_at_once() -> None:
    listener = remote_listener("c", ("tls/h:1",), Unreadable(), print, print)  # type: ignore[arg-type]
    with pytest.raises(PermissionError, match=r"machines\.json"):
        async with asyncio.timeout(20), listener:
            pass
