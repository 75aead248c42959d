"""The gateway's client of the coordinator: typed requests about one run.

Every request is repeated until it is answered, also across restarts of the coordinator, and until a coordinator that
has lost the run has it again. It is safe to repeat. The caller decides how to handle any other refusal.
"""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

import msgspec

from evopolicy_common.errors import RefusedError, TransportError
from evopolicy_common.logs import log
from evopolicy_common.messages import gateway as messages
from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.refusals import NOT_NOW, RUN_LOST
from evopolicy_common.wire import codec, keys
from evopolicy_common.wire.requests import Requester
from evopolicy_common.wire.transport import Link
from evopolicy_gateway.run_folder.listener import AgentPlace

RESULTS_WAIT_S = 10.0
"""How long the coordinator may hold a results request, seconds."""
HELD_WAIT_S = 1.0
"""The same while no episode of the submit runs, seconds. Short: the wait is given back to the agent's clock in time."""
RENEWAL_S = 5.0
"""Seconds between permit requests while the agent may be alive: an operator may have ended the permit by mistake."""
FIRST_PERMIT_WAIT_S = 3.0
"""Seconds after which the wait for a permit is shown."""
STATE_TIMEOUT_S = 1.0
_PAST_ALL = (1 << 31) - 1
"""A cursor beyond all results."""
LARGE_BYTES = 16 << 20
"""A larger recording is kept in a file."""


Wanted = TypeVar("Wanted")


class CoordinatorClient:
    """Client for one run. Its methods raise RefusedError for refusals that do not end by themselves, and blob requests
    for any."""

    def __init__(self, link: Link, run: str, scratch: Path | None = None) -> None:
        """`scratch`: folder of temporary files; None: the system's."""
        self._scratch = scratch
        self._sender = run, link.credentials.token
        self._requests: Requester[messages.GatewayReply] = Requester(
            link, partial(keys.gateway_key, link.credentials.cluster, run), codec.gateway_replies
        )

    async def open(self) -> messages.RunOpened:
        """Opens the run; returns everything that is fixed for it, and its state."""
        return await self._ask("open", messages.OpenRun(asks_permit=True), messages.RunOpened)

    async def permit(self, place: AgentPlace, on_wait: Callable[[str], None]) -> bool:
        """Returns True once the run's agent may be alive at `place`; calls `on_wait` with the reason while it waits."""
        wait_s = FIRST_PERMIT_WAIT_S
        while True:
            message = messages.RequestPermit(boot_id=place.boot_id, host=place.host, wait_s=wait_s)
            permit = await self._ask("permit", message, messages.Permit, wait_s=wait_s)
            if permit.granted:
                return True
            on_wait(permit.waits_for)
            wait_s = RESULTS_WAIT_S

    async def keep_permit(self, place: AgentPlace) -> None:
        """Renews the permit until cancelled, or until the coordinator accepts no more for this run."""

        def permit_lost(waits_for: str) -> None:
            log.warning("the agent's permit has ended; asking for another", waits_for=waits_for)

        with contextlib.suppress(RefusedError):
            while True:
                await asyncio.sleep(RENEWAL_S)
                await self.permit(place, permit_lost)

    async def state(self) -> messages.RunState | None:
        """Returns the run's current state; None when the coordinator does not answer within a second, or has lost the
        run."""
        question = self._signed(messages.StateRequest())
        try:
            async with asyncio.timeout(STATE_TIMEOUT_S):
                return await self._requests.once("state", question, messages.RunState)
        except (TransportError, TimeoutError):
            return None
        except RefusedError as error:
            if error.status not in RUN_LOST:
                raise
            return None

    async def upload(self, digest: str, data: bytes) -> None:
        await self._requests.upload(*self._sender, digest, data)

    async def submit(self, request: messages.Submit, after: int) -> messages.SubmitAccepted:
        """Requests an evaluation, as submit number `after`, from 0. The same request gets the same answer however often
        it is sent."""
        message = msgspec.structs.replace(request, after=after)
        return await self._ask("submit", message, messages.SubmitAccepted)

    async def results(self, submit_index: int, cursor: int, wait_s: float) -> messages.ResultsPage:
        """Returns the submit's results since `cursor`, within `wait_s` seconds; the page may be empty."""
        question = messages.ResultsRequest(submit_index=submit_index, cursor=cursor, wait_s=wait_s)
        return await self._ask("results", question, messages.ResultsPage, wait_s=wait_s)

    async def ended(self, submit_index: int) -> None:
        """Returns once the submit has ended."""
        while (await self.results(submit_index, _PAST_ALL, RESULTS_WAIT_S)).done is None:
            pass

    async def fetch(self, ref: BlobRef) -> bytes:
        """Returns the bytes that `ref` names, verified; large ones are in an unnamed temporary file."""
        if ref.inline is not None or ref.size <= LARGE_BYTES:
            return await self._requests.fetch(*self._sender, ref)
        with tempfile.TemporaryFile(dir=self._scratch) as file:
            await self._requests.download_to(file, *self._sender, ref.digest, ref.size)
            file.flush()
            return cast(bytes, memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))

    async def close(self, reason: str, agent: dict[str, object], after: int) -> None:
        """Closes the run to further submits than the `after` accepted ones. Call it only when the agent and all its
        children are gone."""
        message = messages.CloseRun(reason=reason, agent=agent, after=after)
        await self._ask("close", message, messages.RunClosed)

    def _signed(self, message: messages.FromGateway) -> messages.FromGateway:
        run, token = self._sender
        return msgspec.structs.replace(message, run=run, token=token)

    async def _ask(
        self, verb: str, message: messages.FromGateway, wanted: type[Wanted], *, wait_s: float = 0.0
    ) -> Wanted:
        return await self._requests.until_answered(
            verb, self._signed(message), wanted, wait_s=wait_s, despite=NOT_NOW | RUN_LOST
        )
