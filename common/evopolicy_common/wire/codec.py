"""Encodes and decodes messages: msgpack by msgspec, with one decoder for each client's union.

A decoder checks types, required fields and the bounds of `messages.bounds`: lengths of texts and lists, nesting of
plain values, finite numbers. `encode` applies the same checks to its output. Unknown fields are skipped, so a newer
peer may send fields that an older one does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Annotated, TypeVar, get_args

import msgspec
from msgspec.msgpack import Decoder, Encoder

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages import bounds
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.gateway import GatewayReply, GatewayRequest
from evopolicy_common.messages.operator import OperatorReply, OperatorRequest
from evopolicy_common.messages.worker import Message, WorkerReply, WorkerRequest

WIRE_VERSION = 1
"""Incremented when older peers would not understand a change; the first message of a session carries it."""

CHUNK_BYTES = 256 * 1024
"""Payload of one blob chunk, bytes: as large as a page of results, so that it occupies its lane no longer."""

INLINE_BYTES = 128 * 1024
"""A blob up to this many bytes is sent inside the message that refers to it. An upload of its own costs coordinator,
gateway, and worker together as much CPU as a short episode."""

INLINE_BEGUN_BYTES = 4096
"""The same limit for `JobResult.begun` and `Job.begun`, bytes: one reply may carry hundreds of jobs."""

MAX_MESSAGE_BYTES = (16 << 20) - (64 << 10)
"""Largest message that is encoded or decoded, bytes. Zenoh silently drops messages beyond its own limit, 16 MiB."""

MAX_BLOB_BYTES = 1 << 30
"""Largest blob, bytes."""

MAX_PACKED_BYTES = 256 << 20
"""Largest blob of a job's packed outcomes, bytes; also the limit for `JobResult.begun`."""

_encoder = Encoder()
worker_requests: Decoder[WorkerRequest] = Decoder(WorkerRequest)
worker_replies: Decoder[WorkerReply] = Decoder(WorkerReply)
gateway_requests: Decoder[GatewayRequest] = Decoder(GatewayRequest)
gateway_replies: Decoder[GatewayReply] = Decoder(GatewayReply)
operator_requests: Decoder[OperatorRequest] = Decoder(OperatorRequest)
operator_replies: Decoder[OperatorReply] = Decoder(OperatorReply)
_outcomes: Decoder[tuple[EpisodeOutcome, ...]] = Decoder(
    Annotated[tuple[EpisodeOutcome, ...], msgspec.Meta(max_length=1 << 16)]
)
_decoder_of = cache(Decoder)

T = TypeVar("T")


def encode(message: Message) -> bytes:
    """The bytes of `message`. Raises ProtocolError when its peer would refuse them, or the transport drop them."""
    try:
        data = _encoder.encode(message)
        _decoder_of(type(message)).decode(data)
        _check_plain(message)
    except (*DECODE_ERRORS, OverflowError, TypeError, ValueError) as error:
        raise ProtocolError(f"a {type(message).__name__} cannot be sent: {error}") from error
    if len(data) > MAX_MESSAGE_BYTES:
        raise ProtocolError(
            f"a {type(message).__name__} of {len(data):,} bytes cannot be sent; {MAX_MESSAGE_BYTES:,} are the limit"
        )
    return data


def decode(decoder: Decoder[T], data: bytes) -> T:
    """The message in `data`. Raises ProtocolError when `decoder` cannot read it."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise ProtocolError(f"a message of {len(data):,} bytes; {MAX_MESSAGE_BYTES:,} are the limit")
    try:
        message = decoder.decode(data)
        _check_plain(message)
        return message
    except (*DECODE_ERRORS, ValueError) as error:
        raise ProtocolError(
            f"{len(data)} bytes are not a message of wire version {WIRE_VERSION}: {error}"
        ) from error


_REQUESTS = frozenset(get_args(WorkerRequest | GatewayRequest | OperatorRequest))


def _check_plain(message: object) -> None:
    """Checks requests only: the coordinator's replies are far more numerous, and it builds them from checked data."""
    if isinstance(message, msgspec.Struct) and type(message) in _REQUESTS:
        for part in bounds.plain_parts(message):
            bounds.check_plain(part)


def pack_outcomes(outcomes: Sequence[EpisodeOutcome]) -> bytes:
    """Encodes outcomes as one blob. Raises ProtocolError when it is too large."""
    data = _encoder.encode(outcomes)
    if len(data) > MAX_PACKED_BYTES:
        raise ProtocolError(
            f"{len(outcomes)} outcomes of {len(data):,} bytes; {MAX_PACKED_BYTES:,} are the limit"
        )
    return data


def unpack_outcomes(data: bytes) -> tuple[EpisodeOutcome, ...]:
    """Decodes the outcomes of `pack_outcomes`. Raises ProtocolError when `data` is something else."""
    if len(data) > MAX_PACKED_BYTES:
        raise ProtocolError(f"outcomes of {len(data):,} bytes; {MAX_PACKED_BYTES:,} are the limit")
    try:
        return _outcomes.decode(data)
    except DECODE_ERRORS as error:
        raise ProtocolError(f"{len(data)} bytes are not the outcomes of a job: {error}") from error
