"""Chromium's DevTools protocol over its debugging pipe: JSON messages that end in a zero byte.

Synchronous: a caller sends commands, and waits for their results; events are handled while it waits. Results of
commands in one session come in any order, but the browser takes the commands in the order they were sent.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from typing import Any

import msgspec

from evopolicy_common.errors import WorkerError

_READ = 1 << 20
_ERROR = "\0error"
MAX_MESSAGE_BYTES = 64 << 20
"""A page that makes the browser send more than this in one message is ended."""


class BrowserLostError(WorkerError):
    """The browser or its page has crashed, hangs, or does not execute a command. A new browser may work."""


class _Answer(msgspec.Struct):
    id: int = 0
    method: str = ""
    params: dict[str, Any] = {}
    result: dict[str, Any] = {}
    error: dict[str, Any] | None = None
    session: str = msgspec.field(name="sessionId", default="")


class DevTools:
    """Both ends of the pipe. `on_event(method, params, session)` is called for every event, while a result is waited
    for."""

    def __init__(
        self, commands: int, replies: int, on_event: Callable[[str, dict[str, Any], str], None]
    ) -> None:
        """`commands`, `answers`: descriptors to write to and to read from, owned by this object."""
        self._commands, self._replies, self._on_event = commands, replies, on_event
        self._encode = msgspec.json.Encoder().encode
        self._decode = msgspec.json.Decoder(_Answer).decode
        self._received = bytearray()
        self._n = 0
        self._results: dict[int, dict[str, Any]] = {}
        self._wanted: set[int] = set()

    def send(self, method: str, session: str = "", *, wanted: bool = True, **params: Any) -> int:
        """Sends a command and returns its number for `result`. `wanted=False`: the result is discarded."""
        self._n += 1
        message: dict[str, Any] = {"id": self._n, "method": method, "params": params}
        if session:
            message["sessionId"] = session
        data = memoryview(self._encode(message) + b"\0")
        try:
            while data:
                data = data[os.write(self._commands, data) :]
        except OSError as error:
            raise BrowserLostError(f"the browser has gone: {error.strerror}") from error
        if wanted:
            self._wanted.add(self._n)
        return self._n

    def result(self, number: int, timeout_s: float) -> dict[str, Any]:
        """The result of a command. BrowserLostError when it fails, or is not there after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while number not in self._results:
            self._receive(deadline)
        result = self._results.pop(number)
        if _ERROR in result:
            raise BrowserLostError(f"the browser refuses a command: {result[_ERROR]}")
        return result

    def call(self, method: str, session: str = "", *, timeout_s: float, **params: Any) -> dict[str, Any]:
        """Sends a command and waits for its result."""
        return self.result(self.send(method, session, **params), timeout_s)

    def wait(self, done: Callable[[], bool], timeout_s: float) -> None:
        """Handles events until `done()`. BrowserLostError after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not done():
            self._receive(deadline)

    def close(self) -> None:
        """Closes both ends; the browser then ends."""
        for descriptor in (self._commands, self._replies):
            os.close(descriptor)

    def _receive(self, deadline: float) -> None:
        """Reads once, and takes every whole message."""
        remaining_s = deadline - time.monotonic()
        if remaining_s <= 0 or not select.select([self._replies], [], [], remaining_s)[0]:
            raise BrowserLostError("the browser or its page does not answer: it hangs")
        data = os.read(self._replies, _READ)
        if not data:
            raise BrowserLostError("the browser has ended")
        *messages, rest = data.split(b"\0")
        for message in messages:
            whole, self._received = bytes(self._received) + message, bytearray()
            self._take(whole)
        self._received += rest
        if len(self._received) > MAX_MESSAGE_BYTES:
            raise BrowserLostError(f"the browser sends a message of over {MAX_MESSAGE_BYTES:,} bytes")

    def _take(self, message: bytes) -> None:
        try:
            answer = self._decode(message)
        except msgspec.MsgspecError as error:
            raise BrowserLostError(f"the browser sent an invalid reply: {error}") from error
        if answer.method:
            self._on_event(answer.method, answer.params, answer.session)
        elif answer.id in self._wanted:
            self._wanted.discard(answer.id)
            fault = answer.error
            self._results[answer.id] = (
                answer.result if fault is None else {_ERROR: fault.get("message", fault)}
            )
