"""What an agent can send to its gateway's port beyond the three requests: raw bytes over real sockets, beside honest
ones.

Each test ends with an honest submit, which is charged for itself and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from gateway_double import Served, gateway_on, prepared

from evopolicy_gateway.run_folder.layout import save
from evopolicy_gateway.run_folder.listener import Listener
from evopolicy_gateway.submits import pipeline as submits
from evopolicy_gateway.submits.feedback import SubmitTree

TIMEOUT_S = 60.0
BODY = b'{"env_instances": [0]}'
DISCLOSED = re.compile(
    rb"Traceback|File \"|/usr/|/home/|/tmp/|\.py\b|starlette|uvicorn|h11|evopolicy", re.IGNORECASE
)
"""What no refusal needs to say."""


class Wire:
    """A gateway, and raw bytes to it."""

    def __init__(self, served: Served, tmp_path: Path) -> None:
        self.served = served
        self._address = urlsplit(served.urls.submit)
        self._secrets = [served.double.capability.encode(), str(tmp_path).encode()]
        self.path = self._address.path.removesuffix("/submit")
        """Secret, before each of the three names."""
        self.host = f"{self._address.hostname}:{self._address.port}"

    async def send(self, *parts: bytes) -> bytes:
        """What is answered until the gateway closes, or has nothing more to say."""
        reader, writer = await asyncio.open_connection(self._address.hostname, self._address.port)
        answer = b""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                with contextlib.suppress(ConnectionError):
                    for part in parts:
                        writer.write(part)
                        await writer.drain()
                    while more := await reader.read(1 << 16):
                        answer += more
        finally:
            writer.close()
        self._check(answer)
        return answer

    async def ask(self, target: str, method: str = "GET", head: str = "", body: bytes = b"") -> bytes:
        """One request whose target is taken as it is, and the connection closed after it."""
        lines = f"{method} {target} HTTP/1.1\r\nHost: {self.host}\r\nConnection: close\r\n{head}\r\n"
        return await self.send(lines.encode("latin-1") + body)

    def _check(self, answer: bytes) -> None:
        for response in re.split(rb"(?=HTTP/1\.1 )", answer):
            if re.match(rb"HTTP/1\.1 [45]", response):
                assert DISCLOSED.search(response) is None, response
                assert not any(secret in response for secret in self._secrets), response

    async def submit_honestly(self, n_before: int) -> None:
        """Only `n_before` submits of one episode were charged until now, and an honest one is taken."""
        assert len(self.served.double.submits) == n_before
        answer = await self.served.http.post(self.served.urls.submit, content=BODY)
        assert answer.json()["summary"]["remaining_budget"] == 12 - n_before - 1


def status(answer: bytes) -> int:
    """0 where it was cut off without a word."""
    return int(answer.split()[1]) if answer else 0


@asynccontextmanager
async def serving(tmp_path: Path, listener: Listener | None = None) -> AsyncIterator[Wire]:
    async with prepared(tmp_path) as (folder, double):
        if listener is not None:
            save(folder.listener, listener)
        async with gateway_on(folder, double) as service:
            yield Wire(service, tmp_path)


async def test_no_trick_with_a_path_reaches_a_file_or_another_answer(tmp_path: Path) -> None:
    """Attack: manipulates paths, hosts, or file names in a URL. Defence: a path is a secret token and one
    of three names, compared as a whole; anything else gets the same 404."""
    async with serving(tmp_path) as w:
        nothing = await w.ask(f"{w.path}/nothing")
        assert status(nothing) == 404
        tricks = [
            *(
                f"{w.path}{tail}"
                for tail in ("", "/", "//info", "/./info", "/info/", "/info/..", "/INFO", "/info;x")
            ),
            *(
                f"{w.path}/{tail}"
                for tail in ("../info", "..%2finfo", "%2e%2e/info", "info%00", "info%2f", "info%0d%0aX:y")
            ),
            *(
                f"{w.path}/{up}"
                for up in ("../" * 20 + "etc/passwd", "%2e%2e%2f" * 20 + "etc/passwd", "..\\..\\x")
            ),
            *(f"{w.path}/{name}" for name in ("workspace", ".gateway/credentials.json", "system/policy.py")),
            *("/info", "/", "//", "/etc/passwd", "/%2e%2e/info", "/.gateway/credentials.json"),
            f"http://{w.host}{w.path}/info",
            "http://169.254.169.254/latest/meta-data/",
            "file:///etc/passwd",
        ]
        for target in tricks:
            assert await w.ask(target) == nothing, target
        for method in ("DELETE", "TRACE", "PATCH", "OPTIONS", "SEARCH"):
            assert status(await w.ask(f"{w.path}/info", method)) == 405
        assert status(await w.ask("169.254.169.254:80", "CONNECT")) in (400, 404)
        assert status(await w.ask("*", "OPTIONS")) in (400, 404)
        assert status(await w.ask(f"{w.path}/info#top")) == 404
        assert status(await w.ask(f"{w.path}/info")) == 200
        await w.submit_honestly(0)


async def test_a_submit_that_is_guessed_is_one_of_its_own_or_none(tmp_path: Path) -> None:
    """Attack: asks for the submits of other runs. Defence: names are looked up among its own."""
    async with serving(tmp_path) as w:
        await w.submit_honestly(0)
        own = await w.ask(f"{w.path}/submit/submit_000")
        assert status(own) == 200
        assert await w.ask(f"{w.path}/submit/0") == own
        nothing = await w.ask(f"{w.path}/nothing")
        guesses = [
            "submit_001",
            "submit_-01",
            "submit_0",
            "submit_0000",
            "submit_000%20",
            "submit_000%00",
            "SUBMIT_000",
        ]
        guesses += [
            "run-1",
            "run-1/submit_000",
            "..",
            "%2e%2e",
            "*",
            *("1", "00", "-0", "+0", "0.0", "%D9%A0"),
            "submit_%D9%A0%D9%A0%D9%A0",
            "x" * 20_000,
        ]
        for guess in guesses:
            assert await w.ask(f"{w.path}/submit/{guess}") == nothing, guess
        await w.submit_honestly(1)


async def test_a_request_inside_another_body_is_served_only_with_the_token(tmp_path: Path) -> None:
    """Attack: smuggles a request in another's body, sends two lengths. Defence: refused or disconnected;
    each request needs the secret path and its bearer token."""
    async with serving(tmp_path) as w:
        head = f"POST {w.path}/submit HTTP/1.1\r\nHost: {w.host}\r\n"
        inner = f"{head}Content-Length: {len(BODY)}\r\nConnection: close\r\n\r\n".encode() + BODY
        chunk = b"%x\r\n%s\r\n0\r\n\r\n" % (len(BODY), BODY)
        lengths = f"Content-Length: {len(BODY)}\r\n"
        # Told twice, and differently, how long the body is: refused, or cut off.
        for answer_text in (
            f"{lengths}Content-Length: 5\r\n",
            f"Content-Length: +{len(BODY)}\r\n",
            f"Content-Length: {len(BODY):#x}\r\n",
            f"Content-Length: {len(BODY)}, 5\r\n",
            f"Content-Length: {'9' * 5000}\r\n",
            "Content-Length: -1\r\n",
            f"Content-Length : {len(BODY)}\r\n",
            "Transfer-Encoding: xchunked\r\n",
            "Transfer-Encoding: chunked, identity\r\n",
            "Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked\r\n",
            f"X: y\0z\r\n{lengths}",
        ):
            answer = await w.send((head + answer_text + "\r\n").encode() + BODY + inner)
            assert status(answer) in (0, 400, 501), answer_text
            assert answer.count(b"HTTP/1.1") <= 1, answer_text
        assert w.served.double.submits == []
        # Chunks go before a length, here as for every server that a front would hand this on to: the rest is no
        # request.
        both = f"{head}Transfer-Encoding: chunked\r\nContent-Length: {len(chunk) + 10}\r\nConnection: close\r\n\r\n"
        answer = await w.send(both.encode() + chunk + inner)
        assert answer.count(b"HTTP/1.1 200") <= 1
        n = len(w.served.double.submits)
        assert n <= 1
        # Nor is what comes after a request that closes.
        answer = await w.send(inner + inner)
        assert answer.count(b"HTTP/1.1 200") == 1
        await w.submit_honestly(n + 1)


async def test_a_smuggled_request_needs_the_bearer_token_again(tmp_path: Path) -> None:
    """Attack: smuggles a request in another's body, sends two lengths. Defence: refused or disconnected;
    each request needs the secret path and its bearer token."""
    async with serving(tmp_path, Listener(host="127.0.0.2", port=0)) as w:
        bearer = w.served.folder.bearer.read_text().strip()
        request = f"GET {w.path}/info HTTP/1.1\r\nHost: {w.host}\r\n"
        mine = f"{request}Authorization: Bearer {bearer}\r\n\r\n".encode()
        stranger = f"{request}Connection: close\r\n\r\n".encode()
        answer = await w.send(mine + stranger)
        assert [status(one) for one in re.findall(rb"HTTP/1\.1 \d+", answer)] == [200, 401]
        assert bearer.encode() not in answer


async def test_a_huge_query_and_odd_headers_change_nothing(tmp_path: Path) -> None:
    """Attack: sends huge queries, headers or bodies, or sends and reads slowly. Defence: limits, and a
    clock on every part of a request."""
    async with serving(tmp_path) as w:
        assert status(await w.ask(f"{w.path}/info?{'a=b&' * 7000}")) == 200
        for size in (200_000, 1 << 20):
            assert status(await w.ask(f"{w.path}/info?{'a' * size}")) in (0, 400)
        for query in ("wait=maybe", "wait=%00", "wait=false&wait=2", f"wait={'t' * 9000}"):
            refused = await w.ask(
                f"{w.path}/submit?{query}", "POST", f"Content-Length: {len(BODY)}\r\n", BODY
            )
            assert status(refused) == 400, query
        for key in ("", "k" * 201, "a\tb", "\x85"):
            head = f"Idempotency-Key: {key}\r\nContent-Length: {len(BODY)}\r\n"
            assert status(await w.ask(f"{w.path}/submit", "POST", head, BODY)) == 400, key
        for start in (
            b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
            b"\x16\x03\x01\x02\x00\x01",
            b"GET\r\n\r\n",
            b"\0" * 100,
        ):
            assert status(await w.send(start + b"\r\n\r\n")) in (0, 400, 404)
        upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: x\r\nSec-WebSocket-Version: 13\r\n"
        assert b"101 " not in await w.ask(f"{w.path}/info", head=upgrade)
        await w.submit_honestly(0)


async def test_requests_that_cannot_be_read_fill_no_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with serving(tmp_path) as w:
        for _ in range(20):
            assert status(await w.send(b"\x1b[2J\r\n\r\n")) == 400
        assert caplog.records == []
        await w.submit_honestly(0)


async def test_one_request_with_two_keys_is_one_submit(tmp_path: Path) -> None:
    """Attack: sends a submit twice to be charged once and played twice. Defence: one submit per key and
    bundle digest, in gateway and coordinator."""
    async with serving(tmp_path) as w:
        head = f"Idempotency-Key: one\r\nIdempotency-Key: two\r\nContent-Length: {len(BODY)}\r\n"
        first = await w.ask(f"{w.path}/submit", "POST", head, BODY)
        again = await w.ask(f"{w.path}/submit", "POST", head, BODY)
        assert first == again
        assert status(first) == 200
        await w.submit_honestly(1)


async def test_a_fault_of_ours_is_reported_without_a_word_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: provokes errors that reveal the machine. Defence: fixed texts; system errors go to the log."""
    async with serving(tmp_path) as w:

        async def fail() -> None:
            raise RuntimeError(f"{tmp_path} {w.served.double.capability}")

        with monkeypatch.context() as patched:
            patched.setattr(w.served.pipeline, "refresh", fail)
            answer = await w.ask(f"{w.path}/info")
        assert status(answer) == 500
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["error"]["message"].startswith(
            "the gateway failed"
        )
        await w.submit_honestly(0)


async def test_feedback_that_cannot_be_written_is_reported_without_the_machines_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: provokes errors that reveal the machine. Defence: fixed texts; system errors go to the log."""
    monkeypatch.setattr(submits, "DISK_PAUSE_S", 0.1)

    def refuse(tree: SubmitTree) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tree.final))

    async with serving(tmp_path) as w:
        length = f"Content-Length: {len(BODY)}\r\n"
        with monkeypatch.context() as patched:
            patched.setattr(SubmitTree, "begin", refuse)
            assert status(await w.ask(f"{w.path}/submit?wait=false", "POST", length, BODY)) == 202
            waits_for = ""
            while not waits_for:
                document = json.loads((await w.ask(f"{w.path}/info")).partition(b"\r\n\r\n")[2])
                waits_for = document["submit_in_flight"]["waits_for"]
        assert waits_for == "the gateway to write feedback: No space left on device"
        await w.served.pipeline.idle()
        await w.submit_honestly(1)
