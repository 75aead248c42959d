"""The threads that send answers: one that cannot be sent holds up none behind it."""

from __future__ import annotations

import queue
from typing import Any

import pytest
import zenoh

from evopolicy_common.wire.transport import _send_replies


class Query:
    """In place of Zenoh's."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error
        self.sent: list[tuple[str, bytes]] = []
        self.dropped = False

    def reply(self, key: str, payload: bytes) -> None:
        if self.error is not None:
            raise self.error
        self.sent.append((key, payload))

    def drop(self) -> None:
        self.dropped = True


@pytest.mark.parametrize("error", [zenoh.ZError("gone"), TypeError("a bug"), MemoryError()])
def test_an_answer_that_cannot_be_sent_holds_up_none_behind_it(error: Exception) -> None:
    lane: queue.SimpleQueue[Any] = queue.SimpleQueue()
    broken, sound = Query(error), Query()
    for item in ((broken, "a", b"1"), (sound, "b", b"2"), None):
        lane.put(item)
    _send_replies(lane)
    assert sound.sent == [("b", b"2")]
    assert broken.dropped
    assert sound.dropped
