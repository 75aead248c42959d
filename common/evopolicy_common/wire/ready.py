"""The endpoints of a serving coordinator, as its `--ready-file` holds them."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec

from evopolicy_common.wire.credentials import Role

_LOOK_S = 0.02


class Ready(msgspec.Struct, frozen=True, kw_only=True):
    """How to reach a coordinator."""

    cluster: str
    endpoints: tuple[str, ...]
    """Endpoints for processes of this machine; those of `tls/`, which need certificates, come last."""
    credentials: dict[Role, str]
    """Paths of this machine's credentials files by role."""
    state: str
    note: str = ""
    """A note for the operator on the cases of new runs; empty for none."""


async def read_ready(path: Path, failed: asyncio.Future[None]) -> Ready:
    """Waits for the file and reads it. `failed` ends only with an error, which is raised here if it comes first."""
    while not path.exists():
        if failed.done():
            failed.result()
        await asyncio.sleep(_LOOK_S)
    return msgspec.json.decode(path.read_bytes(), type=Ready)
