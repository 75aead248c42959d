"""The sandbox tiers and environments that work on this machine. Those that do not are tried again from time to time."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from typing import get_args

from evopolicy_common.errors import EvopolicyError, RefusedError
from evopolicy_common.logs import structlog
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.worker import REASON_CHARACTERS

log: structlog.stdlib.BoundLogger = structlog.get_logger()

RETRY_PAUSE_S, LONGEST_RETRY_PAUSE_S = 30.0, 600.0
"""Pause before what does not work is tried again; it doubles each time."""

Probe = Callable[[Tier], Awaitable[None]]
"""Starts a sandbox of a tier and ends it. Raises EvopolicyError or OSError when it does not start."""
Describe = Callable[[Sequence[str]], Awaitable[tuple[tuple[EnvironmentDescription, ...], dict[str, str]]]]
"""Describes environments; see `descriptions.describe_all`."""


class Capabilities:
    """Used by one asyncio loop."""

    def __init__(
        self,
        tiers: Collection[Tier],
        environments: Iterable[EnvironmentDescription],
        *,
        missing_tiers: Mapping[Tier, str] | None = None,
        undescribed: Iterable[str] = (),
        failed_environments: Mapping[str, str] | None = None,
        probe: Probe | None = None,
        describe: Describe | None = None,
    ) -> None:
        """`missing_tiers`: those that should work here and do not, with the reasons; they need `probe`. `undescribed`:
        shipped environments that are described once runs wait for them. `failed_environments`: those that could not be
        described, with the reasons. Both need `describe`."""
        self._tiers = set(tiers)
        self._missing_tiers = dict(missing_tiers or {})
        self._described = {each.env: each for each in environments}
        self._undescribed = list(undescribed)
        self._failed = dict(failed_environments or {})
        self._probe = probe
        self._describe = describe
        self._describing: asyncio.Task[None] | None = None

    @property
    def tiers(self) -> tuple[Tier, ...]:
        """The tiers that work, strongest first."""
        return tuple(tier for tier in get_args(Tier) if tier in self._tiers)

    @property
    def missing_tiers(self) -> dict[str, str]:
        """The tiers that should work and do not, with reasons as long as the coordinator accepts."""
        return {tier: why[: REASON_CHARACTERS["tier"]] for tier, why in self._missing_tiers.items()}

    @property
    def environments(self) -> tuple[EnvironmentDescription, ...]:
        """Of the environments that work."""
        return tuple(self._described.values())

    @property
    def undescribed(self) -> tuple[str, ...]:
        """Ids of the environments that are described on request."""
        return tuple(self._undescribed)

    @property
    def failed_environments(self) -> dict[str, str]:
        """All environments that failed, with reasons as long as the coordinator accepts; the log has them whole."""
        remaining, reasons = REASON_CHARACTERS["environments"], {}
        for env, why in self._failed.items():
            reasons[env] = why[: min(REASON_CHARACTERS["environment"], remaining)]
            remaining -= len(reasons[env])
        return reasons

    async def keep_trying(self, register: Callable[[], Awaitable[None]]) -> None:
        """Tries what does not work from time to time, and registers after each change. Runs until cancelled."""
        self._register = register
        pause_s = RETRY_PAUSE_S
        try:
            while True:
                await asyncio.sleep(pause_s)
                failing = bool(self._missing_tiers or self._failed)
                pause_s = min(2 * pause_s, LONGEST_RETRY_PAUSE_S) if failing else RETRY_PAUSE_S
                if self._missing_tiers and self._probe is not None:
                    await self._probe_tiers(self._probe)
                self._describe_soon(tuple(self._failed))
        finally:
            if self._describing is not None:
                self._describing.cancel()
                await asyncio.gather(self._describing, return_exceptions=True)

    def describe_wanted(self, wanted: Sequence[str]) -> None:
        """Describes those of these environments that are undescribed, in the background of `keep_trying`. Where no slot
        starts, they stay undescribed."""
        self._describe_soon([each for each in wanted if each in self._undescribed])

    def _describe_soon(self, env_ids: Sequence[str]) -> None:
        if env_ids and (self._describing is None or self._describing.done()):
            self._describing = asyncio.create_task(self._describe_now(env_ids))

    async def _describe_now(self, env_ids: Sequence[str]) -> None:
        assert self._describe is not None
        log.info("describing", environments=env_ids)
        try:
            descriptions, failed = await self._describe(env_ids)
        except (EvopolicyError, OSError) as error:
            log.error("environments are not described", environments=env_ids, why=str(error))
            return
        before = self._failed
        self._failed = {env: why for env, why in before.items() if env not in env_ids} | failed
        self._described |= {each.env: each for each in descriptions}
        self._undescribed = [each for each in self._undescribed if each not in env_ids]
        if descriptions or self._failed != before:
            await self._announce()

    async def _probe_tiers(self, probe: Probe) -> None:
        before = dict(self._missing_tiers)
        for tier in before:
            try:
                await probe(tier)
            except (EvopolicyError, OSError) as error:
                self._missing_tiers[tier] = str(error)
            else:
                del self._missing_tiers[tier]
                self._tiers.add(tier)
                log.info("sandbox tier works now", tier=tier)
        if self._missing_tiers != before:
            log_missing(self._missing_tiers)
            await self._announce()

    async def _announce(self) -> None:
        with contextlib.suppress(RefusedError):  # the lease loop meets the same refusal
            await self._register()


def log_missing(tiers: Mapping[Tier, str]) -> None:
    """Logs the sandbox tiers that do not work, with the reasons."""
    for tier, why in tiers.items():
        log.warning("sandbox tier does not work; it is tried again", tier=tier, why=why)
