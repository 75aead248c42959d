"""Workers whose registration was refused: remembered for a while, so that `evopolicy status` can tell why one is missing."""

from __future__ import annotations

from collections import OrderedDict

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.operator import TurnedAway
from evopolicy_common.messages.worker import Message, Refused, Register
from evopolicy_common.wire import codec

KEPT = 32
"""So many names; whoever knows the transport's password could make up any number."""
KEPT_S = 24 * 3600.0
_MAX_TEXT = 500


class RefusedWorkers:
    """The last refusals by the worker's name."""

    def __init__(self) -> None:
        self._last: OrderedDict[str, tuple[str, str, float]] = OrderedDict()

    def answered(self, key: str, payload: bytes, answer: Message, now: float) -> None:
        """Takes note of the answer to a request, if that was to register; a worker that was taken is forgotten here."""
        if not key.endswith("/work/register"):
            return
        try:
            asked = codec.decode(codec.worker_requests, payload)
        except ProtocolError:
            return
        if not isinstance(asked, Register):
            return
        name = asked.worker[:64]
        self._last.pop(name, None)
        if isinstance(answer, Refused):
            self._last[name] = (asked.host[:64], answer.message[:_MAX_TEXT], now)
            while len(self._last) > KEPT:
                self._last.popitem(last=False)

    def told(self, now: float) -> tuple[TurnedAway, ...]:
        """What is remembered, the oldest first."""
        return tuple(
            TurnedAway(worker=worker, host=host, why=why, ago_s=max(0.0, now - at))
            for worker, (host, why, at) in self._last.items()
            if now - at < KEPT_S
        )
