"""The policy's actions in an unfinished episode: reported when a job is returned, so that the next attempt continues
from there.

Rules:
- Actions are stored as played, after repair. Their size follows from the action space and the number of steps, so a
  policy cannot make it too large to report.
- A failure remains valid like an action: the next attempt plays random actions from there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.episode import TIME_LIMITS, Job, PolicyFailure
from evopolicy_common.records.episodes.trajectory import Recorder, decode
from evopolicy_common.wire.codec import MAX_PACKED_BYTES

MAX_TRACEBACK = 4000


class Returned(NamedTuple):
    """One action of the policy."""

    returned: Any
    """As the policy returned it; in an episode that started elsewhere, `action`."""
    action: Any
    """As played, after repair."""


class Begun:
    """A running episode; the monitor's thread may read it meanwhile."""

    def __init__(self, taken: list[Returned] | None = None, failure: PolicyFailure | None = None) -> None:
        self.taken: list[Returned] = [] if taken is None else taken
        self.failure = failure

    def packed(self) -> PackedBegun:
        """A snapshot, for another process."""
        failure, taken = self.failure, list(self.taken)
        if failure is not None:
            failure = msgspec.structs.replace(failure, traceback=failure.traceback[-MAX_TRACEBACK:])
        recorder = Recorder("actions")
        for each in taken:
            recorder.append(None, each.action, 0.0, False, False, {})
        return PackedBegun(actions=recorder.finish() if taken else b"", failure=failure)


class PackedBegun(msgspec.Struct, frozen=True, kw_only=True):
    """The same as bytes."""

    actions: bytes = b""
    """`trajectory` codec bytes, of which the actions count."""
    failure: PolicyFailure | None = None

    def unpacked(self) -> Begun:
        """The episode to continue; empty when the bytes of another worker cannot be read."""
        try:
            rows = decode(self.actions).rows() if self.actions else ()
        except ProtocolError:
            return Begun()
        return Begun([Returned(row.action, row.action) for row in rows], self.failure)


class HandedBack(NamedTuple):
    """The report on an unfinished job."""

    data: bytes
    limit_verdict: bool
    """Whether a policy has exceeded a limit. The coordinator accepts this only from a worker that was never silent
    for long."""


_Places = dict[int, PackedBegun]
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Places)


def is_kept(job: Job) -> bool:
    """Whether the policy's actions remain valid: in hidden episodes, where a policy must not get a second attempt."""
    return job.bundle is not None and job.record == "actions"


def pack(places: Mapping[int, PackedBegun]) -> HandedBack | None:
    """The started episodes of a job by their index; None when there are none, or when they are too large."""
    found = {place: each for place, each in places.items() if each.actions or each.failure}
    data = _encoder.encode(found)
    if not found or len(data) > MAX_PACKED_BYTES:
        return None
    failures = [each.failure for each in found.values() if each.failure is not None]
    limits = any(failure.category in TIME_LIMITS or failure.limit is not None for failure in failures)
    return HandedBack(data, limits)


def unpack(job: Job) -> _Places:
    """The started episodes of an earlier attempt at the job; empty when they cannot be read."""
    data = None if job.begun is None or not is_kept(job) else job.begun.inline
    with contextlib.suppress(*DECODE_ERRORS, ProtocolError):
        return {} if data is None else _decoder.decode(data)
    return {}
