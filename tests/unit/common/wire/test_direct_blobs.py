"""Blobs that an object store serves: bytes that differ, addresses of something else, and stores out of reach."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, ClassVar

import pytest
from stages.loopback import Loopback

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.worker import BlobChunk, BlobGet
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.wire import requests
from evopolicy_common.wire.requests import Requester

DATA = b"a recording" * 1000


class Store(BaseHTTPRequestHandler):
    """An object store; by its path it sends the blob, other bytes, more of them, a redirect, nothing, or one byte after
    the other."""

    asked: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        kind = self.path.partition("?")[0]
        if kind == "/redirect":
            self.send_response(307)
            self.send_header("Location", "/blob?signed")
            self.end_headers()
            return
        self.send_response(403 if kind == "/expired" else 200)
        self.end_headers()
        with contextlib.suppress(OSError):
            while kind == "/trickling":
                self.wfile.write(b"?")
                time.sleep(0.01)
        self.wfile.write({"/other": DATA[::-1], "/short": DATA[:-1], "/longer": DATA + b"!"}.get(kind, DATA))

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def store() -> Iterator[str]:
    Store.asked.clear()
    with Loopback(Store) as server:
        yield server.base_url


class Coordinator(Requester[Any]):
    """Answers with an address where one may be, and otherwise with a chunk."""

    def __init__(self, address: str) -> None:
        super().__init__(None, str, None)  # type: ignore[arg-type]
        self.address = address
        self.gets: list[BlobGet] = []

    async def until_answered(self, verb: str, message: Any, wanted: type[Any], **_: Any) -> Any:
        self.gets.append(message)
        if message.direct:
            return BlobChunk(size=len(DATA), data=b"", address=self.address)
        return BlobChunk(size=len(DATA), data=DATA[message.offset :][:4096])

    def get(self) -> bytes:
        return asyncio.run(self.download("w", "token", digest_of(DATA)))


def test_an_address_saves_the_chunks(store: str) -> None:
    coordinator = Coordinator(f"{store}/blob?signed")
    for n in (1, 2):
        assert coordinator.get() == DATA
        assert [each.direct for each in coordinator.gets] == [True] * n
    assert Store.asked == ["/blob?signed"] * 2


@pytest.mark.parametrize("kind", ["other", "short", "expired", "redirect", "trickling"])
def test_other_bytes_are_asked_of_the_coordinator(
    store: str, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: whoever can write to the object store, or redirect from it, replaces a bundle, or sends without end."""
    monkeypatch.setattr(requests, "DIRECT_S", 0.1 if kind == "trickling" else 60.0)
    coordinator = Coordinator(f"{store}/{kind}?signed")
    assert coordinator.get() == DATA
    assert Store.asked == [f"/{kind}?signed"]
    assert [each.offset for each in coordinator.gets] == [0, 0, 4096, 8192]
    assert coordinator.get() == DATA
    assert len(Store.asked) == 1
    coordinator._direct_at = 0.0  # after `OUT_OF_REACH_S`
    coordinator.address = f"{store}/blob?signed"
    assert coordinator.get() == DATA
    assert len(Store.asked) == 2


def test_no_more_than_the_size_is_read(store: str) -> None:
    """Attack: an object without end."""
    assert Coordinator(f"{store}/longer?signed").get() == DATA


def test_a_blob_above_the_limit_is_not_fetched(store: str) -> None:
    coordinator = Coordinator(f"{store}/blob?signed")
    with pytest.raises(ProtocolError, match="are the limit"):
        asyncio.run(coordinator.download("w", "token", digest_of(DATA), 10))
    assert Store.asked == []


def test_only_http_addresses_are_opened(tmp_path: Path) -> None:
    """Attack: an address names a file of the worker's machine, or nothing that can be reached."""
    (tmp_path / "file").write_bytes(DATA)
    for address in (f"file://{tmp_path}/file", "http://127.0.0.1:1/x?y", "https://[", "gopher://x"):
        coordinator = Coordinator(address)
        assert coordinator.get() == DATA
        assert [each.direct for each in coordinator.gets][:2] == [True, False]
