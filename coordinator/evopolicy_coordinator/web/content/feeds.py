"""Updates of open pages as differences, shared by all browsers with the same page.

A page consists of parts, each an HTML element with an id, and of ordered lists of parts. A feed keeps the latest
content of each part and the version at which it changed. A browser that slept, or whose network is slow, requests the
changes since its own version: it misses nothing, and nothing is queued for it.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgspec

from evopolicy_results.html import View

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
        self._content: dict[tuple[str, str], tuple[int, Any]] = {}
        """By `parts` or `lists`, and the element's id: the version of its last change, and its content."""
        self._changed = asyncio.Event()

    @property
    def cursor(self) -> str:
        """The cursor of a browser that has everything."""
        return f"{self.epoch}.{self.version}"

    def update(self, view: View) -> None:
        """Takes what has changed."""
        now: dict[tuple[str, str], Any] = {("parts", name): html for name, html in view.parts.items()}
        now |= {("lists", name): tuple(order) for name, order in view.lists.items()}
        known = self._content
        changed = {
            key: (self.version + 1, now[key]) for key in now if known.get(key, (0, None))[1] != now[key]
        }
        self._content = {key: changed.get(key) or known[key] for key in now}
        if changed:
            self.version += 1
            event, self._changed = self._changed, asyncio.Event()
            event.set()

    def since(self, cursor: str) -> dict[str, Any] | None:
        """The changes since a cursor; everything for an unknown cursor; None without changes."""
        epoch, _, number = cursor.partition(".")
        known = int(number) if epoch == self.epoch and number.isdecimal() and len(number) < 16 else -1
        if known >= self.version:
            return None
        changes: dict[str, Any] = {"parts": {}, "lists": {}}
        for (kind, name), (version, content) in self._content.items():
            if version > known:
                changes[kind][name] = content
        return changes

    async def events(self, cursor: str) -> AsyncIterator[bytes]:
        """Server-sent events from a cursor on, until the client closes the stream."""
        self.watchers += 1
        try:
            yield b"retry: 2000\n\n"
            while True:
                changed = self._changed
                changes = self.since(cursor)
                if changes is None:
                    try:
                        async with asyncio.timeout(KEEP_ALIVE_S):
                            await changed.wait()
                    except TimeoutError:
                        yield b": still here\n\n"
                    continue
                cursor = self.cursor
                yield b"id: %s\nevent: update\ndata: %s\n\n" % (cursor.encode(), msgspec.json.encode(changes))
                await asyncio.sleep(LEAST_PAUSE_S)
        finally:
            self.watchers -= 1


class Feeds:
    """The feeds of all open pages, by the function that makes their view."""

    def __init__(self) -> None:
        self._feeds: dict[str, tuple[Feed, Callable[[], View]]] = {}

    def of(self, name: str, view: Callable[[], View], current: View | None = None) -> Feed:
        """The feed of a page; `view` makes its content, `current` is what it is now where that is known."""
        feed = self._feeds.pop(name)[0] if name in self._feeds else Feed()
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
