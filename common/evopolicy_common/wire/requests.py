"""Typed requests of workers, gateways and operators to the coordinator, with timeouts.

All requests may be repeated. A request without a reply is sent again, with back-off, until the reply comes or the
caller's timeout passes. A refusal counts as a reply.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import random
import time
from collections.abc import Callable, Collection
from functools import partial
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import IO, Generic, TypeVar
from urllib.parse import urlsplit

import msgspec

from evopolicy_common.errors import ProtocolError, RefusedError, TransportError
from evopolicy_common.logs import log
from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.operator import OperatorReply
from evopolicy_common.messages.worker import BlobAck, BlobChunk, BlobGet, BlobPut, Message, Refused
from evopolicy_common.processes.notices import AFTER_S, notify_if_slow
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.wire import codec, keys
from evopolicy_common.wire.transport import Link

Reply = TypeVar("Reply")
Wanted = TypeVar("Wanted")

FIRST_PAUSE_S = 0.05
LONGEST_PAUSE_S = 0.5
"""Clients resume within a second of the coordinator's return."""
ANSWER_S = 5.0
"""Timeout of one sending, beyond the time that a long poll requests."""
OUT_OF_REACH_S = 300.0
"""After a failure of the object store, its blobs come through the coordinator for this long."""
DIRECT_S = 60.0
"""Timeout of a blob from the object store."""
WARN_AFTER_S = 10.0
"""A request that has waited this long is logged, and again whenever its waiting time has doubled."""


class Requester(Generic[Reply]):
    """Sends one kind of client's requests over a link."""

    def __init__(
        self, link: Link, key_of: Callable[[str], str], replies: msgspec.msgpack.Decoder[Reply]
    ) -> None:
        """`key_of` maps a verb (`lease`, `submit`) to the full key; `replies` decodes this kind of client's replies."""
        self._link, self._key_of, self._replies = link, key_of, replies
        self._direct_at = 0.0
        """When the object store may be asked again, by the monotonic clock."""

    async def once(self, verb: str, message: Message, wanted: type[Wanted], *, wait_s: float = 0.0) -> Wanted:
        """Sends the message once and returns the reply.

        `wait_s` is how long the message itself lets the coordinator wait. Raises RefusedError for a refusal,
        TransportError without a reply, ProtocolError for another reply.
        """
        with notify_if_slow("the coordinator to answer", wait_s + AFTER_S):
            answer = await self._link.query(self._key_of(verb), codec.encode(message), wait_s + ANSWER_S)
        return expect(codec.decode(self._replies, answer), wanted)

    async def until_answered(
        self,
        verb: str,
        message: Message,
        wanted: type[Wanted],
        *,
        wait_s: float = 0.0,
        timeout_s: float | None = None,
        despite: Collection[str] = (),
    ) -> Wanted:
        """As `once`, repeated until a reply comes, other than a refusal with a status in `despite`. Raises
        TransportError after `timeout_s` seconds without any (None: never)."""
        pause, warn_after_s = FIRST_PAUSE_S, WARN_AFTER_S
        started, refused = time.monotonic(), ""
        about = {"run": run} if (run := getattr(message, "run", "")) else {}
        while True:
            try:
                return await self.once(verb, message, wanted, wait_s=wait_s)
            except RefusedError as error:
                if error.status not in despite:
                    raise
                if error.message != refused:
                    why = "the coordinator cannot serve this now; asking again"
                    log.warning(why, verb=verb, why=error.message, **about)
                started, refused, pause = time.monotonic(), error.message, LONGEST_PAUSE_S
            except TransportError as error:
                waited = time.monotonic() - started
                if timeout_s is not None and waited > timeout_s:
                    raise
                if waited > warn_after_s:
                    warn_after_s = 2.0 * waited
                    known = {"waited_s": round(waited), "why": str(error), **about}
                    log.warning("still waiting for the coordinator", **known)
            await asyncio.sleep(pause * random.uniform(0.5, 1.5))
            pause = min(LONGEST_PAUSE_S, pause * 2)

    async def upload(self, sender: str, token: str, digest: str, data: bytes) -> None:
        """Uploads a blob in acknowledged chunks. Raises ProtocolError when it is too large."""
        if len(data) > codec.MAX_BLOB_BYTES:
            raise ProtocolError(f"a blob of {len(data):,} bytes; {codec.MAX_BLOB_BYTES:,} are the limit")
        offset = 0
        while True:
            chunk, size = data[offset : offset + codec.CHUNK_BYTES], len(data)
            put = BlobPut(sender=sender, token=token, digest=digest, size=size, offset=offset, data=chunk)
            offset = (await self.until_answered("blob", put, BlobAck)).have
            if offset >= size:
                return

    async def download(self, sender: str, token: str, digest: str, most: int = codec.MAX_BLOB_BYTES) -> bytes:
        """Returns a blob of at most `most` bytes. Raises ProtocolError as `download_to`."""
        file = io.BytesIO()
        await self.download_to(file, sender, token, digest, most)
        return file.getvalue()

    async def download_to(
        self, file: IO[bytes], sender: str, token: str, digest: str, most: int = codec.MAX_BLOB_BYTES
    ) -> None:
        """Writes a blob to a file. Raises ProtocolError for more than `most` bytes, or another digest."""
        hashed, have, direct = hashlib.sha256(), 0, time.monotonic() >= self._direct_at
        while True:
            get = BlobGet(sender=sender, token=token, digest=digest, offset=have, direct=direct and not have)
            chunk = await self.until_answered("blob", get, BlobChunk)
            if chunk.size > most:
                raise ProtocolError(f"blob {digest} of {chunk.size:,} bytes; {most:,} are the limit")
            if chunk.address and direct and not have:
                data = await asyncio.to_thread(_fetched, chunk.address, chunk.size)
                if digest_of(data) != digest:
                    why = "the object store did not send a blob; asking the coordinator instead"
                    log.warning(why, digest=digest, size=chunk.size, received=len(data), for_s=OUT_OF_REACH_S)
                    direct, self._direct_at = False, time.monotonic() + OUT_OF_REACH_S
                    continue
                chunk = BlobChunk(size=len(data), data=data)
            file.write(chunk.data)
            hashed.update(chunk.data)
            have += len(chunk.data)
            if have >= chunk.size or not chunk.data:
                break
        if have != chunk.size or hashed.hexdigest() != digest:
            raise ProtocolError(f"blob {digest} arrived damaged ({have} of {chunk.size} bytes)")

    async def fetch(self, sender: str, token: str, ref: BlobRef) -> bytes:
        """Returns the bytes of `ref`, from the message or the coordinator, checked against the digest."""
        if ref.inline is None:
            return await self.download(sender, token, ref.digest, ref.size)
        if digest_of(ref.inline) != ref.digest:
            raise ProtocolError(f"blob {ref.digest} arrived damaged inside its message")
        return ref.inline


def _fetched(address: str, size: int) -> bytes:
    """Returns at most `size` bytes of an object by its signed address; fewer when they do not come. Follows no
    redirect, and does not log the address: whoever knows it can read the object."""
    data, deadline = bytearray(), time.monotonic() + DIRECT_S
    with contextlib.suppress(OSError, HTTPException, ValueError, KeyError):
        parts = urlsplit(address)
        connection = {"http": HTTPConnection, "https": HTTPSConnection}[parts.scheme]
        with contextlib.closing(connection(parts.netloc, timeout=ANSWER_S)) as link:
            link.request("GET", f"{parts.path}?{parts.query}")
            answer = link.getresponse()
            while answer.status == 200 and time.monotonic() < deadline:
                if not (piece := answer.read1(size - len(data))):
                    break
                data += piece
    return bytes(data)


def operator_requests(link: Link) -> Requester[OperatorReply]:
    return Requester(link, partial(keys.operator_key, link.credentials.cluster), codec.operator_replies)


def expect(reply: object, wanted: type[Wanted]) -> Wanted:
    """Returns `reply` if it is a `wanted`. Raises RefusedError for a refusal, ProtocolError for any other message."""
    if isinstance(reply, wanted):
        return reply
    if isinstance(reply, Refused):
        raise RefusedError(reply.status, reply.message)
    raise ProtocolError(f"expected {wanted.__name__}, got {type(reply).__name__}")
