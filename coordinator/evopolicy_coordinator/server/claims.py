"""Claims decide which host plays which run of a sweep.

Rules:
- A claim has one holder until it expires, is given back, or is settled. A settled claim stays settled.
- A host that has a result settles the claim, whoever holds it: a coordinator that was started on an earlier backup may
  have granted it once more.
- The holder and the result are on disk before the reply. The expiry time is not: after a restart every holder gets
  its full time again, so the coordinator's downtime costs no host its claim.
- A holder that requests its claim again, also after its own restart, keeps it.
"""

from __future__ import annotations

import asyncio
import secrets
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, DamagedStoreError
from evopolicy_common.messages.operator import Claim, ClaimState
from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.server.request_checks import require
from evopolicy_coordinator.storage.store import Store, unreadable
from evopolicy_coordinator.storage.writer import Writer

MAX_TTL_S = 3600.0
_MAX_NAME = 300
_MAX_RESULT_BYTES = 1 << 16


class ClaimRow(msgspec.Struct, frozen=True, kw_only=True):
    holder: str
    run: str = ""
    ttl_s: float = 0.0
    result: dict[str, Any] | None = None


_FREE = ClaimRow(holder="")
_rows = msgspec.msgpack.Decoder(ClaimRow)


class ClaimTable:
    """All claims; loaded from the store on the first request."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._rows: dict[tuple[str, str], ClaimRow] | None = None
        self._until: dict[tuple[str, str], float] = {}
        """Expiry of each held claim, Unix seconds."""
        self._one_at_a_time = asyncio.Lock()
        self._process = secrets.token_hex(8)

    async def answer_claim(self, message: Claim, now: float) -> ClaimState:
        """Takes, renews, gives back or settles a claim.

        Raises RefusedError for an invalid request, StorageError when the disk refuses.
        """
        _check(message)
        async with self._one_at_a_time:
            rows, key = await self._loaded(now), (message.suite, message.name)
            row = rows.get(key, _FREE)
            held = row.holder not in ("", message.holder) and self._until.get(key, 0.0) > now
            kept = row.holder == message.holder
            state = ClaimState(
                granted=False,
                holder=row.holder,
                run=row.run,
                kept=kept,
                coordinator=self._process,
                result=row.result,
            )
            if row.result is not None or (held and message.result is None):
                return state
            given_back = message.ttl_s <= 0.0 and message.result is None
            new = ClaimRow(
                holder="" if given_back else message.holder,
                run=message.run or row.run,
                ttl_s=message.ttl_s,
                result=message.result,
            )
            if new != rows.get(key):
                data = msgspec.msgpack.encode(new)
                await self._writer.call(lambda store: store.write_claim(*key, data))
                rows[key] = new
            self._until[key] = now + message.ttl_s
            previous = "" if kept else row.holder
            return msgspec.structs.replace(
                state, granted=not given_back, holder=new.holder, previous=previous, result=message.result
            )

    async def _loaded(self, now: float) -> dict[tuple[str, str], ClaimRow]:
        if self._rows is None:
            claims = await self._writer.call(Store.claims)
            self._rows = {(suite, name): _decoded(suite, name, data) for suite, name, data in claims}
            self._until = {key: now + row.ttl_s for key, row in self._rows.items()}
        return self._rows


def _decoded(suite: str, name: str, data: bytes) -> ClaimRow:
    try:
        return _rows.decode(data)
    except DECODE_ERRORS as error:
        raise DamagedStoreError(
            f"table claims, row (suite, name) = {suite, name}: {unreadable(error)}"
        ) from error


def _check(message: Claim) -> None:
    for name in ("suite", "name", "holder"):
        text = f"a claim's {name} has 1 to {_MAX_NAME} characters"
        require(1 <= len(getattr(message, name)) <= _MAX_NAME, Refusal.BAD_MESSAGE, text)
    text = f"ttl_s {message.ttl_s}: 0 to {MAX_TTL_S:g} seconds"
    require(0.0 <= message.ttl_s <= MAX_TTL_S, Refusal.BAD_MESSAGE, text)
    size = len(msgspec.msgpack.encode(message.result))
    require(size <= _MAX_RESULT_BYTES, Refusal.BAD_MESSAGE, "a claim's result is larger than 64 KiB")
