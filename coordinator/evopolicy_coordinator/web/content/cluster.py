"""The coordinator's status for the pages, requested while a page is open.

Rules: at most one request at a time, and after each a pause of `_SHARE` times its cost in the coordinator, so any
number of browsers costs it a small fixed share of a core. Several views share a reply that is at most one pause old.
Without an open page, one request is sent every `_IDLE_S`.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import OrderedDict

from evopolicy_common.errors import EvopolicyError
from evopolicy_common.logs import log
from evopolicy_common.messages.status import RetriedJobs, StatusReply
from evopolicy_common.wire import transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.operator_client import OperatorClient

_LEAST_PAUSE_S = 1.0
_IDLE_S = 30.0
_SHARE = 60.0
_RETRY_S = 2.0
_RETRIES_OF_A_RUN = 100
_RETRIED_RUNS = 1000
STALE_S = 90.0
"""Age in seconds after which the last reply is no longer used."""


class ShownCluster:
    """The latest status of a cluster."""

    def __init__(self, credentials: Credentials) -> None:
        self.status: StatusReply | None = None
        self.trouble = ""
        """Why the coordinator does not answer; empty while it does."""
        self.operator: OperatorClient | None = None
        self.retries: OrderedDict[str, dict[RetriedJobs, None]] = OrderedDict()
        """Repeated jobs of each run, oldest first; the coordinator reports only each run's last ones."""
        self._pause_s = 0.0
        self._at = float("-inf")
        self._credentials = credentials
        self._wake = asyncio.Event()

    @property
    def is_known(self) -> bool:
        """Whether the status is recent enough to decide by."""
        return self.status is not None and time.monotonic() - self._at < STALE_S

    def wake(self) -> None:
        """A page is open: the next request does not wait for the idle pause."""
        self._wake.set()

    async def run(self) -> None:
        """Requests the status until it is cancelled; retries while the coordinator does not answer."""
        while True:
            try:
                async with transport.connect(self._credentials) as link:
                    self.operator = OperatorClient(link)
                    await self._ask_on(self.operator)
            except (EvopolicyError, TimeoutError) as error:
                self._failed(str(error))
            finally:
                self.operator = None
            await asyncio.sleep(_RETRY_S)

    async def _ask_on(self, operator: OperatorClient) -> None:
        while True:
            began = time.monotonic()
            try:
                status = await operator.status(self._pause_s)
            except EvopolicyError as error:
                # The link connects again by itself, after a pause.
                self._failed(str(error))
                await asyncio.sleep(_RETRY_S)
                continue
            cost_s = status.cost_s or time.monotonic() - began
            self.take_status(status)
            self._pause_s = min(_IDLE_S, max(_LEAST_PAUSE_S, _SHARE * cost_s))
            await asyncio.sleep(self._pause_s)
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_IDLE_S - self._pause_s):
                    await self._wake.wait()

    def take_status(self, status: StatusReply) -> None:
        self.status, self._at, self.trouble = status, time.monotonic(), ""
        for run in status.runs:
            if run.retries:
                kept = self.retries.setdefault(run.run, {})
                kept.update(dict.fromkeys(run.retries))
                for old in list(kept)[:-_RETRIES_OF_A_RUN]:
                    del kept[old]
                self.retries.move_to_end(run.run)
        while len(self.retries) > _RETRIED_RUNS:
            self.retries.popitem(last=False)

    def _failed(self, why: str) -> None:
        if not self.trouble:
            log.warning("the coordinator does not answer", why=why)
        self.trouble = why
