"""`.npz` files for `numpy.load`, written while their arrays' rows arrive, and files of arrays that others wrote.

Rules that this module owns:
- Rows are compressed at once; memory never holds a whole array. With one zlib, the same rows give the same bytes.
- A member's header contains the number of rows, which is known only at the end. So the header is a compressed block of
  its own, placed before the others.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.errors import ProtocolError

LEVEL = 1
"""zlib level. 1 reduces CarRacing's frames from 27,648 to 1,870 bytes; 6 reaches 1,160 and takes 2.6 times as long."""
MAX_BYTES = (1 << 32) - (1 << 20)
"""Limit of a member, unpacked, and of the file, bytes; readers need no ZIP64."""
MAX_ARRAYS = 4096
MAX_LIST_BYTES = 4 << 20
"""Limit of the list of members at the end of a file, bytes."""

_LOCAL = struct.Struct("<4sHHHHHLLLHH")
_CENTRAL = struct.Struct("<4sHHHHHHLLLHHHHHLL")
_END = struct.Struct("<4sHHHHLLH")
_VERSION, _UTF8, _DEFLATED, _DAY = 20, 0x800, 8, 0x21
"""Constants of the ZIP headers. The date is always 1980-01-01."""


class NpzWriter:
    """Writes one file. Not thread-safe."""

    def __init__(self, most: int = MAX_BYTES) -> None:
        """`most`: limit of the file, bytes."""
        self._members: dict[str, _Member] = {}
        self._texts: dict[str, list[Any]] = {}
        self._most = most
        self._n_packed = 0

    def add(self, name: str, rows: NDArray[Any] | list[Any]) -> None:
        """Adds rows of an array (n × its shape) or texts. Raises ProtocolError when they do not match earlier rows, or
        when the file becomes too large."""
        if isinstance(rows, list):
            self._texts.setdefault(name, []).extend(rows)
            return
        if name not in self._members:
            self._members[name] = _Member(rows.dtype, rows.shape[1:])
        self._n_packed += self._members[name].add(rows)
        self._check(self._n_packed)

    def finish(self) -> list[bytes]:
        """The file's bytes, in pieces. The writer must not be used afterwards."""
        for name, texts in self._texts.items():
            kind = np.str_ if all(isinstance(text, str) for text in texts) else None
            self.add(name, np.array(texts, dtype=kind))
        body, directory, at = list[bytes](), bytearray(), 0
        for name, member in self._members.items():
            encoded = f"{name}.npy".encode("utf-8", "backslashreplace")
            crc, size, packed = member.finish()
            n_packed = sum(map(len, packed))
            place = (_UTF8, _DEFLATED, 0, _DAY, crc, n_packed, size, len(encoded), 0)
            directory += _CENTRAL.pack(b"PK\1\2", _VERSION, _VERSION, *place, 0, 0, 0, 0, at) + encoded
            body += [_LOCAL.pack(b"PK\3\4", _VERSION, *place) + encoded, *packed]
            at += len(body[-len(packed) - 1]) + n_packed
        n = len(self._members)
        end = _END.pack(b"PK\5\6", 0, 0, n, n, len(directory), at, 0)
        self._check(at + len(directory) + len(end))
        return [*body, bytes(directory), end]

    def _check(self, size: int) -> None:
        if size > self._most:
            raise ProtocolError(
                f"observations of more than {self._most:,} bytes, compressed, which are the limit"
            )


class _Member:
    def __init__(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        if dtype.hasobject:
            raise ProtocolError(
                "observations that are neither numbers nor text cannot be stored apart from the rows"
            )
        self._dtype, self._shape = dtype, shape
        self._n = self._n_bytes = self._crc = 0
        self._stream = zlib.compressobj(LEVEL, zlib.DEFLATED, -15)
        self._pieces: list[bytes] = []

    def add(self, rows: NDArray[Any]) -> int:
        """Adds rows; the number of compressed bytes that they bring."""
        if rows.dtype != self._dtype or rows.shape[1:] != self._shape:
            raise ProtocolError(
                f"observations of {rows.dtype} {rows.shape[1:]} follow those of {self._dtype} {self._shape}"
            )
        data = np.ascontiguousarray(rows).data
        self._n += len(rows)
        self._n_bytes += rows.nbytes
        if self._n_bytes > MAX_BYTES:
            raise ProtocolError(f"observations of {self._n_bytes:,} bytes; {MAX_BYTES:,} are the limit")
        self._crc = zlib.crc32(data, self._crc)
        self._pieces.append(self._stream.compress(data))
        return len(self._pieces[-1])

    def finish(self) -> tuple[int, int, list[bytes]]:
        """CRC-32 and size (bytes) of the `.npy` file, and its deflated bytes in pieces."""
        out = io.BytesIO()
        fields = {
            "descr": np.lib.format.dtype_to_descr(self._dtype),
            "fortran_order": False,
            "shape": (self._n, *self._shape),
        }
        np.lib.format.write_array_header_1_0(out, fields)
        header = out.getvalue()
        first = zlib.compressobj(LEVEL, zlib.DEFLATED, -15)
        # Flushed to a whole byte but not ended: the next block follows in the same stream.
        packed = [
            first.compress(header) + first.flush(zlib.Z_FULL_FLUSH),
            *self._pieces,
            self._stream.flush(),
        ]
        crc = crc_of_both(zlib.crc32(header), self._crc, self._n_bytes)
        return crc, len(header) + self._n_bytes, packed


def check_archive(data: bytes | memoryview, most: int) -> None:
    """Raises ValueError or BadZipFile when loading the arrays would need more than `most` bytes, or are too many."""
    # An archive ends with its list of members. A longer one is not read: each member becomes an object.
    with zipfile.ZipFile(io.BytesIO(data[-MAX_LIST_BYTES:])) as archive:
        members = archive.infolist()
    size = sum(member.file_size for member in members)
    if len(members) > MAX_ARRAYS or size > most:
        raise ValueError(
            f"its {len(members):,} arrays unpack to {size:,} bytes; {MAX_ARRAYS:,} and {most:,} are allowed"
        )


def read_arrays(data: bytes, most: int) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file by name, or that of an `.npy` file under the empty name. Nothing is
    unpickled. Raises ValueError for anything else, and before it would unpack more than `most` bytes."""
    try:
        if data[:2] == b"PK":
            check_archive(data, most)
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {"": loaded}
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except ValueError:
        raise
    except Exception as error:  # damaged archives raise anything
        raise ValueError(f"no file of arrays: {type(error).__name__}: {error}") from error


def crc_of_both(first: int, second: int, n: int) -> int:
    """CRC-32 of two concatenated texts, from their CRCs and the second one's length `n` in bytes, which
    multiplies by x^8n modulo the polynomial. The highest bit of a coefficient is x^0."""
    factor, power = 1 << 31, 1 << 23  # x^0 and x^8
    while n:
        if n & 1:
            factor = _times(factor, power)
        power = _times(power, power)
        n >>= 1
    return _times(factor, first) ^ second


def _times(left: int, right: int) -> int:
    product = 0
    for bit in range(31, -1, -1):
        if left >> bit & 1:
            product ^= right
        right = right >> 1 ^ (0xEDB88320 if right & 1 else 0)
    return product
