"""Requests of operators' commands to the coordinator, for all rooms."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, AsyncIterator
from typing import Literal

from msgspec.structs import replace

from evopolicy_common.errors import BrokenEnvironmentError, EvopolicyError, RefusedError
from evopolicy_common.messages import operator as ops
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.status import FromOperator, StatusReply, StatusRequest, unfolded
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire.requests import Wanted, operator_requests
from evopolicy_common.wire.transport import Link

WAIT_S = 3.0
"""Duration of a long poll: the interval in which a command gets news."""
TIMEOUT_S = 10.0
"""Timeout of requests with an immediate reply; TransportError after it."""
DESCRIPTION_S, DESCRIPTION_PAUSE_S = 600.0, 0.5
"""How long, and with which pauses, a command waits until a worker has described an environment."""
_SENDER = "operator"


class OperatorClient:
    """One operator's link. Fills in the token of each message. Raises RefusedError where the coordinator refuses."""

    def __init__(self, link: Link, *, own: bool = False) -> None:
        """`own`: the command started this cluster; BrokenEnvironmentError then ends an evaluation."""
        self._token = link.credentials.token
        self.own = own
        self._requests = operator_requests(link)

    async def _ask(
        self, verb: str, message: FromOperator, wanted: type[Wanted], *, timeout_s: float | None = TIMEOUT_S
    ) -> Wanted:
        message = replace(message, token=self._token)
        return await self._requests.until_answered(verb, message, wanted, timeout_s=timeout_s)

    # The cluster.

    async def status(self, max_age_s: float = 0.0) -> StatusReply:
        """The cluster's status, made at most `max_age_s` seconds ago."""
        return unfolded(await self._ask("status", StatusRequest(max_age_s=max_age_s), StatusReply))

    async def environments(
        self,
    ) -> tuple[list[ops.OfferedEnvironment], dict[str, tuple[str, ...]], dict[str, dict[str, str]]]:
        """The offered environments; those described on first use, with the workers; those that failed, and
        why."""
        offered: list[ops.OfferedEnvironment] = []
        while True:
            message = ops.EnvironmentsRequest(cursor=len(offered))
            page = await self._ask("environments", message, ops.EnvironmentsReply)
            offered += page.environments
            if page.finished:
                return offered, page.undescribed, page.failed

    async def approve(self, env: str, digest: str) -> None:
        """Lets runs use this definition of an environment that does not ship."""
        await self._ask("approve", ops.ApproveEnvironment(env=env, digest=digest), ops.Done)

    async def set_worker(self, worker: str, state: Literal["active", "paused", "draining"]) -> None:
        await self._ask("worker", ops.SetWorker(worker=worker, state=state), ops.Done)

    async def describe(self, message: ops.DescribeEnvironment) -> ops.EnvironmentState:
        """Data for replaying a finished run's episodes. Waits for a worker that describes the environment now."""
        until = time.monotonic() + DESCRIPTION_S
        while True:
            reply = await self._ask("describe", message, ops.EnvironmentState)
            if not reply.awaited or time.monotonic() > until:
                return reply
            await asyncio.sleep(DESCRIPTION_PAUSE_S)

    # Runs.

    async def cancel(self, run: str) -> None:
        await self._ask("cancel", ops.CancelRun(run=run), ops.Done)

    async def agent_gone(self, run: str, boot_id: str = "") -> None:
        """Ends the permit of a run's agent that is no longer alive, or no longer on the kernel `boot_id`."""
        await self._ask("agent_gone", ops.AgentGone(run=run, boot_id=boot_id), ops.Done)

    async def repin(self, run: str, fingerprint_class: str, reason: str) -> None:
        """Lets a run continue with workers of another fingerprint class."""
        await self._ask(
            "repin",
            ops.RepinRun(run=run, fingerprint_class=fingerprint_class, reason=reason),
            ops.Done,
        )

    async def recorded(
        self, run: str, split: Split, submit_index: int, *, timeout_s: float | None = None
    ) -> AsyncIterator[EpisodeOutcome]:
        """Stored outcomes of a finished run, in order of arrival. Raises RefusedError for any other run."""
        cursor, finished = 0, False
        while not finished:
            message = ops.RecordedRequest(run=run, split=split, submit_index=submit_index, cursor=cursor)
            page = await self._ask("recorded", message, ops.EvaluationPage, timeout_s=timeout_s)
            cursor, finished = page.cursor, page.finished
            for outcome in page.outcomes:
                yield outcome

    # Publication.

    async def disclose(self, runs: tuple[str, ...]) -> None:
        """Makes the cases of finished runs public. Raises RefusedError while any run with the same secret is open."""
        await self._ask("disclose", ops.Disclose(runs=runs), ops.Done)

    async def journal(self) -> list[bytes]:
        entries: list[bytes] = []
        while True:
            page = await self._ask("journal", ops.JournalRequest(cursor=len(entries)), ops.JournalPage)
            entries += page.entries
            if page.finished:
                return entries

    async def opening(self, run: str) -> ops.RunOpening:
        """The committed document of a disclosed run."""
        return await self._ask("opening", ops.OpeningRequest(run=run), ops.RunOpening)

    async def sign(self, digest: str) -> ops.Signed:
        """The coordinator's signature of the manifest whose SHA-256 is `digest`."""
        return await self._ask("sign", ops.SignRequest(digest=digest), ops.Signed)

    # Episodes outside any run.

    async def further_cases(self, run: str, name: str, n: int) -> ops.FurtherCases:
        """`n` hidden cases for the re-score `name` of a finished run, disjoint from its splits."""
        return await self._ask("further", ops.FurtherCasesRequest(run=run, name=name, n=n), ops.FurtherCases)

    async def evaluate(
        self, message: ops.Evaluate | ops.Rescore
    ) -> AsyncGenerator[tuple[EpisodeOutcome | None, int, str], None]:
        """Yields outcomes as they arrive; every few seconds without one, yields what the evaluation waits for.

        Yields `(outcome, total, "")` or `(None, total, waits_for)`; `total` is the number of episodes. Cancels the
        evaluation when the caller stops before its end. Raises RefusedError when somebody else cancels it.
        """
        started = await self._ask("evaluate", message, ops.EvaluationStarted)
        token, name = self._token, started.evaluation
        cursor, finished = 0, False
        try:
            while not finished:
                poll = ops.EvaluationPoll(token=token, evaluation=name, cursor=cursor, wait_s=WAIT_S)
                page = await self._requests.until_answered("poll", poll, ops.EvaluationPage, wait_s=WAIT_S)
                cursor, finished = page.cursor, page.finished
                for outcome in page.outcomes:
                    yield outcome, page.total, ""
                if page.env_failure and self.own:
                    raise BrokenEnvironmentError(page.env_failure)
                if not page.outcomes:
                    yield None, page.total, page.waits_for
            # One that ended before this request has no number of episodes; an interrupted command cancelled it.
            if cursor < started.episodes:
                done = f"{cursor} of {started.episodes} episodes"
                text = f"an operator cancelled evaluation {name} after {done}; repeat the command"
                raise RefusedError(Refusal.RUN_CANCELLED, text)
        finally:
            if not finished:
                with contextlib.suppress(EvopolicyError):
                    await self._requests.once("cancel", ops.CancelRun(token=token, run=name), ops.Done)

    # Blobs.

    async def upload(self, digest: str, data: bytes) -> None:
        await self._requests.upload(_SENDER, self._token, digest, data)

    async def download(self, digest: str) -> bytes:
        """Downloads a blob and checks it against its digest."""
        return await self._requests.download(_SENDER, self._token, digest)

    async def fetch(self, ref: BlobRef) -> bytes:
        """The bytes that `ref` names, checked against the digest."""
        return await self._requests.fetch(_SENDER, self._token, ref)
