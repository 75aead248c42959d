"""The sandbox tiers and environments that work on this machine, and the environments' descriptions.

Rules:
- Tiers and environments that do not work are announced with the reason, and tried again from time to time.
- A description holds for one fingerprint: this software's code, the environment's definition, the versions of its
  packages, Python. The cache has the last description of each shipped environment whose fingerprint is known without
  making it. This process makes none: it has the worker's credentials and is in no jail.
- At the start a worker describes the environments that do not ship, since operators approve them by their
  digest, and at most `AT_ONCE` shipped ones. It announces others undescribed, and describes them once runs
  wait for them.
- An environment that cannot be described, or fails its try-out, is not offered.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import platform
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import (
    DECODE_ERRORS,
    EvopolicyError,
    RefusedError,
    SlotDiedError,
    StorageError,
    WorkerError,
)
from evopolicy_common.logs import log
from evopolicy_common.messages import bounds
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.worker import REASON_CHARACTERS
from evopolicy_common.records.blobs import write_atomically
from evopolicy_worker.environments import registry
from evopolicy_worker.slots.slot import Slot

RETRY_PAUSE_S, LONGEST_RETRY_PAUSE_S = 30.0, 600.0
"""Pause before what does not work is tried again; it doubles each time."""
AT_ONCE = 16
MAX_BYTES = 1 << 20
"""Largest description; one message has those of all environments that a worker offers."""
TRIES = 5
PAUSE_S = 0.5


@dataclass
class Capabilities:
    """Used by one asyncio loop."""

    tiers: tuple[Tier, ...]
    """Those that work, strongest first."""
    environments: tuple[EnvironmentDescription, ...]
    """Of the environments that work."""
    missing_tiers: dict[Tier, str] = field(default_factory=dict)
    """Those that should work here and do not, with the reasons; they need `probe`."""
    undescribed: tuple[str, ...] = ()
    """Shipped environments that are described once runs wait for them; they need `describe`."""
    failed_environments: dict[str, str] = field(default_factory=dict)
    """Those that could not be described, with the reasons; they need `describe`."""
    probe: Callable[[Tier], Awaitable[None]] | None = None
    """Starts a sandbox of a tier and ends it. Raises EvopolicyError or OSError when it does not start."""
    describe: (
        Callable[[Sequence[str]], Awaitable[tuple[tuple[EnvironmentDescription, ...], dict[str, str]]]] | None
    ) = None
    """Describes environments; see `describe_all`."""
    _describing: asyncio.Task[None] | None = field(default=None, init=False)

    def reasons(self) -> tuple[dict[str, str], dict[str, str]]:
        """Why tiers and environments are missing, in the length that `Register` accepts; the log has them whole."""
        remaining, reasons = REASON_CHARACTERS["environments"], {}
        for env, why in self.failed_environments.items():
            reasons[env] = why[: min(REASON_CHARACTERS["environment"], remaining)]
            remaining -= len(reasons[env])
        longest = REASON_CHARACTERS["tier"]
        return {tier: why[:longest] for tier, why in self.missing_tiers.items()}, reasons

    async def keep_trying(self, register: Callable[[], Awaitable[None]]) -> None:
        """Tries what does not work from time to time, and registers after each change. Runs until cancelled."""
        self._register = register
        pause_s = RETRY_PAUSE_S
        try:
            while True:
                await asyncio.sleep(pause_s)
                failing = bool(self.missing_tiers or self.failed_environments)
                pause_s = min(2 * pause_s, LONGEST_RETRY_PAUSE_S) if failing else RETRY_PAUSE_S
                await self._probe_tiers()
                self._describe_soon(tuple(self.failed_environments))
        finally:
            if self._describing is not None:
                self._describing.cancel()
                await asyncio.gather(self._describing, return_exceptions=True)

    def describe_wanted(self, wanted: Sequence[str]) -> None:
        """Describes those of these environments that are undescribed, in the background of `keep_trying`. Where no slot
        starts, they stay undescribed."""
        self._describe_soon([each for each in wanted if each in self.undescribed])

    def _describe_soon(self, env_ids: Sequence[str]) -> None:
        if env_ids and (self._describing is None or self._describing.done()):
            self._describing = asyncio.create_task(self._describe_now(env_ids))

    async def _describe_now(self, env_ids: Sequence[str]) -> None:
        assert self.describe is not None
        log.info("describing", environments=env_ids)
        try:
            descriptions, failed = await self.describe(env_ids)
        except (EvopolicyError, OSError) as error:
            log.error("environments are not described", environments=env_ids, why=str(error))
            return
        before = self.failed_environments
        self.failed_environments = {env: why for env, why in before.items() if env not in env_ids} | failed
        self.environments += descriptions
        self.undescribed = tuple(each for each in self.undescribed if each not in env_ids)
        if descriptions or self.failed_environments != before:
            await self._announce()

    async def _probe_tiers(self) -> None:
        before = dict(self.missing_tiers)
        for tier in before:
            assert self.probe is not None
            try:
                await self.probe(tier)
            except (EvopolicyError, OSError) as error:
                self.missing_tiers[tier] = str(error)
            else:
                del self.missing_tiers[tier]
                self.tiers = tuple(each for each in get_args(Tier) if each in (*self.tiers, tier))
                log.info("sandbox tier works now", tier=tier)
        if self.missing_tiers != before:
            log_missing(self.missing_tiers)
            await self._announce()

    async def _announce(self) -> None:
        with contextlib.suppress(RefusedError):  # the lease loop meets the same refusal
            await self._register()


def log_missing(tiers: dict[Tier, str]) -> None:
    """Logs the sandbox tiers that do not work, with the reasons."""
    for tier, why in tiers.items():
        log.warning("sandbox tier does not work; it is tried again", tier=tier, why=why)


class _Kept(msgspec.Struct, frozen=True):
    key: str
    description: EnvironmentDescription


class Cache:
    """A folder with a file for each environment."""

    def __init__(self, code_version: str, folder: Path | None = None) -> None:
        """`code_version`: of this software. `folder`: one in the user's cache by default."""
        self._code = code_version
        home = os.environ.get("XDG_CACHE_HOME")
        cache = Path(home) if home else Path.home() / ".cache"
        self._folder = folder or cache / "evopolicy" / "descriptions"

    def get(self, env_id: str) -> EnvironmentDescription | None:
        try:
            kept = msgspec.json.decode(self._path(env_id).read_bytes(), type=_Kept)
        except (OSError, *DECODE_ERRORS):
            return None
        holds = kept.description.env == env_id and kept.key == self._key(env_id)
        return kept.description if holds else None

    def put(self, description: EnvironmentDescription) -> None:
        """Stores a description, if its validity can be checked later. An unwritable folder only costs time."""
        key = self._key(description.env)
        if not key:
            return
        data = msgspec.json.encode(_Kept(key=key, description=description))
        with contextlib.suppress(OSError, StorageError):
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            write_atomically(self._path(description.env), data, mode=0o600, durable=False)

    def _path(self, env_id: str) -> Path:
        return self._folder / f"{hashlib.sha256(env_id.encode()).hexdigest()[:32]}.json"

    def _key(self, env_id: str) -> str:
        """Of the fingerprint; empty where it is not known without making the environment."""
        packages = registry.packages(env_id)
        if packages is None:
            return ""
        entry = msgspec.json.encode(catalogue.entry(env_id), order="sorted").decode()
        definition = f"{self._code}\n{platform.python_version()}\n{entry}\n{sorted(packages.items())}"
        return hashlib.sha256(definition.encode()).hexdigest()


def sorted_out(
    env_ids: Iterable[str], cache: Cache
) -> tuple[list[EnvironmentDescription], list[str], list[str]]:
    """The descriptions in the cache, the environments to describe now, and those to describe on first use."""
    cached = {env_id: cache.get(env_id) for env_id in env_ids}
    known = [each for each in cached.values() if each is not None]
    unknown = [env_id for env_id, each in cached.items() if each is None]
    shipped, others = (
        [env_id for env_id in unknown if catalogue.is_shipped(env_id) == ships] for ships in (True, False)
    )
    return (known, [*shipped, *others], []) if len(shipped) <= AT_ONCE else (known, others, shipped)


async def describe_all(
    env_ids: Sequence[str], slot: Slot, cache: Cache | None = None
) -> tuple[tuple[EnvironmentDescription, ...], dict[str, str]]:
    """Descriptions of environments, and by id the reasons why others have none. They are made in the slot, as this
    process must not import simulators. It stays started.

    Starts the slot again when its processes are killed meanwhile; at most `TRIES` attempts for each. Raises WorkerError
    when the slot does not start.
    """
    descriptions: list[EnvironmentDescription] = []
    failed: dict[str, str] = {}
    await _started(slot)
    for env_id in env_ids:
        try:
            description = await _described(env_id, slot)
        except WorkerError as error:
            log.error("an environment is not offered", env=env_id, why=str(error))
            failed[env_id] = str(error)
            await _started(slot)
            continue
        descriptions.append(description)
        if cache is not None:
            cache.put(description)
    return tuple(descriptions), failed


async def _described(env_id: str, slot: Slot) -> EnvironmentDescription:
    for tries_left in reversed(range(TRIES)):
        try:
            return _announceable(env_id, await slot.describe([env_id]))
        except SlotDiedError as error:
            if not tries_left:
                raise
            log.warning("an environment is not described yet; trying again", env=env_id, why=str(error))
            await asyncio.sleep(PAUSE_S)
            await _started(slot)
    raise AssertionError("unreachable")


def _announceable(env_id: str, described: Sequence[EnvironmentDescription]) -> EnvironmentDescription:
    """The description, if messages can carry it. Raises WorkerError otherwise: third-party code made it, and the worker
    cannot register with it."""
    if [each.env for each in described] != [env_id]:
        raise WorkerError(f"environment {env_id}: its process described another one; correct the environment")
    (description,) = described
    spaces = {"observation_space": description.obs_space, "action_space": description.action_space}
    for name, value in (*spaces.items(), ("definition", description.definition)):
        try:
            bounds.check_plain(value)
        except ValueError as error:
            why = f"environment {env_id}, {name}: {error}; make it simpler by a wrapper"
            raise WorkerError(why) from error
    size = len(msgspec.msgpack.encode(description))
    if size > MAX_BYTES:
        raise WorkerError(
            f"environment {env_id}: its description has {size:,} bytes, and {MAX_BYTES:,} are the limit; give elements"
            " of a Box the same bounds, or shorten the texts"
        )
    return description


async def _started(slot: Slot) -> None:
    for tries_left in reversed(range(TRIES)):
        try:
            return await slot.start()
        except WorkerError as error:
            if not tries_left:
                raise
            log.warning("a slot does not start; trying again", why=str(error))
            await asyncio.sleep(PAUSE_S)
    raise AssertionError("unreachable")
