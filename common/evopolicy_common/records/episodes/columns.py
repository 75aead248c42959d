"""Columns of a trajectory's block: the values of one leaf over its rows, to and from msgpack.

Numbers are restored bit for bit. Values that msgpack cannot represent (arrays, integers beyond 64 bits, lone
surrogates) become an extension or readable text.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

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
    if any(type(value) is not kind for value in values):
        return ["values", values]
    if kind is np.ndarray:
        if all(value.dtype == first.dtype and value.shape == first.shape for value in values):
            _check_shape(first.shape)
            joined = b"".join([value.tobytes() for value in values])
            return ["array", n, first.dtype.str, list(first.shape), joined]
    elif kind is int:
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

    def add(self, picture: Any, /) -> bool:
        """Adds a picture. Returns False, without a change, when its shape or dtype differs from the first."""
        if type(picture) is not np.ndarray or picture.dtype != self._dtype or picture.shape != self._shape:
            return False
        piece = self._stream.compress(np.ascontiguousarray(picture).data)
        if piece:
            self._pieces.append(piece)
        self._n += 1
        return True

    def packed(self) -> list[Any]:
        """The packed column. Nothing may be added afterwards."""
        data = b"".join([*self._pieces, self._stream.flush()])
        return ["pictures", self._n, self._dtype.str, list(self._shape), data]


class Column(ABC):
    """Rows of one leaf, or of a dict or tuple of leaves."""

    @abstractmethod
    def __len__(self) -> int:
        """The number of rows."""

    @abstractmethod
    def row(self, t: int) -> Any:
        """The value of the leaf, dict or tuple in row t."""

    @abstractmethod
    def values(self) -> Any:
        """The column in the form described at `Trajectory.obs`."""

    def rows(self) -> list[Any]:
        """All rows, one by one."""
        return [self.row(t) for t in range(len(self))]


class Arrays(Column):
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


class Values(Column):
    """Arbitrary values, one per row."""

    def __init__(self, items: list[Any]) -> None:
        self._items = items

    def __len__(self) -> int:
        return len(self._items)

    def row(self, t: int) -> Any:
        return self._items[t]

    def values(self) -> Any:
        return self._items


class Parts(Column):
    """Rows that are dicts of the same keys, or tuples of one length, whose keys are positions: a column for each
    key."""

    def __init__(self, parts: dict[Any, Column], n: int, *, named: bool) -> None:
        self.parts = parts
        self.named = named
        self._n = n
        if any(len(part) != n for part in parts.values()):
            raise ValueError(f"columns of {n} rows have {[len(part) for part in parts.values()]}")

    def __len__(self) -> int:
        return self._n

    def row(self, t: int) -> Any:
        return self._joined({key: part.row(t) for key, part in self.parts.items()})

    def values(self) -> Any:
        return self._joined({key: part.values() for key, part in self.parts.items()})

    def _joined(self, found: dict[Any, Any]) -> Any:
        return found if self.named else tuple(found.values())


def leaves(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of `Column.values()` by path: keys and positions joined by `/`; a single leaf has an empty path."""
    if isinstance(values, dict):
        for key, item in values.items():
            yield from leaves(item, f"{path}/{key}" if path else str(key))
    elif isinstance(values, tuple):
        for index, item in enumerate(values):
            yield from leaves(item, f"{path}/{index}" if path else str(index))
    else:
        yield path, values


def unpack(packed: list[Any], *, pictures: bool = False) -> Column:
    """Unpacks the output of `pack` or, with `pictures`, of `Pictures.packed`. Raises ValueError for anything else."""
    kind = packed[0]
    if kind == "array":
        _, n, dtype, shape, data = packed
        return Arrays(_shaped(_array(dtype, data), shape, n), scalar=False)
    if kind == "pictures" and pictures:
        _, n, dtype, shape, data = packed
        _check_shape((n, *shape))
        size = n * _dtype(dtype).itemsize * math.prod(shape)
        if not 0 < size <= min(MAX_COLUMN_BYTES, most_of(data)):
            raise ValueError(f"{len(data)} bytes that claim to be pictures of {size} bytes")
        raw = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        return Arrays(_shaped(_array(dtype, raw), shape, n), scalar=False)
    if kind == "scalar":
        return Arrays(_array(packed[1], packed[2]), scalar=True)
    if kind == "text":
        return Values([packed[1][index] for index in _array("<u4", packed[2])])
    if kind == "dict":
        _, n, keys, parts = packed
        return Parts(dict(zip(keys, map(unpack, parts), strict=True)), n, named=True)
    if kind == "tuple":
        return Parts(dict(enumerate(map(unpack, packed[2]))), packed[1], named=False)
    if kind == "values":
        return Values(packed[1])
    raise ValueError(f"unknown kind of column {kind!r}")


def join(columns: list[Column]) -> Column:
    """Joins the columns of successive blocks."""
    first = columns[0]
    if len(columns) == 1:
        return first
    if isinstance(first, Arrays) and all(
        isinstance(column, Arrays)
        and (column.scalar, column.array.dtype, column.array.shape[1:])
        == (first.scalar, first.array.dtype, first.array.shape[1:])
        for column in columns
    ):
        return Arrays(np.concatenate([column.values() for column in columns]), scalar=first.scalar)
    compound = [column for column in columns if isinstance(column, Parts)]
    if len(compound) == len(columns) and len({(each.named, *each.parts) for each in compound}) == 1:
        joined = {key: join([column.parts[key] for column in compound]) for key in compound[0].parts}
        return Parts(joined, sum(map(len, columns)), named=compound[0].named)
    return Values([item for column in columns for item in column.rows()])


# Values that msgpack cannot represent.


def most_of(compressed: bytes | memoryview) -> int:
    """Upper bound of the content of a zstd frame, bytes. Needed because the claimed size is allocated at once."""
    return (len(compressed) // _ZSTD_LEAST_BYTES + 1) * _ZSTD_BLOCK_BYTES


def count_values(packed: bytes, most: int) -> int:
    """Number of values in a msgpack text, counted up to `most` + 1; each may become an object of 72 bytes.

    One pass suffices: values follow each other in the text, however they nest.
    """
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


def _enc_hook(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        _check_shape(value.shape)
        head = [value.dtype.str, list(value.shape), value.tobytes()]
        return msgspec.msgpack.Ext(_EXT_ARRAY, encoder.encode(head))
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


def encode(block: Any) -> bytes:
    """Encodes a block, or another value made of plain ones and arrays."""
    try:
        return encoder.encode(block)
    except (OverflowError, UnicodeEncodeError, TypeError):
        # Only hostile policies return values that msgpack cannot represent: integers beyond 64 bits, lone surrogates.
        return encoder.encode(_portable(block))


def _portable(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return msgspec.msgpack.Ext(_EXT_INT, str(value).encode())
    if isinstance(value, dict):
        return {_portable(str(key)): _portable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_portable(item) for item in value]
    return value
