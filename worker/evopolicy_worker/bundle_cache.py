"""A cache of unpacked bundles by digest."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

from evopolicy_common.records.policies import bundles


class BundleCache:
    """A folder of unpacked bundles. Evicts the least recently used; a bundle in use is never removed."""

    def __init__(self, root: Path, fetch: Callable[[str], Awaitable[bytes]], limit: int = 64) -> None:
        """`fetch` returns a bundle's packed bytes by digest; `limit` is the number of bundles kept."""
        self._root = root
        self._fetch = fetch
        self._limit = limit
        self._ready: OrderedDict[str, asyncio.Task[Path]] = OrderedDict()
        self._users: Counter[str] = Counter()

    @property
    def warm(self) -> tuple[str, ...]:
        """Digests of the cached bundles, most recently used last."""
        return tuple(digest for digest, task in self._ready.items() if task.done())

    @contextlib.asynccontextmanager
    async def use(self, digest: str) -> AsyncIterator[Path]:
        """The bundle's folder, kept for the duration of the `async with`. Raises the errors of fetching and
        unpacking."""
        task = self._ready.get(digest)
        if task is None:
            task = self._ready[digest] = asyncio.create_task(self._bring(digest))
        self._ready.move_to_end(digest)
        self._users[digest] += 1
        try:
            try:
                # Shielded: another job with the same bundle may wait for the same fetch.
                folder = await asyncio.shield(task)
            except Exception:
                self._ready.pop(digest, None)
                raise
            yield folder
        finally:
            self._users -= Counter((digest,))
            await self._evict()

    async def _bring(self, digest: str) -> Path:
        bundle = bundles.load(await self._fetch(digest), digest)
        folder = self._root / digest
        await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
        await asyncio.to_thread(bundles.unpack, bundle, folder)
        return folder

    async def _evict(self) -> None:
        for digest in list(self._ready):
            if len(self._ready) <= self._limit:
                return
            task = self._ready[digest]
            if digest not in self._users and task.done():
                del self._ready[digest]
                await asyncio.to_thread(shutil.rmtree, self._root / digest, ignore_errors=True)
