"""Messages to bytes and back: msgpack by msgspec, one decoder for each speaker's union.

A decoder checks types and required fields; it does not check ranges, and NaN decodes: whoever acts on a number refuses
what is not finite. Unknown fields are skipped, so an older peer may be told more than it knows.
"""

from __future__ import annotations

from typing import TypeVar

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.gateway import GatewayReply, GatewayRequest
from evopolicy_common.messages.operator import OperatorReply, OperatorRequest
from evopolicy_common.messages.worker import Message, WorkerReply, WorkerRequest

WIRE_VERSION = 1
"""Raised when a change is not understood by older peers; the first message of a session carries it."""

CHUNK_BYTES = 48 * 1024
"""Payload of one blob chunk: fits one Zenoh batch of 65,535 bytes with its envelope."""

INLINE_BYTES = 24 * 1024
"""A blob up to this size travels inside the message that names it."""

_encoder = msgspec.msgpack.Encoder()
worker_requests: msgspec.msgpack.Decoder[WorkerRequest] = msgspec.msgpack.Decoder(WorkerRequest)
worker_replies: msgspec.msgpack.Decoder[WorkerReply] = msgspec.msgpack.Decoder(WorkerReply)
gateway_requests: msgspec.msgpack.Decoder[GatewayRequest] = msgspec.msgpack.Decoder(GatewayRequest)
gateway_replies: msgspec.msgpack.Decoder[GatewayReply] = msgspec.msgpack.Decoder(GatewayReply)
operator_requests: msgspec.msgpack.Decoder[OperatorRequest] = msgspec.msgpack.Decoder(OperatorRequest)
operator_replies: msgspec.msgpack.Decoder[OperatorReply] = msgspec.msgpack.Decoder(OperatorReply)

T = TypeVar("T")


def encode(message: Message) -> bytes:
    """The message's bytes."""
    return _encoder.encode(message)


def decode(decoder: msgspec.msgpack.Decoder[T], data: bytes) -> T:
    """The message in `data`; ProtocolError when it is none that `decoder` knows."""
    try:
        return decoder.decode(data)
    except DECODE_ERRORS as error:
        raise ProtocolError(
            f"{len(data)} bytes are not a message of wire version {WIRE_VERSION}: {error}"
        ) from error
