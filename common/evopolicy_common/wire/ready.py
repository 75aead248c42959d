"""Where a coordinator that serves can be reached: what its `--ready-file` holds."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec

from evopolicy_common.wire.credentials import Role

_LOOK_S = 0.02


class Ready(msgspec.Struct, frozen=True, kw_only=True):
    """A coordinator's whereabouts."""

    cluster: str
    endpoints: tuple[str, ...]
    """As processes of this machine dial them; those of `tls/`, which need certificates, come last."""
    credentials: dict[Role, str]
    """Paths of this machine's credentials files by role."""
    state: str
    note: str = ""
    """What its operator is to know of the cases of new runs; empty for nothing."""


async def read_ready(path: Path, failed: asyncio.Future[None]) -> Ready:
    """Waits for the file and reads it. `failed` ends only with an error, which is raised here when it comes first."""
    while not path.exists():
        if failed.done():
            failed.result()
        await asyncio.sleep(_LOOK_S)
    return msgspec.json.decode(path.read_bytes(), type=Ready)
