"""How long the HTTP service waits for a slow client: `uvicorn`'s protocol with a clock where that has none.

A request's headers must be there `HEADERS_WAIT_S` after its first byte, the first request as long after the connection, and
an answer must be read `ANSWER_WAIT_S` after the client has stopped reading. The body's time is `http.BODY_WAIT_S`, the pause
between two requests the server's keep-alive. Who is late is cut off without a word.
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
        # Asked before the next request, which may have arrived already, is begun.
        unread = self.conn.their_state is h11.SEND_BODY
        super().on_response_complete()
        if unread:
            # As much was read of a body whose request has its answer as ever will be.
            self.transport.close()
            self._start_headers_timer()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._answer_timer = self.loop.call_later(ANSWER_WAIT_S, self._cut_off)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stop_answer_timer()

    def timeout_keep_alive_handler(self) -> None:
        # What a client has not read by now, it does not want.
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
        # Once for each request: another byte now and then wins no time.
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
