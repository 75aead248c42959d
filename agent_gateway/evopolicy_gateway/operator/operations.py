"""What an operator's command asks the coordinator: opening and following runs, playing cases outside any run."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import structlog

from evopolicy_common.errors import ConfigError, EvopolicyError, RefusedError
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.operator import (
    Claim,
    ClaimState,
    CreateRun,
    Evaluate,
    RunCreated,
    RunProgress,
    RunSettings,
    WaitRun,
)
from evopolicy_common.messages.worker import Message
from evopolicy_common.processes.notices import notify_if_slow
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.operator_client import TIMEOUT_S, WAIT_S, OperatorClient
from evopolicy_common.wire.refusals import WRONG_SETTINGS, Refusal
from evopolicy_common.wire.transport import Link
from evopolicy_gateway.operator.locks import until_free
from evopolicy_gateway.run.layout import OpenedRun, RunFolder, saved

T = TypeVar("T")

log: structlog.stdlib.BoundLogger = structlog.get_logger()

_UNAVAILABLE_PAUSE_S = 1.0


class Operations(OperatorClient):
    """An operator's link as runs need it: where settings are why the coordinator says no, it is a ConfigError."""

    def __init__(self, link: Link, opened: Callable[[str, Sequence[Path]], None] | None = None) -> None:
        """`opened`: as `LocalCluster.opened`; None for a cluster that is not ours."""
        super().__init__(link)
        self._opened = opened

    def watched_by(self, run: str, locks: Sequence[Path]) -> None:
        """The run's agent is alive only as long as one of these locks is held."""
        if self._opened is not None:
            self._opened(run, locks)

    async def create(self, settings: RunSettings, key: str) -> RunCreated:
        """Opens a run; the same key gives the same run."""
        message = CreateRun(token=self._token, key=key, settings=settings)
        try:
            return await self._once_available("create", message, RunCreated, timeout_s=TIMEOUT_S)
        except RefusedError as error:
            raise _settings_error(error) from error

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
        return await self._once_available("claim", message, ClaimState)

    async def _once_available(
        self, verb: str, message: Message, wanted: type[T], timeout_s: float | None = None
    ) -> T:
        """The answer, asked for again as long as the coordinator takes nothing new; says once why it does not."""
        told = ""
        while True:
            try:
                return await self._requests.until_answered(verb, message, wanted, timeout_s=timeout_s)
            except RefusedError as error:
                if error.status != Refusal.UNAVAILABLE:
                    raise
                if error.message != told:
                    log.warning(error.message)
                told = error.message
            await asyncio.sleep(_UNAVAILABLE_PAUSE_S)

    async def drop(self, folder: RunFolder) -> None:
        """Ends the run that a folder holds open, so that it is played no more and its agent's permit ends with it.

        The agent of a command that was killed may still be ending: that is waited for. Does nothing where there is none, or
        the cluster does not know it.
        """
        if not folder.opened.exists():
            return
        run = saved(folder.opened, OpenedRun).run
        with notify_if_slow(f"the agent of {folder.root} to end"):
            await until_free(folder.supervisor_lock, folder.root)
        with contextlib.suppress(EvopolicyError):
            await self.cancel(run)
            if not folder.listener.exists():
                await self.agent_gone(run)

    async def evaluate(
        self, message: Evaluate
    ) -> AsyncGenerator[tuple[EpisodeOutcome | None, int, str], None]:
        try:
            async with contextlib.aclosing(super().evaluate(message)) as told:
                async for one in told:
                    yield one
        except RefusedError as error:
            raise _settings_error(error) from error


def find_credentials(connect: tuple[str, ...], file: Path | None) -> tuple[Credentials, Credentials]:
    """The operator's credentials, and the gateways' that lie beside them. ConfigError says where it looked."""
    operator = credentials.find("operator", connect, file)
    beside = file if file is None or file.is_dir() else file.parent / "gateway.json"
    return operator, credentials.find("gateway", connect, beside)


def _settings_error(error: RefusedError) -> Exception:
    return ConfigError(error.message) if error.status in WRONG_SETTINGS else error
