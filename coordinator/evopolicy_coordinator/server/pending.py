"""Queries that wait for their answer, by the number under which the core knows them.

Rules that this module owns: a query is answered or let go once; the numbers are never used again.
"""

from __future__ import annotations

import time

import msgspec

from evopolicy_common.wire.transport import IncomingQuery


class Pending(msgspec.Struct, frozen=True):
    """A query that waits for its answer."""

    query: IncomingQuery
    asker: str
    since: float
    """Monotonic time at which it was taken in, seconds."""


class PendingQueries:
    """Those of one service, oldest first."""

    def __init__(self) -> None:
        self._waiting: dict[int, Pending] = {}
        self._n = 0

    def admit(self, query: IncomingQuery, asker: str) -> int:
        """Lets a query wait; gives its number."""
        self._n += 1
        self._waiting[self._n] = Pending(query, asker, time.monotonic())
        return self._n

    def take(self, request: int | str) -> Pending | None:
        """The query, which waits no more and is the caller's to answer; None when it is gone."""
        return self._waiting.pop(request, None) if isinstance(request, int) else None

    def __contains__(self, request: int) -> bool:
        return request in self._waiting

    def __len__(self) -> int:
        return len(self._waiting)

    def let_go(self, older_than_s: float = 0.0) -> None:
        """Ends without an answer what has waited for so long; all, unless told otherwise."""
        for request, pending in list(self._waiting.items()):
            if time.monotonic() - pending.since < older_than_s:
                return
            pending.query.drop()
            del self._waiting[request]
