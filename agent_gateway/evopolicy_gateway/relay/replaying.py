"""Answers calls from a run's record in place of a provider, which is not asked.

A call takes the first unused one of the record whose canonical request has the same digest. One that has none ends
the replay: `DIFFERENCE` in the new record's folder then has the recorded request beside the new one.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import httpcore

from evopolicy_common.records.model_record import Pack, key_of, read_calls, request_of
from evopolicy_gateway.relay.canonical import canonical, difference
from evopolicy_gateway.relay.provider import Answer, Sent
from evopolicy_gateway.relay.recording import Cleaning, document_of

DIFFERENCE = "difference.txt"
_PIECE = 64 << 10


class Replayed:
    """The record of a run as a source of answers."""

    def __init__(self, folder: Path, clean: Cleaning, out: Path, differs: Callable[[str], None]) -> None:
        """`out`: where `DIFFERENCE` is written. `differs` is called with the first line of it. Raises ConfigError."""
        self._left = read_calls(folder)
        self._pack = Pack(folder)
        self._clean, self._out, self._differs = clean, out, differs

    async def close(self) -> None:
        self._pack.close()

    @contextlib.asynccontextmanager
    async def sent(self, sent: Sent) -> AsyncIterator[Answer]:
        api = sent.name
        request = canonical(api, self._clean(sent.body))
        digest = key_of(request)
        call = next((each for each in self._left if each.digest == digest and each.api == api), None)
        if call is None or call.left_out:
            why = f"answer {call.n} was not kept: {call.left_out}" if call else self._unmatched(api, request)
            if not (path := self._out / DIFFERENCE).exists():
                path.write_text(why + "\n")
            self._differs(why.partition("\n")[0])
            refusal = {"error": {"message": "the replay has ended", "type": "invalid_request_error"}}
            ended = {"content-type": "application/json", "x-should-retry": "false"}
            yield Answer(400, ended, _pieces(json.dumps(refusal).encode()))
            return
        self._left.remove(call)
        if not call.status:
            raise httpcore.NetworkError("no answer came when this was recorded")
        data = self._clean.restored(self._pack.get(call.answer))
        yield Answer(call.status, call.headers, _pieces(data, broken=call.broken))

    def _unmatched(self, api: str, request: bytes) -> str:
        expected = next((call for call in self._left if call.api == api), None)
        if expected is None:
            return f"a request to {api} comes after all that were recorded"
        recorded = request_of(self._pack, expected)
        return f"request {expected.n} to {api} differs:\n{difference(recorded, document_of(request))}"


async def _pieces(data: bytes, *, broken: bool = False) -> AsyncIterator[bytes]:
    for at in range(0, len(data), _PIECE):
        yield data[at : at + _PIECE]
    if broken:
        raise httpcore.ReadError("the answer broke off when this was recorded")
