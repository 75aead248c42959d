"""Remembers refused registrations for a while, so that `evopolicy status` can explain why a worker is missing."""

from __future__ import annotations

from collections import OrderedDict

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.status import TurnedAway
from evopolicy_common.messages.worker import Message, Refused, Register
from evopolicy_common.wire import codec

KEPT = 32
"""Maximum number of names: anyone with the transport's password could make up any number of them."""
KEPT_S = 24 * 3600.0
_MAX_TEXT = 500


class RefusedWorkers:
    """The last refusal of each worker, by name."""

    def __init__(self) -> None:
        self._last: OrderedDict[str, tuple[str, str, float]] = OrderedDict()

    def answered(self, key: str, payload: bytes, answer: Message, now: float) -> None:
        """Records the reply if the request was a registration: stores a refusal, and forgets the worker otherwise."""
        if not key.endswith("/work/register"):
            return
        try:
            request = codec.decode(codec.worker_requests, payload)
        except ProtocolError:
            return
        if not isinstance(request, Register):
            return
        name = request.worker[:64]
        self._last.pop(name, None)
        if isinstance(answer, Refused):
            self._last[name] = (request.host[:64], answer.message[:_MAX_TEXT], now)
            while len(self._last) > KEPT:
                self._last.popitem(last=False)

    def recent(self, now: float) -> tuple[TurnedAway, ...]:
        """The remembered refusals, oldest first."""
        return tuple(
            TurnedAway(worker=worker, host=host, why=why, ago_s=max(0.0, now - at))
            for worker, (host, why, at) in self._last.items()
            if now - at < KEPT_S
        )
