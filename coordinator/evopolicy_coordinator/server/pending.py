"""Queries that wait for their reply, by the number under which the core knows them.

Rules that this module owns: a query is answered or dropped once; numbers are never reused.
"""

from __future__ import annotations

import time

import msgspec

from evopolicy_common.wire.transport import IncomingQuery


class Pending(msgspec.Struct, frozen=True):
    """A query that waits for its reply."""

    query: IncomingQuery
    asker: str
    since: float
    """Monotonic time of its arrival here, seconds."""


class PendingQueries:
    """The pending queries of one service, oldest first."""

    def __init__(self) -> None:
        self._waiting: dict[int, Pending] = {}
        self._n = 0

    def admit(self, query: IncomingQuery, asker: str) -> int:
        """Adds a query and returns its number."""
        self._n += 1
        self._waiting[self._n] = Pending(query, asker, time.monotonic())
        return self._n

    def take(self, request: int | str) -> Pending | None:
        """Removes and returns the query, which the caller must answer; None when it is gone."""
        return self._waiting.pop(request, None) if isinstance(request, int) else None

    def __contains__(self, request: int) -> bool:
        return request in self._waiting

    def __len__(self) -> int:
        return len(self._waiting)

    def let_go(self, older_than_s: float = 0.0) -> None:
        """Drops, without a reply, queries that have waited at least `older_than_s` seconds; by default all."""
        for request, pending in list(self._waiting.items()):
            if time.monotonic() - pending.since < older_than_s:
                return
            pending.query.drop()
            del self._waiting[request]
