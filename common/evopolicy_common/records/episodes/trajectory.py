"""An episode as bytes: observation, action and outcome of every step.

Rules that this module owns:
- The same rows give the same bytes; every number is restored bit for bit, including NaN and infinities.
- Rows are packed in blocks; pictures are compressed one by one on arrival and never accumulate uncompressed in memory.
- A block consists of columns, one per leaf of the observation: `magic, header, {length, zstd(msgpack block)}…, 0`.
- Decoding raises ProtocolError for any bytes that are not a complete trajectory of this version.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.environment import ObservationForm
from evopolicy_common.messages.episode import Record
from evopolicy_common.records.episodes import columns
from evopolicy_common.records.json_text import as_lists

MAGIC = b"evotraj1"
BLOCK_BYTES = 4 << 20
"""Approximate size of the observations in a block, bytes."""
PICTURE_BYTES = 4096
"""Arrays of at least this size, in bytes, are compressed on arrival."""
PICTURES_BLOCK_BYTES = 64 << 20
"""Size of a block of pictures, uncompressed, bytes."""
BLOCK_ROWS = columns.MAX_ROWS
MAX_BLOCK_BYTES = 1 << 28
"""Limit of a block, encoding and decoding, bytes."""
MAX_ROWS = 1 << 22
"""Most steps of an episode."""
MAX_BYTES = 4 << 30
"""Limit of a decoded trajectory's blocks and pictures, unpacked, bytes. 27,000 frames of Atari take 2.7 GB."""
MAX_VALUES = 1 << 23
"""Limit of the values in its blocks, an array counting as one: Python's objects need more memory than their bytes."""
_MAX_HEADER_BYTES = 4096
_UNCOUNTED_BYTES = 4 << 20
"""The first blocks, up to this many bytes, are decoded without counting their values."""

_LENGTH = struct.Struct("<I")
TERMINATED, TRUNCATED = 1, 2
"""Bit flags of a row."""
_FORM = (msgspec.DecodeError, ValueError, TypeError, LookupError, OverflowError, RecursionError)
_QUICK_BYTES = 256 << 10
"""Larger blocks, in bytes, are compressed at level 1: they hold pictures, for which speed matters more."""


class Row(NamedTuple):
    """One step. `obs` is the observation before it, `action` what the policy returned for it."""

    t: int
    obs: Any
    """An array, int, str, dict or tuple (nested lists with `observations` "lists"); None if not recorded."""
    action: Any
    """As the policy returned it, before repair; a tuple may have become a list."""
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class Trajectory(msgspec.Struct, frozen=True, kw_only=True):
    """A decoded episode of `n` steps."""

    n: int
    record: Record
    """With "actions" there are no observations and no infos, and actions are those applied, after repair."""
    observations: ObservationForm
    """The form in which the policy received them."""
    obs: Any
    """Columns in the structure of the observation (dicts, tuples): for each leaf a numpy array (n × the leaf's
    shape) or a list of strings. None when observations are not recorded or there are no steps."""
    actions: Sequence[Any] | NDArray[Any]
    """n actions: an array (n × shape) if all are arrays of one shape and dtype, else a list."""
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: list[dict[str, Any]]
    obs_at: Callable[[int], Any]
    """The observation of one step, in the form of `Row.obs`."""
    files: dict[str, bytes] = {}
    """Files of a rendered episode (`rendered`), which alone have its observations and infos."""

    def rows(self) -> Iterator[Row]:
        """The steps in order."""
        # Indexing such an array without axes per action yields scalars.
        arrays = isinstance(self.actions, np.ndarray)
        for t in range(self.n):
            yield Row(
                t,
                self.obs_at(t),
                np.asarray(self.actions[t]) if arrays else self.actions[t],
                float(self.rewards[t]),
                bool(self.terminated[t]),
                bool(self.truncated[t]),
                self.infos[t] if self.infos else {},
            )


class Recorder:
    """Records an episode's steps one by one. Not thread-safe."""

    def __init__(self, record: Record = "full", observations: ObservationForm = "arrays") -> None:
        self._full = record == "full"
        header = columns.encoder.encode({"record": record, "observations": observations})
        self._parts: list[bytes] = [MAGIC, _LENGTH.pack(len(header)), header]
        self._block_rows = BLOCK_ROWS
        self._n_packed = 0
        self._pictures: columns.Pictures | None = None
        self._clear()

    def append(
        self, obs: Any, action: Any, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
    ) -> None:
        """Records one step. `obs` and arrays in `action` are kept, not copied: they must not change afterwards."""
        steps = self._steps
        if not steps:
            self._begin_block(obs, action)
        if self._full:
            while self._take(obs):
                # Shape or dtype differs from the pictures before: start a new block of the kind that fits.
                self._flush()
                steps = self._steps
                self._begin_block(obs, action)
        # On each step: columns are made of the tuples at the end of a block.
        steps.append((action, reward, (terminated and TERMINATED) | (truncated and TRUNCATED), info))
        if len(steps) >= self._block_rows:
            self._flush()

    def finish(self) -> bytes:
        """The trajectory's bytes. The recorder must not be used afterwards."""
        if self._steps:
            self._flush()
        return b"".join([*self._parts, _LENGTH.pack(0)])

    def _begin_block(self, obs: object, action: object) -> None:
        """Starts a block. Its first row alone decides its kind, so that equal rows give equal bytes."""
        most = MAX_BLOCK_BYTES // 2 // max(1, _size(action))
        if self._full:
            size = max(1, _size(obs))
            is_picture = type(obs) is np.ndarray and size >= PICTURE_BYTES
            most = min(most, (PICTURES_BLOCK_BYTES if is_picture else BLOCK_BYTES) // size)
            self._take = self._taker(obs, is_picture)
        self._block_rows = max(1, min(BLOCK_ROWS, most))

    def _taker(self, obs: Any, is_picture: bool) -> Callable[[Any], bool | None]:
        """Takes the observations of a block that begins with `obs`; returns True for one of another form."""
        if not is_picture:
            return self._obs.append
        self._pictures = columns.Pictures(obs)
        return self._pictures.add

    def _clear(self) -> None:
        self._pictures = None
        self._obs: list[Any] = []
        self._steps: list[tuple[Any, float, int, dict[str, Any]]] = []
        """Of the block's rows: action, reward, flags, info."""

    def _flush(self) -> None:
        obs, infos = None, []
        if self._full:
            obs = columns.pack(self._obs) if self._pictures is None else self._pictures.packed()
            infos = [info for *_, info in self._steps]
        self._add_block(obs, infos if any(infos) else len(infos))
        self._clear()

    def _add_block(self, obs: list[Any] | None, infos: list[dict[str, Any]] | int) -> bytes:
        """Packs the rows so far as a block, stores it compressed, and returns it uncompressed."""
        actions, rewards, flags, _ = zip(*self._steps, strict=True)
        block = {
            "obs": obs,
            "actions": columns.pack(list(actions)),
            "rewards": np.array(rewards, dtype="<f8").tobytes(),
            "flags": bytes(flags),
            "infos": infos,
        }
        packed = columns.encode(block)
        self._n_packed += len(rewards)
        if len(packed) > MAX_BLOCK_BYTES or self._n_packed > MAX_ROWS:
            raise ProtocolError(
                f"an episode of {self._n_packed:,} steps with a block of {len(packed):,} bytes cannot be recorded;"
                f" {MAX_ROWS:,} and {MAX_BLOCK_BYTES:,} are the limits"
            )
        level = 1 if len(packed) > _QUICK_BYTES else 3
        compressed = zstandard.ZstdCompressor(level=level).compress(packed)
        self._parts += [_LENGTH.pack(len(compressed)), compressed]
        return packed


def decode(data: bytes, max_bytes: int = MAX_BYTES) -> Trajectory:
    """The episode in `data`. Raises ProtocolError when it is not a trajectory, or larger than `max_bytes` unpacked."""
    try:
        return _decode(data, max_bytes)
    except (*_FORM, zstandard.ZstdError, struct.error, AttributeError, MemoryError) as error:
        raise ProtocolError(f"{len(data)} bytes are not a trajectory: {error}") from error


def _decode(data: bytes, max_bytes: int) -> Trajectory:
    if data[: len(MAGIC)] != MAGIC:
        raise ValueError("they do not begin with the format's mark")
    frames = _frames(data)
    header = columns.decoder.decode(next(frames, b"")[:_MAX_HEADER_BYTES])
    full, lists = header["record"] == "full", header["observations"] == "lists"
    decompressor = zstandard.ZstdDecompressor()
    all_obs: list[columns.StepColumn] = []
    all_actions: list[columns.StepColumn] = []
    all_rewards: list[bytes] = []
    all_flags: list[bytes] = []
    infos: list[dict[str, Any]] = []
    n_bytes = n_values = n = 0
    # Claimed sizes and counts are not trusted but checked against the limits first.
    for frame in frames:
        size = zstandard.frame_content_size(frame)
        if not 0 < size <= min(MAX_BLOCK_BYTES, columns.most_of(frame)):
            raise ValueError(f"a block of {len(frame)} bytes claims {size}")
        n_bytes += size
        if n_bytes > max_bytes:
            raise ValueError(f"more than {max_bytes:,} bytes")
        packed = decompressor.decompress(frame)
        if n_bytes > _UNCOUNTED_BYTES:
            n_values += columns.count_values(packed, MAX_VALUES - n_values)
        if n_values > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES:,} values")
        block = columns.decoder.decode(packed)
        rows, odd = divmod(len(block["rewards"]), 8)
        n += rows
        if odd or not 0 < rows <= BLOCK_ROWS or n > MAX_ROWS:
            raise ValueError(f"a block of {rows} rows, {n} in all")
        all_actions.append(columns.unpack(block["actions"]))
        lengths = {all_actions[-1].n, len(block["flags"])}
        if full:
            all_obs.append(columns.unpack(block["obs"], pictures=True))
            n_bytes += all_obs[-1].data.nbytes if block["obs"][0] == "pictures" else 0
            if n_bytes > max_bytes:
                raise ValueError(f"more than {max_bytes:,} bytes")
            some = block["infos"]
            infos += ([{} for _ in range(rows)] if some == rows else []) if isinstance(some, int) else some
            lengths |= {all_obs[-1].n, len(infos) - (n - rows)}
        if lengths != {rows}:
            raise ValueError(f"columns of {rows} rows have {sorted(lengths)}")
        all_rewards.append(block["rewards"])
        all_flags.append(block["flags"])
    observed = columns.join(all_obs) if all_obs else None
    actions = columns.join(all_actions) if all_actions else columns.StepColumn("values", [], 0)
    flags = np.frombuffer(b"".join(all_flags), dtype=np.uint8)

    def obs_at(t: int) -> Any:
        row = None if observed is None else observed.row(t)
        return as_lists(row) if lists else row

    return Trajectory(
        n=n,
        record="full" if full else "actions",
        observations="lists" if lists else "arrays",
        obs=None if observed is None else observed.values(),
        actions=actions.data if actions.kind == "array" else actions.rows(),
        rewards=np.frombuffer(b"".join(all_rewards), dtype="<f8").astype(np.float64),
        terminated=(flags & TERMINATED) != 0,
        truncated=(flags & TRUNCATED) != 0,
        infos=infos,
        obs_at=obs_at,
    )


def _frames(data: bytes) -> Iterator[bytes]:
    at = len(MAGIC)
    while True:
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if not length:
            break
        if at + length > len(data):
            raise ValueError("cut short")
        yield data[at : at + length]
        at += length
    if at != len(data):
        raise ValueError(f"{len(data) - at} bytes follow the end")


def _size(obs: object) -> int:
    """Approximate size of an observation, bytes."""
    if isinstance(obs, np.ndarray):
        return int(obs.nbytes)
    if isinstance(obs, dict):
        return sum(map(_size, obs.values()))
    if isinstance(obs, tuple):
        return sum(map(_size, obs))
    return len(obs) if isinstance(obs, str) else 8
