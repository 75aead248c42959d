"""Requests of an operator's command to the coordinator: opening and following runs, playing cases outside any run."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, EvopolicyError, RefusedError
from evopolicy_common.logs import log
from evopolicy_common.messages import operator as messages
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.processes.notices import notify_if_slow
from evopolicy_common.records.run_files import read_record
from evopolicy_common.refusals import WRONG_SETTINGS, Refusal
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.operator_client import TIMEOUT_S, WAIT_S, OperatorClient
from evopolicy_common.wire.transport import Link
from evopolicy_gateway.run_folder.layout import RunFolder, saved
from evopolicy_gateway.run_folder.locks import until_free

_AWAY = (Refusal.UNAVAILABLE,)


class Operations(OperatorClient):
    """An operator's client for runs. Raises ConfigError when the coordinator refuses because of settings."""

    def __init__(self, link: Link, opened: Callable[[str, Sequence[Path]], None] | None = None) -> None:
        """`opened`: as `LocalCluster.opened`; None for a cluster that was not started here."""
        super().__init__(link, own=opened is not None)
        self._opened = opened
        self._intended: dict[str, messages.CreateRun] = {}
        """The requests that opened runs, by run: a coordinator on an earlier backup opens them again."""

    def watched_by(self, run: str, locks: Sequence[Path]) -> None:
        """Declares that the run's agent is alive only while one of these locks is held."""
        if self._opened is not None:
            self._opened(run, locks)

    async def create(self, wanted: messages.CreateRun) -> messages.RunCreated:
        """Opens a run, perhaps again; the same key returns the same run. Raises ConfigError for refused settings."""
        message = msgspec.structs.replace(wanted, token=self._token)
        timeout_s = None if wanted.run else TIMEOUT_S
        try:
            created = await self._requests.until_answered(
                "create", message, messages.RunCreated, timeout_s=timeout_s, despite=_AWAY
            )
        except RefusedError as error:
            raise _settings_error(error) from error
        self._intended[created.run] = msgspec.structs.replace(wanted, run=created.run)
        return created

    async def wait(self, run: str) -> AsyncIterator[messages.RunProgress]:
        """Yields the run's progress, the finished run last; logs why the coordinator takes no changes."""
        trouble = ""
        while True:
            progress = await self._progress(run, WAIT_S)
            if progress.trouble not in ("", trouble):
                log.warning(progress.trouble)
            trouble = progress.trouble
            yield progress
            if progress.finished is not None:
                return

    async def phase(self, run: str) -> str | None:
        """The run's current phase, as `RunProgress.phase`; None when the cluster does not know the run."""
        with contextlib.suppress(RefusedError, ConfigError):
            return (await self._progress(run, 0.0)).phase
        return None

    async def phase_of(self, folder: RunFolder) -> str | None:
        """The phase of a folder's open run, opened again if the cluster has lost it; None when it cannot be."""
        wanted = saved(folder.intended, messages.CreateRun)
        self._intended[wanted.run] = wanted
        return await self.phase(wanted.run)

    async def end_lost(self, run: str) -> str | None:
        """Cancels a run that has ended if a coordinator on an earlier backup still has it open, so that it keeps no
        hidden episodes waiting. Returns its phase before; None when the cluster does not know it."""
        self._intended.pop(run, None)
        phase = await self.phase(run)
        if phase not in (None, "finished"):
            await self.cancel(run)
            await self.agent_gone(run)
        return phase

    async def _progress(self, run: str, wait_s: float) -> messages.RunProgress:
        message = messages.WaitRun(token=self._token, run=run, wait_s=wait_s)
        while True:
            try:
                return await self._requests.until_answered(
                    "wait", message, messages.RunProgress, wait_s=wait_s
                )
            except RefusedError as error:
                if error.status != Refusal.UNKNOWN_RUN or run not in self._intended:
                    raise
            log.warning(
                "the coordinator has lost the run, as after a restored backup; opening it again", run=run
            )
            await self.create(self._intended[run])

    async def claim(self, wanted: messages.Claim) -> messages.ClaimState:
        """Takes, renews, releases (`ttl_s` 0) or settles (`result`) a run of a sweep."""
        message = msgspec.structs.replace(wanted, token=self._token)
        return await self._requests.until_answered("claim", message, messages.ClaimState, despite=_AWAY)

    async def drop(self, folder: RunFolder) -> None:
        """Cancels the open run of a folder, so that it plays no more and its agent's permit ends.

        Waits for the agent of a killed command, which may still be ending. Does nothing without such a run, or when the
        cluster does not know it.
        """
        if folder.intended.exists():
            # The coordinator may have opened it, and the command was killed before it had the answer.
            wanted = saved(folder.intended, messages.CreateRun)
            try:
                run = wanted.run or (await self.create(wanted)).run
            except (ConfigError, RefusedError):
                return
        elif folder.run_json.exists():
            with contextlib.suppress(EvopolicyError):
                await self.end_lost(read_record(folder.root).run)
            return
        else:
            return
        with notify_if_slow(f"the agent of {folder.root} to end"):
            await until_free(folder.supervisor_lock, folder.root)
        with contextlib.suppress(EvopolicyError):
            await self.cancel(run)
            if not folder.listener.exists():
                await self.agent_gone(run)

    async def evaluate(
        self, message: messages.Evaluate | messages.Rescore
    ) -> AsyncGenerator[tuple[EpisodeOutcome | None, int, str], None]:
        try:
            async with contextlib.aclosing(super().evaluate(message)) as outcomes:
                async for one in outcomes:
                    yield one
        except RefusedError as error:
            raise _settings_error(error) from error


def find_credentials(connect: tuple[str, ...], file: Path | None) -> tuple[Credentials, Credentials]:
    """Returns the operator's and the gateways' credentials, from one folder. ConfigError names the places searched."""
    operator = credentials.find("operator", connect, file)
    beside = file if file is None or file.is_dir() else file.parent / "gateway.json"
    return operator, credentials.find("gateway", connect, beside)


def _settings_error(error: RefusedError) -> Exception:
    return ConfigError(error.message) if error.status in WRONG_SETTINGS else error
