"""Descriptions of the environments that a worker offers: read from a cache, made at the start, or made on first use.

Rules:
- A description holds for one fingerprint: this software's code, the environment's definition, the versions of its
  packages, Python. The cache has the last description of each shipped environment whose fingerprint is known without
  making it. This process makes none: it has the worker's credentials and is in no jail.
- At the start a worker describes what does not ship, since operators approve it by its digest, and at most `AT_ONCE`
  shipped environments. It announces other shipped ones undescribed, and describes them once runs wait for them.
- An environment that cannot be described, or fails its try-out, is not offered. The worker announces the reason, goes
  on with the others, and tries it again from time to time.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import DECODE_ERRORS, SlotDiedError, StorageError, WorkerError
from evopolicy_common.logs import structlog
from evopolicy_common.messages import bounds
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.records.blobs import write_atomically
from evopolicy_worker.environments import registry
from evopolicy_worker.slots.slot import Slot

log: structlog.stdlib.BoundLogger = structlog.get_logger()

AT_ONCE = 16
MAX_BYTES = 1 << 20
"""Largest description; one message has those of all environments that a worker offers."""
TRIES = 5
PAUSE_S = 0.5


class Cache:
    """A folder with a file for each environment."""

    def __init__(self, code_version: str, folder: Path | None = None) -> None:
        """`code_version`: of this software. `folder`: the user's cache by default."""
        self._code = code_version
        self._folder = folder or cache_home() / "descriptions"

    def get(self, env_id: str) -> EnvironmentDescription | None:
        """The cached description, if it is still valid."""
        try:
            kept = _files.decode(self._path(env_id).read_bytes())
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


class _Kept(msgspec.Struct, frozen=True):
    key: str
    description: EnvironmentDescription


_files = msgspec.json.Decoder(_Kept)


def cache_home() -> Path:
    """Folder of this user's files that may be deleted at any time."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "evopolicy"


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


def _announceable(env_id: str, found: Sequence[EnvironmentDescription]) -> EnvironmentDescription:
    """The description, if messages can carry it. Raises WorkerError otherwise: third-party code made it, and the worker
    cannot register with it."""
    if [each.env for each in found] != [env_id]:
        raise WorkerError(f"environment {env_id}: its process described another one; correct the environment")
    (description,) = found
    for name, value in (
        ("observation_space", description.obs_space),
        ("action_space", description.action_space),
        ("definition", description.definition),
    ):
        try:
            bounds.check_plain(value)
        except ValueError as error:
            raise WorkerError(
                f"environment {env_id}, {name}: {error}; make it simpler by a wrapper"
            ) from error
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
