"""One step of the core: what one event, or one deadline, leads to.

Rule: whatever rows a step makes durable stand in a single `Persist` ahead of all its other effects, so no reply can tell
of something that a crash would take back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from evopolicy_common.messages.worker import Message, Refused
from evopolicy_common.wire.refusals import Refusal

from .effects import Effect, Log, Persist, Reply
from .events import RequestId
from .records import Row

if TYPE_CHECKING:
    from .queue import Lane


class Turn:
    """Collects the effects of one step, and what is to be looked at when it ends."""

    __slots__ = ("_out", "_rows", "dirty", "now", "stimulus_id", "stops")

    def __init__(self, now: float, stimulus_id: str) -> None:
        self.now = now
        self.stimulus_id = stimulus_id
        self._rows: list[Row] = []
        self._out: list[Effect] = []
        self.dirty: dict[Lane, None] = {}
        """Lanes in which something waits that did not before."""
        self.stops: dict[str, list[str]] = {}
        """Workers to the leases that they are to stop."""

    def persist(self, row: Row) -> None:
        """Make a row durable before anything else that this step does."""
        self._rows.append(row)

    def add(self, effect: Effect) -> None:
        """Let the shell do something once the rows are durable."""
        self._out.append(effect)

    def reply(self, request: RequestId, message: Message) -> None:
        """Answer a request."""
        self._out.append(Reply(request=request, message=message, stimulus_id=self.stimulus_id))

    def refuse(self, request: RequestId, status: Refusal, message: str) -> None:
        """Answer a request with the reason why it is not carried out."""
        self.reply(request, Refused(status=status, message=message))

    def log(self, level: Literal["debug", "info", "warning", "error"], event: str, **fields: Any) -> None:
        """Tell operators."""
        self._out.append(Log(level=level, event=event, fields=fields, stimulus_id=self.stimulus_id))

    def effects(self) -> list[Effect]:
        """All effects in order: the rows first."""
        if not self._rows:
            return self._out
        first: Effect = Persist(rows=tuple(self._rows), stimulus_id=self.stimulus_id)
        return [first, *self._out]
