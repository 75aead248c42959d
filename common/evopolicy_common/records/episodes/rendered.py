"""An episode as its feedback files, rendered where it was played: the receiver only checks and unpacks them.

Rules that this module owns:
- The same steps give the same bytes. The rows are those of `json_text.rows_text`; observations outside the rows are one
  `.npz` file.
- Beside the files is the log of actions, rewards and flags, as a trajectory with record "actions": the
  actions bit for bit as they were returned. The log contains nothing that the files do not.
- Rows are compressed by blocks. Arrays outside the rows are held until the end, since a policy can measure the time
  between its calls; beyond `HELD_BYTES`, each that arrives has the oldest ones compressed.
- Received bytes are not trusted: sizes are checked against the limits before anything is unpacked, and the rows against
  the declared length and return.
- Layout: `magic, {length, header}, {length, log}, {length, file}…`.
"""

from __future__ import annotations

import functools
import operator
import struct
import threading
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, Literal, cast

import msgspec
import numpy as np
import zstandard

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.environment import ObservationForm, ObsStorage
from evopolicy_common.records.episodes import columns, trajectory
from evopolicy_common.records.episodes.npz import NpzWriter, check_archive
from evopolicy_common.records.episodes.trajectory import Recorder, Row, Trajectory
from evopolicy_common.records.json_text import as_lists, rows_text

MAGIC = b"evofeed1"
ROWS: Final = "trajectory.jsonl"
OBSERVATIONS: Final = "observations.npz"
LEFT_OUT: Final = "left_out.txt"
SINGLE = "observations"
"""Array name for observations that are one array per step."""
MAX_ROWS_BYTES = 256 << 20
"""Limit of `trajectory.jsonl`, bytes. Actions alone cannot reach it: see `ResourceLimits.episode_action_bytes`."""
MAX_OBSERVATIONS_BYTES = 1 << 30
"""Limit of a file of observations that is read, bytes; the published profiles have them uncompressed."""
MAX_RECORDED_BYTES = 256 << 20
"""Limit of the `observations.npz` of an episode, bytes; one that needs more has its rows alone."""
MIN_PICTURE_SIDE = 16
"""Least height and width of a picture; smaller arrays of bytes count as symbols."""

HELD_BYTES = 32 << 20
"""Limit of the arrays that wait for the end of their episode, bytes. 1,000 frames of CarRacing take 28 MB."""

_LENGTH = struct.Struct("<I")
_MAX_HEADER_BYTES = 4096
_STEPS_AT_ONCE = 256
_ROWS_AT_ONCE = 1 << 20
"""Bytes of rows checked at once."""
_ODD = (
    *DECODE_ERRORS,
    zstandard.ZstdError,
    zipfile.BadZipFile,
    struct.error,
    ValueError,
    OverflowError,
    RecursionError,
)


class FeedbackFile(msgspec.Struct, frozen=True, kw_only=True):
    """One feedback file in the container."""

    name: Literal["trajectory.jsonl", "observations.npz"]
    size: int
    """Size of the unpacked file, bytes."""
    packed: Literal["zstd", "as it is"]


class Header(msgspec.Struct, frozen=True, kw_only=True):
    observations: ObservationForm
    n: int
    """Number of steps."""
    files: tuple[FeedbackFile, ...]
    left_out: str = ""
    """Why there are no files, or only the rows; empty when nothing is missing."""


_headers = msgspec.msgpack.Decoder(Header)
_local = threading.local()
"""The thread's decompressor, which only one thread may use at a time."""


class Renderer(Recorder):
    """A `Recorder` that produces the feedback files and the log of actions."""

    def __init__(self, observations: ObservationForm, storage: ObsStorage) -> None:
        """`storage`: where observations are kept; every value except "inline" means `observations.npz`."""
        super().__init__("actions", observations)
        self._form: ObservationForm = observations
        # Observations are kept for a block, until they are rendered.
        self._full = True
        self._npz = None if storage == "inline" else NpzWriter(MAX_RECORDED_BYTES)
        self._held: deque[tuple[str, np.ndarray[Any, Any] | list[Any]]] = deque()
        self._held_bytes = 0
        self._compressor = zstandard.ZstdCompressor(level=1).compressobj()
        self._rows: list[bytes] = []
        self._rows_size = 0
        self._left_out = self._unstored = ""
        """Why there are no rows, and so no files; why there are no observations."""

    def finish(self) -> bytes:
        """The container's bytes. The recorder must not be used afterwards."""
        log = super().finish()
        self._compress_held(0)
        files = [] if self._left_out else list(self._files())
        header = Header(
            observations=self._form,
            n=self._n_packed,
            files=tuple(file for file, _ in files),
            left_out=(self._left_out or self._unstored)[:1000],
        )
        parts = [[columns.encoder.encode(header)], [log], *(pieces for _, pieces in files)]
        return b"".join(
            [MAGIC, *(piece for part in parts for piece in (_LENGTH.pack(sum(map(len, part))), *part))]
        )

    def _files(self) -> Iterator[tuple[FeedbackFile, list[bytes]]]:
        """The files in pieces: once joined, each takes its memory again."""
        yield (
            FeedbackFile(name=ROWS, size=self._rows_size, packed="zstd"),
            [*self._rows, self._compressor.flush()],
        )
        if self._npz is None or self._unstored or not self._n_packed:
            return
        try:
            pieces = self._npz.finish()
        except ProtocolError as error:
            self._unstored = str(error)
        else:
            yield FeedbackFile(name=OBSERVATIONS, size=sum(map(len, pieces)), packed="as it is"), pieces

    def _taker(self, obs: Any, is_picture: bool) -> Callable[[Any], bool | None]:
        # Arrays are held outside the block: a block of pictures would be large.
        return self._take_array if self._npz is not None and isinstance(obs, np.ndarray) else self._obs.append

    def _take_array(self, obs: object) -> bool:
        if isinstance(obs, np.ndarray):
            self._hold(SINGLE, obs[np.newaxis])
            return False
        return True

    def _flush(self) -> None:
        first = self._n_packed
        block = columns.decoder.decode(self._add_block(None, 0))
        if not self._left_out:
            self._render(first, block)
        self._clear()

    def _render(self, first: int, block: dict[str, Any]) -> None:
        """Renders the block's rows as text, and its observations where they are stored outside the rows."""
        obs: list[Any] | None = self._obs
        if self._npz is not None:
            if self._obs:
                for name, leaf in columns.leaves(columns.unpack(columns.pack(self._obs)).values()):
                    self._hold(name or SINGLE, leaf)
            obs = None
        elif self._form == "lists":
            obs = as_lists(self._obs)
        _, rewards, flags, infos = map(list, zip(*self._steps, strict=True))
        ends = [[bool(flag & bit) for flag in flags] for bit in (trajectory.TERMINATED, trajectory.TRUNCATED)]
        steps = (obs, columns.unpack(block["actions"]).rows(), rewards, *ends, infos)
        try:
            for text in _texts(steps, first, self._rows_size):
                self._rows_size += len(text)
                self._rows.append(self._compressor.compress(text))
        except ProtocolError as error:
            self._left_out = str(error)

    def _hold(self, name: str, rows: np.ndarray[Any, Any] | list[Any]) -> None:
        self._held.append((name, rows))
        self._held_bytes += getattr(rows, "nbytes", 0)
        if self._held_bytes > HELD_BYTES:
            self._compress_held(HELD_BYTES)

    def _compress_held(self, most: int) -> None:
        """Adds the oldest arrays to the file, until at most that many bytes are held."""
        while self._held and (self._held_bytes > most or not most):
            name, rows = self._held.popleft()
            self._held_bytes -= getattr(rows, "nbytes", 0)
            if self._npz is None or self._left_out or self._unstored:
                continue
            try:
                self._npz.add(name, rows)
            except (ProtocolError, ValueError) as error:
                self._unstored = str(error)


def _texts(steps: Sequence[Sequence[Any] | None], first: int, size: int) -> Iterator[bytes]:
    """The lines of steps (columns of `rows_text`) from `first` on, in portions, since a short action may have
    a long text. Raises ProtocolError when `size` plus their bytes exceeds the limit."""
    for at in range(0, len(steps[-1] or ()), _STEPS_AT_ONCE):
        part = [None if column is None else column[at : at + _STEPS_AT_ONCE] for column in steps]
        text = rows_text(first + at, *part)  # type: ignore[arg-type]
        size += len(text)
        if size > MAX_ROWS_BYTES:
            raise ProtocolError(
                f"step {first + at} brings {ROWS} to {size:,} bytes; {MAX_ROWS_BYTES:,} are the limit"
            )
        yield text


class Container:
    """The parts of a rendered episode, still packed. Raises ProtocolError when `data` is not a rendered episode."""

    def __init__(self, data: bytes) -> None:
        try:
            parts = _parts(data)
            self.header = _headers.decode(parts[0])
        except _ODD as error:
            raise ProtocolError(f"{len(data)} bytes are no rendered episode: {error}") from error
        if len({file.name for file in self.header.files}) != len(parts) - 2:
            raise ProtocolError(
                f"a rendered episode of {len(parts)} parts says that it has {len(self.header.files)} files"
            )
        self.log = parts[1]
        """The log of actions, as a trajectory."""
        self._files = dict(zip(self.header.files, parts[2:], strict=True))

    @property
    def size(self) -> int:
        """Size of the unpacked files, as the header states it, bytes."""
        return sum(file.size for file in self.header.files)

    def files(self) -> dict[str, bytes]:
        """The unpacked files by name. Raises ProtocolError when they are missing, too large, or of another size."""
        if not self._files:
            raise ProtocolError(self.header.left_out or "a rendered episode without files")
        try:
            return {file.name: _unpacked(file, data) for file, data in self._files.items()}
        except _ODD as error:
            raise ProtocolError(f"the files of a rendered episode cannot be unpacked: {error}") from error


def is_rendered(data: bytes) -> bool:
    """Whether `data` is a rendered episode, by its magic bytes; a trajectory has others."""
    return data[: len(MAGIC)] == MAGIC


def decode(data: bytes) -> Trajectory:
    """Decodes a trajectory or a rendered episode. Raises ProtocolError when `data` is neither."""
    if not is_rendered(data):
        return trajectory.decode(data)
    container = Container(data)
    log = trajectory.decode(bytes(container.log))
    if log.n != container.header.n:
        raise ProtocolError(f"a rendered episode of {container.header.n} steps has a log of {log.n}")
    # Without files only the log remains.
    files = container.files() if container.header.files or not container.header.left_out else {}
    return msgspec.structs.replace(
        log, record="full" if files else "actions", observations=container.header.observations, files=files
    )


def checked_files(data: bytes, length: int, episode_return: float) -> dict[str, bytes]:
    """The feedback files of a rendered episode; `left_out.txt` says why observations are missing. Raises ProtocolError
    when they do not match that length and return."""
    container = Container(data)
    files = container.files()
    rewards = _rewards(files.get(ROWS, b""))
    # In the same order as on the worker, as floating-point sums depend on it; `sum` would compensate.
    total = functools.reduce(operator.add, rewards, 0.0)
    if (len(rewards), total) != (length, episode_return):
        raise ProtocolError(
            f"{ROWS} has {len(rewards)} rows whose rewards come to {total!r}; {length} and {episode_return!r} were"
            " declared"
        )
    if why := container.header.left_out:
        files[LEFT_OUT] = f"{OBSERVATIONS} is left out: {why}\n".encode()
    return files


def _rewards(rows: bytes) -> list[float]:
    """The rewards of all rows. Raises ProtocolError for a line that is no row, or not the next one."""
    rewards: list[float] = []
    view, at = memoryview(rows), 0
    while at < len(rows):
        end = rows.rfind(b"\n", at, at + _ROWS_AT_ONCE) + 1 or rows.find(b"\n", at) + 1 or len(rows)
        try:
            some = _rows_decoder.decode_lines(view[at:end])
        except (msgspec.DecodeError, RecursionError) as error:
            raise ProtocolError(f"{ROWS} cannot be read after step {len(rewards)}: {error}") from error
        for n, row in enumerate(some, len(rewards)):
            if row.t != n:
                raise ProtocolError(f"row {n} of {ROWS} says that it is of step {row.t}")
        rewards += [row.reward for row in some]
        at = end
    return rewards


class _Row(msgspec.Struct):
    """The checked fields of a row; the rest is skipped."""

    t: int
    reward: float


_rows_decoder = msgspec.json.Decoder(_Row)


def files_of(episode: Trajectory, storage: ObsStorage | None) -> dict[str, bytes]:
    """The feedback files. `storage` None: chosen by the observations. Raises ProtocolError beyond the
    limit."""
    if episode.files:
        return episode.files
    outside = storage != "inline"
    if storage is None:
        arrays = [leaf for _, leaf in columns.leaves(episode.obs) if isinstance(leaf, np.ndarray)]
        outside = any(is_picture(leaf.shape[1:], leaf.dtype.name) for leaf in arrays)
    _, obs, *others = zip(*episode.rows(), strict=True) if episode.n else ((),) * len(Row._fields)
    files = {ROWS: b"".join(_texts([None if outside else obs, *others], 0, 0))}
    if outside and episode.obs is not None:
        npz = NpzWriter()
        for name, leaf in columns.leaves(episode.obs):
            npz.add(name or SINGLE, leaf)
        files[OBSERVATIONS] = b"".join(npz.finish())
    return files


def is_picture(shape: tuple[int, ...], dtype: str) -> bool:
    """Whether such arrays are pictures: uint8 of height × width, optionally stacked, with channels, or both."""
    if dtype != "uint8" or not 2 <= len(shape) <= 4:
        return False
    channels = len(shape) > 2 and shape[-1] < MIN_PICTURE_SIDE
    return min(shape[-3:-1] if channels else shape[-2:]) >= MIN_PICTURE_SIDE


def _parts(data: bytes) -> list[memoryview]:
    if not is_rendered(data):
        raise ValueError("they do not begin with the format's mark")
    parts: list[memoryview] = []
    view = memoryview(data)
    at = len(MAGIC)
    while at < len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        if at + length > len(data) or len(parts) > 4 or (not parts and length > _MAX_HEADER_BYTES):
            raise ValueError("cut short, or of too many parts")
        parts.append(view[at : at + length])
        at += length
    if len(parts) < 2:
        raise ValueError("cut short")
    return parts


def _unpacked(file: FeedbackFile, data: memoryview) -> bytes:
    most = MAX_ROWS_BYTES if file.name == ROWS else MAX_OBSERVATIONS_BYTES
    if not 0 <= file.size <= most:
        raise ValueError(f"{file.name} of {file.size:,} bytes; {most:,} are the limit")
    if file.packed == "as it is":
        # Arrays may have a gigabyte, which lies in a file at the gateway: a view of them does.
        content = cast(bytes, data) if file.name == OBSERVATIONS else bytes(data)
    elif not file.size:
        return b""
    elif file.size > columns.most_of(data) or zstandard.frame_content_size(data) not in (-1, file.size):
        raise ValueError(f"{len(data)} bytes cannot hold {file.name} of {file.size:,}")
    else:
        if not hasattr(_local, "zstd"):
            _local.zstd = zstandard.ZstdDecompressor()
        content = _local.zstd.decompress(data, max_output_size=file.size)
    if len(content) != file.size:
        raise ValueError(f"{file.name} has {len(content):,} bytes, {file.size:,} were declared")
    if file.name == OBSERVATIONS:
        check_archive(content, trajectory.MAX_BYTES)
    return content
