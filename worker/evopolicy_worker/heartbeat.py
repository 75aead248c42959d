"""The heartbeat, sent from its own thread so that a busy event loop does not lose its leases."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable

from evopolicy_common.errors import ProtocolError, TransportError
from evopolicy_common.logs import log
from evopolicy_common.messages.worker import Heartbeat, HeartbeatReply, HeldLease, Refused
from evopolicy_common.wire import codec, keys
from evopolicy_common.wire.transport import Link

ANSWERED_PAUSE_S = 0.02
"""Minimum time between heartbeats. The coordinator repeats a cancellation, without delay, in each reply until the job
is reported."""
FAILED_PAUSE_S = 0.25


def clock() -> float:
    """Monotonic seconds, including the time the machine sleeps where the system has such a clock."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class HeartbeatThread:
    """Sends the held leases every `every_s` seconds and passes the replies to the event loop, which changes
    the leases.

    One heartbeat always waits at the coordinator, so that a cancellation arrives without delay.
    """

    def __init__(
        self,
        link: Link,
        worker: str,
        on_reply: Callable[[HeartbeatReply | Refused], None],
        on_failure: Callable[[BaseException], None],
    ) -> None:
        """Both callbacks run on the event loop that creates this object; `on_failure` when no further heartbeat can be
        sent."""
        self.held: dict[str, HeldLease] = {}
        """The leases that this worker holds, by id."""
        self.settled = time.time_ns() // 1_000_000
        """Number of the last finished poll: its leases, and those of all before, are or were in `held`.
        Begins above any number of an earlier process of this worker."""
        self._link = link
        self._key = keys.worker_key(link.credentials.cluster, "beat")
        self._worker = worker
        self._on_reply = on_reply
        self._on_failure = on_failure
        self._loop = asyncio.get_running_loop()
        self._session = ""
        self._every_s = 1.0
        self._answered_at = clock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self, session: str, every_s: float) -> None:
        """Starts the thread, or switches it to a new session after a new registration."""
        self._session, self._every_s = session, every_s
        if not self._thread.is_alive():
            self._thread.start()

    @property
    def silent_s(self) -> float:
        """Seconds since the last answered heartbeat was sent."""
        return clock() - self._answered_at

    def stop(self) -> None:
        """Stops sending. Does not wait for the reply to the pending heartbeat."""
        self._stop.set()

    def _run(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the worker is exiting
            try:
                self._beat_until_stopped()
            except Exception as error:
                self._loop.call_soon_threadsafe(self._on_failure, error)

    def _beat_until_stopped(self) -> None:
        last_sent = time.monotonic()
        pause = self._every_s
        while not self._stop.wait(pause):
            gap = time.monotonic() - last_sent
            if gap > 5 * self._every_s + 1.0:
                log.warning(
                    "this worker was frozen; its leases may have been given to others", frozen_s=round(gap, 1)
                )
            last_sent, sent_at = time.monotonic(), clock()
            reply = self._beat()
            if isinstance(reply, HeartbeatReply):
                self._answered_at = sent_at
                # The coordinator delays a reply without cancellations, so the next heartbeat can be sent at once.
                pause = ANSWERED_PAUSE_S if reply.cancelled else 0.0
            else:
                pause = FAILED_PAUSE_S
            if time.monotonic() - last_sent < ANSWERED_PAUSE_S:
                pause = max(pause, ANSWERED_PAUSE_S)
            if reply is not None:
                self._loop.call_soon_threadsafe(self._on_reply, reply)

    def _beat(self) -> HeartbeatReply | Refused | None:
        """Sends one heartbeat; None when it was not answered."""
        wait_s = self._every_s
        # In this order: the leases of that poll are there. The copy is one operation for other threads.
        settled, held = self.settled, tuple(self.held.copy().values())
        message = Heartbeat(
            worker=self._worker, session=self._session, held=held, wait_s=wait_s, settled=settled
        )
        try:
            answer = self._link.ask_blocking(
                self._key, codec.encode(message), wait_s + max(1.0, self._every_s)
            )
            reply = codec.decode(codec.worker_replies, answer)
        except (TransportError, ProtocolError) as error:
            log.debug("heartbeat unanswered", why=str(error))
            return None
        return reply if isinstance(reply, HeartbeatReply | Refused) else None
