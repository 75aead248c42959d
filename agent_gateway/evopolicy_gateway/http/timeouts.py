"""Timeouts of the HTTP service for slow clients, added to `uvicorn`'s protocol.

- A request's headers must arrive within `HEADERS_WAIT_S` of its first byte, those of the first request within
  `HEADERS_WAIT_S` of the connection.
- A client must resume reading an answer within `ANSWER_WAIT_S` after it has stopped.
- `service.BODY_WAIT_S` limits the body, and the server's keep-alive limits the pause between two requests.

A late client is disconnected without an answer.
"""

from __future__ import annotations

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADERS_WAIT_S = 20.0
ANSWER_WAIT_S = 60.0


class TimedProtocol(H11Protocol):
    """One connection."""

    _headers_timer: asyncio.TimerHandle | None = None
    _answer_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._start_headers_timer()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._start_headers_timer()
        else:
            self._stop_headers_timer()

    def on_response_complete(self) -> None:
        # Read before the next request, which may have arrived already, changes the state.
        unread = self.conn.their_state is h11.SEND_BODY
        super().on_response_complete()
        if unread:
            # The request has its answer, so the rest of its body will never be read.
            self.transport.close()
            self._start_headers_timer()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._answer_timer = self.loop.call_later(ANSWER_WAIT_S, self._cut_off)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stop_answer_timer()

    def timeout_keep_alive_handler(self) -> None:
        # A client that has not read its answer by now is not going to.
        if self.transport.get_write_buffer_size():
            self._cut_off()
        else:
            super().timeout_keep_alive_handler()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_headers_timer()
        self._stop_answer_timer()
        super().connection_lost(exc)

    def _cut_off(self) -> None:
        self.transport.abort()

    def _start_headers_timer(self) -> None:
        # Once per request: a client that sends single bytes gains no time.
        if self._headers_timer is None:
            self._headers_timer = self.loop.call_later(HEADERS_WAIT_S, self._cut_off)

    def _stop_headers_timer(self) -> None:
        if self._headers_timer is not None:
            self._headers_timer.cancel()
            self._headers_timer = None

    def _stop_answer_timer(self) -> None:
        if self._answer_timer is not None:
            self._answer_timer.cancel()
            self._answer_timer = None
