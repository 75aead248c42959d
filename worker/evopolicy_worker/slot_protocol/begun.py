"""The policy's actions in an unfinished episode: reported when a job is returned, so that the next attempt continues
from there. They are also in a file of the slot's scratch folder, which survives the process that plays.

Rules:
- Actions are stored as played, after repair. Their size follows from the action space and the number of steps, so a
  policy cannot make it too large to report.
- A failure remains valid like an action: the next attempt plays random actions from there.
- The file is written in every split, since a policy can measure the time between its calls.
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.episode import TIME_LIMITS, Job, PolicyFailure
from evopolicy_common.records.episodes import columns
from evopolicy_common.records.episodes.trajectory import Recorder, decode
from evopolicy_common.regular_files import read_regular
from evopolicy_common.wire.codec import MAX_PACKED_BYTES

MAX_TRACEBACK = 4000
FILE = "begun"
_LENGTH = struct.Struct("<I")
_END = _LENGTH.pack(0)
_BLOCK_BYTES = 64 << 10


Returned = tuple[Any, Any]
"""An action as the policy returned it (in an episode that started elsewhere, as played), and as played, after
repair."""


class RunningEpisode:
    """A running episode; the monitor's thread may read it meanwhile."""

    def __init__(self, taken: list[Returned] | None = None, failure: PolicyFailure | None = None) -> None:
        self.taken: list[Returned] = [] if taken is None else taken
        self.failure = failure
        self.log: ActionLog | None = None

    def add_action(self, returned: Any, action: Any) -> None:
        """Adds an action, before it reaches the environment."""
        self.taken.append((returned, action))
        if self.log is not None:
            kind = type(action)
            if kind is int:
                frame = _int_frame(action)
            elif kind is np.ndarray:
                frame = _array_head(action.dtype, action.shape) + action.tobytes() + _END
            else:
                frame = _frame(columns.encode(action))
            self.log.append(frame)

    def fail(self, failure: PolicyFailure) -> None:
        self.failure = failure
        if self.log is not None:
            self.log.write(self)

    def packed(self) -> PackedBegun:
        """A snapshot, for another process."""
        failure, taken = self.failure, list(self.taken)
        if failure is not None:
            failure = msgspec.structs.replace(failure, traceback=failure.traceback[-MAX_TRACEBACK:])
        recorder = Recorder("actions")
        for _, action in taken:
            recorder.append(None, action, 0.0, False, False, {})
        return PackedBegun(actions=recorder.finish() if taken else b"", failure=failure)


class PackedBegun(msgspec.Struct, frozen=True, kw_only=True):
    """The same as bytes."""

    actions: bytes = b""
    """`trajectory` codec bytes, of which the actions count."""
    failure: PolicyFailure | None = None
    more: tuple[bytes, ...] = ()
    """The actions after those, as `ActionLog` adds them, of an episode whose process has ended."""

    def unpacked(self) -> RunningEpisode:
        """The episode to continue; empty when the bytes of another worker cannot be read."""
        try:
            rows = decode(self.actions).rows() if self.actions else ()
            taken = [row.action for row in rows] + [columns.decoder.decode(each) for each in self.more]
        except (ProtocolError, *DECODE_ERRORS, ValueError, TypeError, OverflowError, MemoryError):
            return RunningEpisode()
        return RunningEpisode([(action, action) for action in taken], self.failure)


class ActionLog:
    """The file of the running episode: its head, then each further action. Mapped, as a system call for each step would
    take longer. If the disk is full, it has the first actions only."""

    def __init__(self, folder: Path) -> None:
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW
        self._file = os.open(folder / FILE, flags, 0o600)
        # Not sparse: a page that the disk has no room for would end the process.
        os.posix_fallocate(self._file, 0, _BLOCK_BYTES)
        self._map = mmap.mmap(self._file, _BLOCK_BYTES)
        self._size = _BLOCK_BYTES
        self._at, self._full = 0, False
        self._job, self._place = "", 0

    def begins(self, job: str, place: int, begun: RunningEpisode) -> None:
        """The job's episode at this index begins; the file has it from now on."""
        self._job, self._place = job, place
        begun.log = self
        self.write(begun)

    def write(self, begun: RunningEpisode) -> None:
        """Writes the episode anew."""
        self._at, self._full = 0, False
        self.append(_frame(_encoder.encode((self._job, self._place, begun.packed()))))

    def append(self, frame: bytes) -> None:
        """Adds an action, or the head; overwrites the end of the frame before."""
        at = self._at
        end = at + len(frame)
        if end > self._size:
            self._grow(end)
        if not self._full:
            self._map[at:end] = frame
            self._at = end - len(_END)

    def _grow(self, size: int) -> None:
        size = -(-max(size, 2 * self._size) // _BLOCK_BYTES) * _BLOCK_BYTES
        try:
            os.posix_fallocate(self._file, 0, size)
            self._map.resize(size)
            self._size = size
        except OSError:
            self._full = True


def _frame(data: bytes) -> bytes:
    """A frame of `ActionLog`, with the file's end after it."""
    return _LENGTH.pack(len(data)) + data + _END


@functools.lru_cache(256)
def _int_frame(action: int) -> bytes:
    return _frame(columns.encode(action))


@functools.lru_cache(256)
def _array_head(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """An array's frame before its numbers: the bytes of one differ from those of another only there."""
    zeros = np.zeros(shape, dtype)
    frame = _frame(columns.encode(zeros))
    return frame[: len(frame) - zeros.nbytes - len(_END)]


def _frames(data: bytes) -> Iterator[bytes]:
    """The parts of a `ActionLog`, up to its end."""
    at = 0
    while len(data) - at >= _LENGTH.size and (n := _LENGTH.unpack_from(data, at)[0]):
        at += _LENGTH.size
        if len(data) - at < n:
            return
        yield data[at : at + n]
        at += n


def recovered(folder: Path, job: str) -> _Places:
    """The job's episode that an ended process wrote to its scratch folder; empty when there is none."""
    with contextlib.suppress(OSError, StopIteration, *DECODE_ERRORS):
        frames = _frames(read_regular(folder / FILE, MAX_PACKED_BYTES))
        own_job, place, begun = _head.decode(next(frames))
        if own_job == job:
            return {place: msgspec.structs.replace(begun, more=tuple(frames))}
    return {}


class HandedBack(NamedTuple):
    """The report on an unfinished job."""

    data: bytes
    limit_verdict: bool
    """Whether a policy has exceeded a limit. The coordinator accepts this only from a worker that was never silent
    for long."""


_Places = dict[int, PackedBegun]
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Places)
_head = msgspec.msgpack.Decoder(tuple[str, int, PackedBegun])
"""The first part of a `ActionLog`: job, index in it, and the episode so far."""


def is_kept(job: Job) -> bool:
    """Whether the policy's actions remain valid: in hidden episodes, where a policy must not get a second attempt."""
    return job.bundle is not None and job.record == "actions"


def pack(places: Mapping[int, PackedBegun]) -> HandedBack | None:
    """The started episodes of a job by their index; None when there are none, or when they are too large."""
    started = {place: each for place, each in places.items() if each.actions or each.more or each.failure}
    data = _encoder.encode(started)
    if not started or len(data) > MAX_PACKED_BYTES:
        return None
    failures = [each.failure for each in started.values() if each.failure is not None]
    limits = any(failure.category in TIME_LIMITS or failure.limit is not None for failure in failures)
    return HandedBack(data, limits)


def unpack(job: Job) -> _Places:
    """The started episodes of an earlier attempt at the job; empty when they cannot be read."""
    data = None if job.begun is None or not is_kept(job) else job.begun.inline
    with contextlib.suppress(*DECODE_ERRORS, ProtocolError):
        return {} if data is None else _decoder.decode(data)
    return {}
