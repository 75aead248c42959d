"""What an operator's command asks the coordinator: opening and following runs, playing cases outside any run."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import structlog

from evopolicy_common.errors import ConfigError, EvopolicyError, ProtocolError, RefusedError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.operator import (
    AgentGone,
    CancelRun,
    Claim,
    ClaimState,
    CreateRun,
    Done,
    Evaluate,
    EvaluationPage,
    EvaluationPoll,
    EvaluationStarted,
    RecordedRequest,
    RunCreated,
    RunProgress,
    RunSettings,
    WaitRun,
)
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.bundles import Bundle
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.refusals import WRONG_SETTINGS, Refusal
from evopolicy_common.wire.requests import operator_requests
from evopolicy_common.wire.transport import Link
from evopolicy_gateway.operator.alone import until_free
from evopolicy_gateway.run.layout import OpenedRun, RunFolder

WAIT_S = 3.0
"""Of a long poll: so often a command hears what it waits for."""
log: structlog.stdlib.BoundLogger = structlog.get_logger()

_PATIENCE_S = 10.0
_SENDER = "operator"
_UNAVAILABLE_PAUSE_S = 1.0


class Operations:
    """One operator's link. RefusedError where the coordinator says no, ConfigError where the settings are why."""

    def __init__(self, link: Link) -> None:
        self._token = link.credentials.token
        self._requests = operator_requests(link)

    async def create(self, settings: RunSettings, key: str) -> RunCreated:
        """Opens a run; the same key gives the same run."""
        message = CreateRun(token=self._token, key=key, settings=settings)
        told = ""
        while True:
            try:
                return await self._requests.until_answered(
                    "create", message, RunCreated, patience_s=_PATIENCE_S
                )
            except RefusedError as error:
                if error.status != Refusal.UNAVAILABLE:
                    raise _settings_error(error) from error
                told = _told(error, told)
            await asyncio.sleep(_UNAVAILABLE_PAUSE_S)

    async def wait(self, run: str) -> AsyncIterator[RunProgress]:
        """How far the run is, every few seconds; the last one holds the finished run."""
        while True:
            message = WaitRun(token=self._token, run=run, wait_s=WAIT_S)
            progress = await self._requests.until_answered("wait", message, RunProgress, wait_s=WAIT_S)
            yield progress
            if progress.finished is not None:
                return

    async def phase(self, run: str) -> str | None:
        """Where the run is now, as `RunProgress.phase`; None when the cluster does not know it."""
        message = WaitRun(token=self._token, run=run, wait_s=0.0)
        try:
            return (await self._requests.until_answered("wait", message, RunProgress, wait_s=0.0)).phase
        except RefusedError:
            return None

    async def claim(
        self,
        suite: str,
        name: str,
        holder: str,
        ttl_s: float,
        run: str = "",
        result: dict[str, Any] | None = None,
    ) -> ClaimState:
        """Takes, renews, gives back (`ttl_s` 0) or settles (`result`) a run of a sweep."""
        message = Claim(
            token=self._token, suite=suite, name=name, holder=holder, ttl_s=ttl_s, run=run, result=result
        )
        told = ""
        while True:
            try:
                return await self._requests.until_answered("claim", message, ClaimState)
            except RefusedError as error:
                if error.status != Refusal.UNAVAILABLE:
                    raise
                told = _told(error, told)
            await asyncio.sleep(_UNAVAILABLE_PAUSE_S)

    async def cancel(self, run: str) -> None:
        """Ends a run as it is. TransportError when nobody answers soon."""
        message = CancelRun(token=self._token, run=run)
        await self._requests.until_answered("cancel", message, Done, patience_s=_PATIENCE_S)

    async def agent_gone(self, run: str) -> None:
        """Ends the permit of a run's agent, which is no longer alive. TransportError when nobody answers soon."""
        message = AgentGone(token=self._token, run=run)
        await self._requests.until_answered("agent_gone", message, Done, patience_s=_PATIENCE_S)

    async def drop(self, folder: RunFolder) -> None:
        """Ends the run that a folder holds open, so that it is played no more and its agent's permit ends with it.

        The agent of a command that was killed may still be ending: that is waited for. Does nothing where there is none, or
        the cluster does not know it.
        """
        if not folder.opened.exists():
            return
        run = msgspec.json.decode(folder.opened.read_bytes(), type=OpenedRun).run
        await until_free(folder.keeper_lock, folder.root)
        with contextlib.suppress(EvopolicyError):
            await self.cancel(run)
            if not folder.door.exists():
                await self.agent_gone(run)

    async def upload(self, bundle: Bundle) -> None:
        """Brings a bundle to the coordinator."""
        await self._requests.upload(_SENDER, self._token, bundle.digest, bundle.packed)

    async def fetch(self, ref: BlobRef) -> bytes:
        """The bytes that `ref` names, checked."""
        if ref.inline is None:
            return await self._requests.download(_SENDER, self._token, ref.digest)
        if digest_of(ref.inline) != ref.digest:
            raise ProtocolError(f"blob {ref.digest} arrived damaged inside its message")
        return ref.inline

    async def download(self, digest: str) -> bytes:
        """A blob by its digest, checked."""
        return await self._requests.download(_SENDER, self._token, digest)

    async def recorded(self, run: str, split: Split, submit_index: int) -> AsyncIterator[EpisodeOutcome]:
        """Outcomes of a finished run as they were stored, in the order in which they came in.

        RefusedError for a run that is not finished, or not known any more.
        """
        cursor = 0
        while True:
            message = RecordedRequest(
                token=self._token, run=run, split=split, submit_index=submit_index, cursor=cursor
            )
            page = await self._requests.until_answered("recorded", message, EvaluationPage)
            cursor = page.cursor
            for outcome in page.outcomes:
                yield outcome
            if page.finished:
                return

    async def evaluate(self, message: Evaluate) -> AsyncIterator[tuple[EpisodeOutcome | None, int, str]]:
        """Each outcome as it comes, with the number of episodes in all; every few seconds without one, what it waits for.

        Yields `(outcome, total, "")` or `(None, total, waits_for)`. `message.token` may be empty; it is filled in.
        """
        asked = Evaluate(
            **{name: getattr(message, name) for name in message.__struct_fields__} | {"token": self._token}
        )
        try:
            started = await self._requests.until_answered(
                "evaluate", asked, EvaluationStarted, patience_s=_PATIENCE_S
            )
        except RefusedError as error:
            raise _settings_error(error) from error
        cursor = 0
        while True:
            poll = EvaluationPoll(
                token=self._token, evaluation=started.evaluation, cursor=cursor, wait_s=WAIT_S
            )
            page = await self._requests.until_answered("poll", poll, EvaluationPage, wait_s=WAIT_S)
            cursor = page.cursor
            for outcome in page.outcomes:
                yield outcome, page.total, ""
            if not page.outcomes:
                yield None, page.total, page.waits_for
            if page.finished:
                return


def find_credentials(connect: tuple[str, ...], file: Path | None) -> tuple[Credentials, Credentials]:
    """The operator's credentials, and the gateways' that lie beside them. ConfigError says where it looked."""
    operator = credentials.find("operator", connect, file)
    beside = file if file is None or file.is_dir() else file.parent / "gateway.json"
    return operator, credentials.find("gateway", connect, beside)


def _told(error: RefusedError, told: str) -> str:
    """Says once why a request is asked again and again."""
    if error.message != told:
        log.warning(error.message)
    return error.message


def _settings_error(error: RefusedError) -> Exception:
    return ConfigError(error.message) if error.status in WRONG_SETTINGS else error
