"""An episode as bytes: what the policy received and returned, and what came of it, step by step.

Rules that this module owns:
- The same rows give the same bytes; every number comes back bit for bit, NaN and infinities included.
- Rows are packed in blocks as they come, so an episode of pictures never lies in memory uncompressed.
- A block is columns, one for each leaf of the observation: `magic, header, {length, zstd(msgpack block)}…, 0`.
- Bytes that are not a whole trajectory of this version raise ProtocolError, whatever they are.
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

MAGIC = b"evotraj1"
BLOCK_BYTES = 4 << 20
"""Observations of about so many bytes make a block."""
BLOCK_ROWS = 16384
MAX_BLOCK_BYTES = 1 << 30
"""A block that claims to be larger is not decoded."""

_LENGTH = struct.Struct("<I")
_TERMINATED, _TRUNCATED = 1, 2
_EXT_ARRAY, _EXT_INT = 1, 2
_QUICK_BYTES = 256 << 10
"""Blocks above this are compressed at level 1: pictures, for which speed matters more."""


class Row(NamedTuple):
    """One step. `obs` is what the policy received before it, `action` what it returned."""

    t: int
    obs: Any
    """numpy array, int, str, dict or tuple (nested lists in place of arrays and tuples with `observations` "lists");
    None when observations are not recorded."""
    action: Any
    """As the policy returned it, before repair: array, plain number, string, list, dict, None (a tuple as a list where
    actions differ in form)."""
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class Trajectory(msgspec.Struct, frozen=True, kw_only=True):
    """A decoded episode of `n` steps."""

    n: int
    record: Record
    """With "actions" there are no observations and no infos, and actions are those played, after repair."""
    observations: ObservationForm
    """The form in which the policy received them."""
    obs: Any
    """Columns in the shape of the observation: a numpy array (n × the leaf's shape), or a list of strings, for each
    leaf, in dicts and tuples; None when observations are not recorded or there is no step."""
    actions: Sequence[Any] | NDArray[Any]
    """n actions; an array (n × shape) where all are arrays of one shape and dtype, else a list."""
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: list[dict[str, Any]]
    obs_at: Callable[[int], Any]
    """The observation of one step, as `Row.obs`."""

    def rows(self) -> Iterator[Row]:
        """The steps in order."""
        arrays = isinstance(self.actions, np.ndarray)  # of which indexing makes scalars where they have no axes
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
    """Takes an episode's steps one by one and packs them. Not thread-safe."""

    def __init__(self, record: Record = "full", observations: ObservationForm = "arrays") -> None:
        self._full = record == "full"
        header = _encoder.encode({"record": record, "observations": observations})
        self._parts: list[bytes] = [MAGIC, _LENGTH.pack(len(header)), header]
        self._block_rows = 0
        self._clear()

    def append(
        self, obs: Any, action: Any, reward: float, terminated: bool, truncated: bool, info: dict[str, Any]
    ) -> None:
        """Record one step. `obs` and arrays in `action` are kept, not copied: they must not change afterwards."""
        if self._full:
            self._obs.append(obs)
            self._infos.append(info)
        self._actions.append(action)
        self._rewards.append(reward)
        self._flags.append((terminated and _TERMINATED) | (truncated and _TRUNCATED))
        if len(self._rewards) >= self._block_rows:
            if self._block_rows:
                self._flush()
            else:
                # Decided at the first row: the block's size depends on the rows alone, so equal rows, equal bytes.
                size = _size(obs) if self._full else 0
                self._block_rows = max(1, min(BLOCK_ROWS, BLOCK_BYTES // max(1, size)))

    def finish(self) -> bytes:
        """The trajectory's bytes. The recorder is not used afterwards."""
        if self._rewards:
            self._flush()
        return b"".join([*self._parts, _LENGTH.pack(0)])

    def _clear(self) -> None:
        self._obs: list[Any] = []
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._flags = bytearray()
        self._infos: list[dict[str, Any]] = []

    def _flush(self) -> None:
        block = {
            "obs": _pack_column(self._obs) if self._full else None,
            "actions": _pack_column(self._actions),
            "rewards": np.array(self._rewards, dtype="<f8").tobytes(),
            "flags": bytes(self._flags),
            "infos": self._infos if any(self._infos) else len(self._infos),
        }
        packed = _encode(block)
        level = 1 if len(packed) > _QUICK_BYTES else 3
        compressed = zstandard.ZstdCompressor(level=level).compress(packed)
        self._parts += [_LENGTH.pack(len(compressed)), compressed]
        self._clear()


def decode(data: bytes) -> Trajectory:
    """The episode in `data`; ProtocolError when it is none."""
    try:
        return _decode(data)
    except (
        msgspec.DecodeError,
        zstandard.ZstdError,
        struct.error,
        ValueError,
        TypeError,
        AttributeError,
        KeyError,
        IndexError,
        OverflowError,
        RecursionError,
    ) as error:
        raise ProtocolError(f"{len(data)} bytes are not a trajectory: {error}") from error


def _decode(data: bytes) -> Trajectory:
    if data[: len(MAGIC)] != MAGIC:
        raise ValueError("they do not begin with the format's mark")
    frames = _frames(data)
    header = _decoder.decode(next(frames, b""))
    decompressor = zstandard.ZstdDecompressor()
    blocks: list[dict[str, Any]] = []
    for frame in frames:
        size = zstandard.frame_content_size(frame)
        if not 0 < size <= MAX_BLOCK_BYTES:
            raise ValueError(f"a block claims {size} bytes")
        blocks.append(_decoder.decode(decompressor.decompress(frame)))
    full = header["record"] == "full"
    lists = header["observations"] == "lists"
    observed = _join([_unpack_column(block["obs"]) for block in blocks]) if full and blocks else None
    acted = _join([_unpack_column(block["actions"]) for block in blocks]) if blocks else _Values([])
    flags = np.frombuffer(b"".join(block["flags"] for block in blocks), dtype=np.uint8)
    rewards = np.frombuffer(b"".join(block["rewards"] for block in blocks), dtype="<f8").astype(np.float64)
    infos: list[dict[str, Any]] = []
    for block in blocks:
        kept = block["infos"]
        infos += [{} for _ in range(kept)] if isinstance(kept, int) else kept
    n = len(rewards)
    lengths = {
        len(flags),
        len(acted),
        len(observed) if observed is not None else n,
        len(infos) if full else n,
    }
    if lengths != {n}:
        raise ValueError(f"columns of {n} rows have {sorted(lengths)}")
    form = _as_lists if lists else _same

    def obs_at(t: int) -> Any:
        return None if observed is None else form(observed.row(t))

    return Trajectory(
        n=n,
        record="full" if full else "actions",
        observations="lists" if lists else "arrays",
        obs=None if observed is None else observed.values(),
        actions=acted.array if isinstance(acted, _Arrays) and not acted.scalar else acted.rows(),
        rewards=rewards,
        terminated=(flags & _TERMINATED) != 0,
        truncated=(flags & _TRUNCATED) != 0,
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


# Columns: the values of one leaf over the rows of a block.


def _pack_column(values: list[Any]) -> list[Any]:
    n = len(values)
    first = values[0]
    kind = type(first)
    if kind is np.ndarray:
        if all(
            type(value) is np.ndarray and value.dtype == first.dtype and value.shape == first.shape
            for value in values
        ):
            joined = b"".join([value.tobytes() for value in values])
            return ["array", n, first.dtype.str, list(first.shape), joined]
        return ["values", values]
    if any(type(value) is not kind for value in values):
        return ["values", values]
    if kind is int:
        if all(-(2**63) <= value < 2**63 for value in values):
            return ["scalar", "<i8", np.array(values, dtype="<i8").tobytes()]
    elif kind is float:
        return ["scalar", "<f8", np.array(values, dtype="<f8").tobytes()]
    elif kind is str:
        found: dict[str, int] = {}
        where = [found.setdefault(value, len(found)) for value in values]
        return ["text", list(found), np.array(where, dtype="<u4").tobytes()]
    elif kind is dict:
        keys = list(first)
        if all(type(key) is str for key in keys) and all(list(value) == keys for value in values):
            return ["dict", n, keys, [_pack_column([value[key] for value in values]) for key in keys]]
    elif kind is tuple and all(len(value) == len(first) for value in values):
        return ["tuple", n, [_pack_column([value[k] for value in values]) for k in range(len(first))]]
    return ["values", values]


class _Column:
    """Rows of one leaf, or of a dict or tuple of leaves."""

    def __len__(self) -> int:
        raise NotImplementedError

    def row(self, t: int) -> Any:
        raise NotImplementedError

    def values(self) -> Any:
        """The column in the form that `Trajectory.obs` promises."""
        raise NotImplementedError

    def rows(self) -> list[Any]:
        return [self.row(t) for t in range(len(self))]


class _Arrays(_Column):
    """Arrays of one shape, or Python numbers of one type."""

    def __init__(self, array: NDArray[Any], *, scalar: bool) -> None:
        self.array = array
        self.scalar = scalar

    def __len__(self) -> int:
        return len(self.array)

    def row(self, t: int) -> Any:
        return self.array[t].item() if self.scalar else np.asarray(self.array[t])

    def values(self) -> Any:
        return self.array


class _Values(_Column):
    """Anything, a value a row."""

    def __init__(self, items: list[Any]) -> None:
        self._items = items

    def __len__(self) -> int:
        return len(self._items)

    def row(self, t: int) -> Any:
        return self._items[t]

    def values(self) -> Any:
        return self._items


class _Dicts(_Column):
    def __init__(self, parts: dict[str, _Column], n: int) -> None:
        self.parts = parts
        self._n = n
        _require_equal(n, list(parts.values()))

    def __len__(self) -> int:
        return self._n

    def row(self, t: int) -> Any:
        return {key: part.row(t) for key, part in self.parts.items()}

    def values(self) -> Any:
        return {key: part.values() for key, part in self.parts.items()}


class _Tuples(_Column):
    def __init__(self, parts: list[_Column], n: int) -> None:
        self.parts = parts
        self._n = n
        _require_equal(n, parts)

    def __len__(self) -> int:
        return self._n

    def row(self, t: int) -> Any:
        return tuple(part.row(t) for part in self.parts)

    def values(self) -> Any:
        return tuple(part.values() for part in self.parts)


def _require_equal(n: int, parts: list[_Column]) -> None:
    if any(len(part) != n for part in parts):
        raise ValueError(f"columns of {n} rows have {[len(part) for part in parts]}")


def _unpack_column(packed: list[Any]) -> _Column:
    kind = packed[0]
    if kind == "array":
        _, n, dtype, shape, data = packed
        return _Arrays(_array(dtype, data).reshape(n, *shape), scalar=False)
    if kind == "scalar":
        return _Arrays(_array(packed[1], packed[2]), scalar=True)
    if kind == "text":
        return _Values([packed[1][index] for index in _array("<u4", packed[2])])
    if kind == "dict":
        _, n, keys, parts = packed
        return _Dicts(dict(zip(keys, map(_unpack_column, parts), strict=True)), n)
    if kind == "tuple":
        return _Tuples([_unpack_column(part) for part in packed[2]], packed[1])
    if kind == "values":
        return _Values(packed[1])
    raise ValueError(f"unknown kind of column {kind!r}")


def _join(columns: list[_Column]) -> _Column:
    """The columns of successive blocks as one."""
    first = columns[0]
    if len(columns) == 1:
        return first
    if isinstance(first, _Arrays) and all(
        isinstance(column, _Arrays)
        and (column.scalar, column.array.dtype, column.array.shape[1:])
        == (first.scalar, first.array.dtype, first.array.shape[1:])
        for column in columns
    ):
        return _Arrays(np.concatenate([column.values() for column in columns]), scalar=first.scalar)
    n = sum(map(len, columns))
    dicts = [column for column in columns if isinstance(column, _Dicts)]
    if len(dicts) == len(columns) and all(list(column.parts) == list(dicts[0].parts) for column in dicts):
        return _Dicts({key: _join([column.parts[key] for column in dicts]) for key in dicts[0].parts}, n)
    tuples = [column for column in columns if isinstance(column, _Tuples)]
    if len(tuples) == len(columns) and all(len(column.parts) == len(tuples[0].parts) for column in tuples):
        width = len(tuples[0].parts)
        return _Tuples([_join([column.parts[k] for column in tuples]) for k in range(width)], n)
    return _Values([item for column in columns for item in column.rows()])


# Values that msgpack has no form for.


def _array(dtype: str, data: bytes) -> NDArray[Any]:
    kind = np.dtype(dtype)
    if kind.kind not in "biuf":
        raise ValueError(f"no columns of dtype {dtype!r}")
    return np.frombuffer(data, dtype=kind)


def _enc_hook(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        head = [value.dtype.str, list(value.shape), value.tobytes()]
        return msgspec.msgpack.Ext(_EXT_ARRAY, _encoder.encode(head))
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)


def _ext_hook(code: int, data: memoryview) -> Any:
    if code == _EXT_ARRAY:
        dtype, shape, raw = _decoder.decode(data)
        return _array(dtype, raw).reshape(shape)
    if code == _EXT_INT:
        return int(bytes(data))
    raise ValueError(f"unknown extension {code}")


_encoder = msgspec.msgpack.Encoder(enc_hook=_enc_hook)
_decoder = msgspec.msgpack.Decoder(ext_hook=_ext_hook)


def _encode(block: dict[str, Any]) -> bytes:
    try:
        return _encoder.encode(block)
    except (OverflowError, UnicodeEncodeError, TypeError):
        # Only hostile policies return what msgpack cannot say: integers beyond 64 bits, half surrogates.
        return _encoder.encode(_portable(block))


def _portable(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return msgspec.msgpack.Ext(_EXT_INT, str(value).encode())
    if isinstance(value, dict):
        return {_portable_key(key): _portable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_portable(item) for item in value]
    return value


def _portable_key(key: Any) -> Any:
    return _portable(key) if isinstance(key, str) else str(key)


def _size(obs: Any) -> int:
    """Bytes of an observation, roughly."""
    if isinstance(obs, np.ndarray):
        return int(obs.nbytes)
    if isinstance(obs, dict):
        return sum(map(_size, obs.values()))
    if isinstance(obs, tuple):
        return sum(map(_size, obs))
    return len(obs) if isinstance(obs, str) else 8


def _same(value: Any) -> Any:
    return value


def _as_lists(value: Any) -> Any:
    """What a policy that asked for lists received."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _as_lists(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_as_lists(item) for item in value]
    return value
