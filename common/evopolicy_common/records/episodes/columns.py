"""Columns of a trajectory's block: the values of one leaf over its rows, to and from msgpack.

Numbers are restored bit for bit. Values that msgpack cannot represent (arrays, integers beyond 64 bits, lone
surrogates) become an extension or readable text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

MAX_COLUMN_BYTES = 1 << 28
"""Limit of a column of pictures, bytes; a column that claims more is not decoded."""
MAX_ROWS = 16384
"""Most rows of one block."""
MAX_AXES = 32
"""Most axes of one array."""
MAX_EMPTY = 1 << 16
"""Limit for an array without numbers, such as one of shape (n, 0): the number of empty lists that represent it."""

_EXT_ARRAY, _EXT_INT = 1, 2
_ZSTD_BLOCK_BYTES, _ZSTD_LEAST_BYTES = 128 << 10, 4
"""A zstd block holds at most 128 KiB and takes at least 4 bytes."""


def pack(values: list[Any]) -> list[Any]:
    """Packs the rows of one leaf as a list for msgpack: the kind of column, then all its values."""
    n = len(values)
    first = values[0]
    kind = type(first)
    if set(map(type, values)) != {kind}:
        return ["values", values]
    if kind is np.ndarray:
        if all(value.dtype == first.dtype and value.shape == first.shape for value in values):
            _check_shape(first.shape)
            joined = b"".join([value.tobytes() for value in values])
            return ["array", n, first.dtype.str, list(first.shape), joined]
    elif kind is int:
        if min(values) >= -(2**63) and max(values) < 2**63:
            return ["scalar", "<i8", np.array(values, dtype="<i8").tobytes()]
    elif kind is float:
        return ["scalar", "<f8", np.array(values, dtype="<f8").tobytes()]
    elif kind is str:
        texts: dict[str, int] = {}
        indices = [texts.setdefault(value, len(texts)) for value in values]
        return ["text", list(texts), np.array(indices, dtype="<u4").tobytes()]
    elif kind is dict:
        keys = list(first)
        if all(type(key) is str for key in keys) and all(list(value) == keys for value in values):
            return ["dict", n, keys, [pack([value[key] for value in values]) for key in keys]]
    elif kind is tuple and all(len(value) == len(first) for value in values):
        return ["tuple", n, [pack([value[k] for value in values]) for k in range(len(first))]]
    return ["values", values]


class Pictures:
    """A column of large arrays of one shape and dtype, compressed one by one."""

    def __init__(self, first: NDArray[Any]) -> None:
        _check_shape(first.shape)
        self._dtype = first.dtype
        self._shape = first.shape
        self._n = 0
        self._stream = zstandard.ZstdCompressor(level=1).compressobj()
        self._pieces: list[bytes] = []

    def add(self, picture: object, /) -> bool:
        """Adds a picture. Returns True, without a change, when its shape or dtype differs from the first."""
        if type(picture) is not np.ndarray or picture.dtype != self._dtype or picture.shape != self._shape:
            return True
        self._pieces.append(self._stream.compress(np.ascontiguousarray(picture).data))
        self._n += 1
        return False

    def packed(self) -> list[Any]:
        """The packed column. Nothing may be added afterwards."""
        data = b"".join([*self._pieces, self._stream.flush()])
        return ["pictures", self._n, self._dtype.str, list(self._shape), data]


class StepColumn:
    """Rows of one leaf, or of a dict or tuple of columns."""

    def __init__(
        self, kind: Literal["array", "scalar", "values", "dict", "tuple"], data: Any, n: int
    ) -> None:
        """`data`, by kind: an array of arrays' or Python numbers' rows, a list of any values, or the columns of a dict
        or tuple by key or position. Raises ValueError when these do not have `n` rows each."""
        self.kind, self.data, self.n = kind, data, n
        if kind in ("dict", "tuple") and (type(n) is not int or any(part.n != n for part in data.values())):
            raise ValueError(f"columns of {n} rows have {[part.n for part in data.values()]}")

    def row(self, t: int) -> Any:
        """The value in row t."""
        if self.kind == "array":
            return np.asarray(self.data[t])
        if self.kind == "scalar":
            return self.data[t].item()
        return self.data[t] if self.kind == "values" else self._each(lambda part: part.row(t))

    def rows(self) -> list[Any]:
        if self.kind == "scalar":
            return list(self.data.tolist())
        # The rows of an array of one axis would be numbers.
        if self.kind == "array" and self.data.ndim > 1:
            return list(self.data)
        return [self.row(t) for t in range(self.n)]

    def values(self) -> Any:
        """The column in the form described at `Trajectory.obs`."""
        return self._each(StepColumn.values) if self.kind in ("dict", "tuple") else self.data

    def form(self) -> object:
        """Equal for columns that can be joined as they are."""
        if isinstance(self.data, np.ndarray):
            return self.kind, self.data.dtype, self.data.shape[1:]
        return self.kind, tuple(self.data) if isinstance(self.data, dict) else ()

    def _each(self, made_of: Callable[[StepColumn], Any]) -> Any:
        parts = {key: made_of(part) for key, part in self.data.items()}
        return parts if self.kind == "dict" else tuple(parts.values())


def leaves(values: object, path: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of `StepColumn.values()` by path: keys and positions joined by `/`; empty for a single leaf."""
    if isinstance(values, dict):
        for key, item in values.items():
            yield from leaves(item, f"{path}/{key}" if path else str(key))
    elif isinstance(values, tuple):
        for index, item in enumerate(values):
            yield from leaves(item, f"{path}/{index}" if path else str(index))
    else:
        yield path, values


def unpack(packed: list[Any], *, pictures: bool = False) -> StepColumn:
    """Unpacks the output of `pack` or, with `pictures`, of `Pictures.packed`. Raises ValueError for anything else."""
    kind = packed[0]
    if kind == "array" or (kind == "pictures" and pictures):
        _, n, dtype, shape, data = packed
        if kind == "pictures":
            _check_shape((n, *shape))
            size = n * _dtype(dtype).itemsize * math.prod(shape)
            if not 0 < size <= min(MAX_COLUMN_BYTES, most_of(data)):
                raise ValueError(f"{len(data)} bytes that claim to be pictures of {size} bytes")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        return StepColumn("array", _shaped(_array(dtype, data), shape, n), n)
    if kind == "scalar":
        numbers = _array(packed[1], packed[2])
        return StepColumn("scalar", numbers, len(numbers))
    if kind == "text":
        texts = [packed[1][index] for index in _array("<u4", packed[2])]
        return StepColumn("values", texts, len(texts))
    if kind == "dict":
        _, n, keys, parts = packed
        return StepColumn("dict", dict(zip(keys, map(unpack, parts), strict=True)), n)
    if kind == "tuple":
        return StepColumn("tuple", dict(enumerate(map(unpack, packed[2]))), packed[1])
    if kind == "values":
        return StepColumn("values", packed[1], len(packed[1]))
    raise ValueError(f"unknown kind of column {kind!r}")


def join(columns: list[StepColumn]) -> StepColumn:
    """Joins the columns of successive blocks."""
    first, n = columns[0], sum(column.n for column in columns)
    if len(columns) == 1:
        return first
    if first.kind != "values" and len({column.form() for column in columns}) == 1:
        parts = [column.data for column in columns]
        if isinstance(first.data, dict):
            return StepColumn(first.kind, {key: join([part[key] for part in parts]) for key in first.data}, n)
        return StepColumn(first.kind, np.concatenate(parts), n)
    return StepColumn("values", [item for column in columns for item in column.rows()], n)


# Values that msgpack cannot represent.


def most_of(compressed: bytes | memoryview) -> int:
    """Upper bound of the content of a zstd frame, bytes. Needed because the claimed size is allocated at once."""
    return (len(compressed) // _ZSTD_LEAST_BYTES + 1) * _ZSTD_BLOCK_BYTES


def count_values(packed: bytes, most: int) -> int:
    """Values in a msgpack text, counted up to `most` + 1 in one pass, however they nest; each may take 72
    bytes."""
    n, at, end = 0, 0, len(packed)
    while at < end and n <= most:
        head, (fixed, counted) = packed[at], _SIZES[packed[at]]
        at += 1
        if counted:
            fixed += int.from_bytes(packed[at : at + counted], "big") + counted
        elif 0xA0 <= head < 0xC0:
            fixed = head & 0x1F
        at += fixed
        n += 1
    return n


_SIZES = [(0, 0)] * 256
"""By a value's first byte: the number of bytes after it, and the width of a length field that counts further ones."""
for _first, _widths in (
    (0xCA, (4, 8, 1, 2, 4, 8, 1, 2, 4, 8)),
    (0xD4, (2, 3, 5, 9, 17)),
    (0xDC, (2, 4, 2, 4)),  # lists and maps: their items follow
):
    for _k, _fixed in enumerate(_widths):
        _SIZES[_first + _k] = _fixed, 0
for _first, _extra in ((0xC4, 0), (0xC7, 1), (0xD9, 0)):
    for _k, _counted in enumerate((1, 2, 4)):
        _SIZES[_first + _k] = _extra, _counted


def _check_shape(shape: Sequence[int]) -> None:
    """Raises ValueError for a shape with too many axes, or with too many empty lists."""
    if len(shape) > MAX_AXES or any(type(n) is not int or n < 0 for n in shape):
        raise ValueError(f"an array of shape {str(list(shape))[:200]}")
    if 0 in shape and math.prod(max(1, n) for n in shape) > MAX_EMPTY:
        raise ValueError(f"an array of shape {tuple(shape)}: {MAX_EMPTY:,} empty lists are the limit")


def _shaped(array: NDArray[Any], shape: Sequence[int], n: int) -> NDArray[Any]:
    """`array` reshaped to `n` rows of that shape. Raises ValueError when it cannot be."""
    if type(n) is not int or not 0 <= n <= MAX_ROWS:
        raise ValueError(f"a column of {n} rows; {MAX_ROWS:,} are the limit")
    _check_shape(shape)
    return array.reshape(n, *shape)


def _dtype(name: str) -> np.dtype[Any]:
    kind = np.dtype(name) if type(name) is str and len(name) <= 8 else None
    if kind is None or kind.kind not in "biuf":
        raise ValueError(f"no columns of dtype {str(name)[:80]!r}")
    return kind


def _array(dtype: str, data: bytes) -> NDArray[Any]:
    return np.frombuffer(data, dtype=_dtype(dtype))


def _enc_hook(value: object) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        _check_shape(value.shape)
        head = [value.dtype.str, list(value.shape), value.tobytes()]
        return msgspec.msgpack.Ext(_EXT_ARRAY, encoder.encode(head))
    if isinstance(value, np.longdouble | np.clongdouble):  # of which `tolist` makes no number of Python's
        return float(value.real)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)


def _ext_hook(code: int, data: memoryview) -> Any:
    if code == _EXT_ARRAY:
        dtype, shape, raw = decoder.decode(data)
        _check_shape(shape)
        return _array(dtype, raw).reshape(shape)
    if code == _EXT_INT:
        return int(bytes(data))
    raise ValueError(f"unknown extension {code}")


encoder = msgspec.msgpack.Encoder(enc_hook=_enc_hook)
decoder = msgspec.msgpack.Decoder(ext_hook=_ext_hook)


def encode(block: object) -> bytes:
    """Encodes a block, or another value made of plain ones and arrays."""
    try:
        return encoder.encode(block)
    except (OverflowError, UnicodeEncodeError, TypeError):
        # Only hostile policies return values that msgpack cannot represent: integers beyond 64 bits, lone surrogates.
        return encoder.encode(_portable(block))


def _portable(value: object) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return msgspec.msgpack.Ext(_EXT_INT, str(value).encode())
    if isinstance(value, dict):
        return {_portable(str(key)): _portable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_portable(item) for item in value]
    return value
