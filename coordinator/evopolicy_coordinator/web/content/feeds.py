"""Updates of open pages as differences, shared by all browsers with the same page.

A page consists of parts, each an HTML element with an id, and of ordered lists of parts. A feed keeps the latest
content of each part and the version at which it changed. A browser that slept, or whose network is slow, requests the
changes since its own version: it misses nothing, and nothing is queued for it.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator, Callable
from typing import Any, TypeVar

import msgspec

from evopolicy_coordinator.web.content.rendering import View

T = TypeVar("T")

LEAST_PAUSE_S = 0.5
"""Between two updates of one browser."""
KEEP_ALIVE_S = 15.0
"""A comment is sent after this time without an update, so that dead connections are noticed."""
MAX_FEEDS = 512
"""Number of pages kept for browsers; pages without a browser are dropped first."""


class Feed:
    """The latest of one page."""

    def __init__(self) -> None:
        self.epoch = secrets.token_hex(4)
        """Versions of another feed, before a restart, mean nothing here."""
        self.version = 0
        self.watchers = 0
        self._parts: dict[str, tuple[int, str]] = {}
        self._lists: dict[str, tuple[int, tuple[str, ...]]] = {}
        self._changed = asyncio.Event()

    @property
    def cursor(self) -> str:
        """The cursor of a browser that has everything."""
        return f"{self.epoch}.{self.version}"

    def update(self, view: View) -> None:
        """Takes what has changed."""
        version = self.version + 1
        parts = {name: _newer(self._parts.get(name), html, version) for name, html in view.parts.items()}
        lists = {
            name: _newer(self._lists.get(name), tuple(order), version) for name, order in view.lists.items()
        }
        changed = any(each[0] == version for each in (*parts.values(), *lists.values()))
        self._parts, self._lists = parts, lists
        if changed:
            self.version = version
            event, self._changed = self._changed, asyncio.Event()
            event.set()

    def since(self, cursor: str) -> dict[str, Any] | None:
        """The changes since a cursor; everything for an unknown cursor; None without changes."""
        epoch, _, number = cursor.partition(".")
        known = int(number) if epoch == self.epoch and number.isdecimal() and len(number) < 16 else -1
        if known >= self.version:
            return None
        return {
            "parts": {name: html for name, (version, html) in self._parts.items() if version > known},
            "lists": {name: order for name, (version, order) in self._lists.items() if version > known},
        }

    async def events(self, cursor: str) -> AsyncIterator[bytes]:
        """Server-sent events from a cursor on, until the client closes the stream."""
        self.watchers += 1
        try:
            yield b"retry: 2000\n\n"
            while True:
                changed = self._changed
                found = self.since(cursor)
                if found is None:
                    try:
                        async with asyncio.timeout(KEEP_ALIVE_S):
                            await changed.wait()
                    except TimeoutError:
                        yield b": still here\n\n"
                    continue
                cursor = self.cursor
                yield b"id: %s\nevent: update\ndata: %s\n\n" % (cursor.encode(), msgspec.json.encode(found))
                await asyncio.sleep(LEAST_PAUSE_S)
        finally:
            self.watchers -= 1


def _newer(known: tuple[int, T] | None, content: T, version: int) -> tuple[int, T]:
    return known if known is not None and known[1] == content else (version, content)


class Feeds:
    """The feeds of all open pages, by the function that makes their view."""

    def __init__(self) -> None:
        self._feeds: dict[str, tuple[Feed, Callable[[], View]]] = {}

    def of(self, name: str, view: Callable[[], View], current: View | None = None) -> Feed:
        """The feed of a page; `view` makes its content, `current` is what it is now where that is known."""
        found = self._feeds.pop(name, None)
        feed = Feed() if found is None else found[0]
        self._feeds[name] = feed, view
        if current is not None:
            feed.update(current)
        for other in list(self._feeds):
            if len(self._feeds) <= MAX_FEEDS:
                break
            if other != name and not self._feeds[other][0].watchers:
                del self._feeds[other]
        return feed

    def watched(self) -> list[tuple[Feed, Callable[[], View]]]:
        """Those that a browser follows now."""
        return [each for each in self._feeds.values() if each[0].watchers]

    @property
    def watchers(self) -> int:
        """Browsers that follow a page."""
        return sum(feed.watchers for feed, _ in self._feeds.values())
