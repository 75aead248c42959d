"""Updates of pages are differences; a browser that slept asks for what it missed."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from evopolicy_coordinator.web.content.feeds import LEAST_PAUSE_S, Feed, Feeds
from evopolicy_results.html import View


def view(rows: dict[str, str], **parts: str) -> View:
    made = View("rows")
    made.parts, made.lists["rows"] = {**parts, **rows}, list(rows)
    return made


def test_only_what_changed_is_sent() -> None:
    feed = Feed()
    feed.update(view({"a": "<i>1</i>", "b": "<i>1</i>"}, facts="<p>1</p>"))
    known = feed.cursor
    assert feed.since(known) is None
    feed.update(view({"a": "<i>1</i>", "b": "<i>2</i>"}, facts="<p>1</p>"))
    assert feed.since(known) == {"parts": {"b": "<i>2</i>"}, "lists": {}}


def test_the_same_content_is_no_update() -> None:
    feed = Feed()
    feed.update(view({"a": "x"}))
    known = feed.cursor
    feed.update(view({"a": "x"}))
    assert feed.cursor == known


def test_a_browser_that_slept_gets_the_latest_of_all_that_changed() -> None:
    feed = Feed()
    feed.update(view({"a": "0", "b": "0"}))
    known = feed.cursor
    for number in range(1, 1000):
        feed.update(view({"a": str(number), "b": "0", f"n{number}": "new"}))
    missed = feed.since(known)
    assert missed == {"parts": {"a": "999", "n999": "new"}, "lists": {"rows": ("a", "b", "n999")}}


def test_a_cursor_of_another_start_gets_everything() -> None:
    feed = Feed()
    feed.update(view({"a": "1"}))
    for cursor in (
        "",
        "0000.7",
        f"{feed.epoch}.",
        f"{feed.epoch}.x",
        "999999999999999999999.1",
        f"{feed.epoch}.-1",
    ):
        assert feed.since(cursor) == {"parts": {"a": "1"}, "lists": {"rows": ("a",)}}


async def first_events(feed: Feed, cursor: str, n: int) -> list[dict[str, Any]]:
    found = []
    events = feed.events(cursor)
    async for event in events:
        if event.startswith(b"id:"):
            found.append(json.loads(event.split(b"data: ", 1)[1]))
            if len(found) == n:
                break
    await events.aclose()  # type: ignore[attr-defined]
    return found


def test_many_changes_within_a_pause_are_one_event() -> None:
    async def play() -> list[dict[str, Any]]:
        feed = Feed()
        feed.update(view({"a": "0"}))
        reading = asyncio.create_task(first_events(feed, feed.cursor, 2))
        await asyncio.sleep(0)
        began = asyncio.get_running_loop().time()
        number = 0
        while not reading.done():
            number += 1
            feed.update(view({"a": str(number)}))
            await asyncio.sleep(0.001)
        assert asyncio.get_running_loop().time() - began >= LEAST_PAUSE_S
        assert feed.watchers == 0
        return reading.result()

    first, second = asyncio.run(play())
    assert int(second["parts"]["a"]) - int(first["parts"]["a"]) > 1


def test_pages_that_nobody_watches_are_let_go_of_first() -> None:
    feeds = Feeds()
    kept = feeds.of("kept", lambda: View())
    kept.watchers = 1
    for number in range(2000):
        feeds.of(f"page {number}", lambda: View())
    assert feeds.of("kept", lambda: View()) is kept
    assert [feed for feed, _ in feeds.watched()] == [kept]
    assert len(feeds._feeds) <= 512
