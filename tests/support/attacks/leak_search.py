"""Looks for numbers and texts that must not be somewhere, in whatever form they could be written there.

A value is looked for as text (its digits, JSON, hexadecimal, base64) and as bytes (integers and floats of 4 and 8 bytes
in both orders, msgpack, a Python integer's own digits), in the bytes as they are and in every zstd, gzip or zlib stream
that begins anywhere in them, streams inside streams too.
"""

from __future__ import annotations

import base64
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator

import msgspec
import numpy as np
import zstandard

MAX_UNPACKED_BYTES = 64 << 20
_MAX_DEPTH = 4
_STREAM = re.compile(rb"\x28\xb5\x2f\xfd|\x1f\x8b\x08|\x78[\x01\x5e\x9c\xda]")
_BLOCK = 4 << 20
_MAX_PACKED_BYTES = 4 << 20
_SHORT = 5
"""A pattern with fewer bytes is bound to occur by chance in a large memory."""


class Needles:
    """Values by name, with all their forms."""

    def __init__(self) -> None:
        self._forms: dict[bytes, str] = {}
        self.names: set[str] = set()
        self._indexed: _Index | None = None

    def add_seed(self, name: str, seed: int) -> None:
        """A seed of 31 bits; 2**30 at least, so that its digits are many and its bytes not mostly zero."""
        assert 2**30 <= seed < 2**31
        self._add(name, str(seed).encode(), *_in_base64(str(seed).encode()))
        self._add(name, f"{seed:08x}".encode(), f"{seed:08X}".encode())
        # Two digits of 30 bits: how the interpreter itself keeps it.
        self._add(name, struct.pack("<II", seed & (2**30 - 1), seed >> 30))
        for form in ("<I", ">I", "<q", ">q", "<d", ">d"):
            self._add(name, struct.pack(form, seed))
        self._add(name, msgspec.msgpack.encode(seed))
        for form in ("<q", ">q"):
            self._add(name, *_in_base64(struct.pack(form, seed)))

    def add_number(self, name: str, value: float) -> None:
        """A float with many digits."""
        text = repr(value)
        digits = len(re.sub(r"[^0-9]|e.*", "", text).lstrip("0"))
        assert digits >= 10, f"{value} could be anywhere by chance"
        self._add(name, text.encode(), f"{value:.9g}".encode(), f"{value:.8g}".encode())
        self._add(name, *(form.encode() for form in (f"{value:.7f}", f"{value:.6f}", f"{value:.12g}")))
        # Cut, not rounded.
        self._add(name, text[: 11 + text.startswith("-")].encode())
        self._add(name, *_in_base64(text.encode()))
        for form in ("<d", ">d", "<f", ">f"):
            self._add(name, struct.pack(form, value))
        for form in ("<d", ">d"):
            packed = struct.pack(form, value)
            self._add(name, packed.hex().encode(), packed.hex().upper().encode(), *_in_base64(packed))
        self._add(name, value.hex().encode())

    def add_text(self, name: str, text: str) -> None:
        """A text of its own, such as a mark in a hidden case."""
        self._add(name, text.encode(), text.encode("utf-16-le"), text.encode().hex().encode())
        self._add(name, *_in_base64(text.encode()))

    def found_in(self, data: bytes, *, short: bool = True) -> set[str]:
        """Names of the values that occur in `data`; without `short`, forms of four bytes are left out."""
        index = self._index()
        found: set[str] = set()
        for part in unpacked(data):
            for form in index.possible_in(part):
                name = self._forms[form]
                if name not in found and (short or len(form) >= _SHORT) and form in part:
                    found.add(name)
        return found

    def _index(self) -> _Index:
        if self._indexed is None or self._indexed.n_forms != len(self._forms):
            self._indexed = _Index(self._forms)
        return self._indexed

    def _add(self, name: str, *forms: bytes) -> None:
        self.names.add(name)
        for form in forms:
            self._forms.setdefault(form, name)


class _Index:
    """Tells at the speed of memory which of a thousand forms may be in some bytes, by four bytes of each."""

    def __init__(self, forms: Iterable[bytes]) -> None:
        self._by_key: dict[int, list[bytes]] = {}
        for form in forms:
            windows = [form[at : at + 4] for at in range(len(form) - 3)]
            # The most telling ones: much of a memory is zeros.
            key = max(windows, key=lambda window: len(set(window)))
            self._by_key.setdefault(int.from_bytes(key, "little"), []).append(form)
        self.n_forms = sum(map(len, self._by_key.values()))
        self._keys = np.array(sorted(self._by_key), dtype=np.uint32)
        self._low = np.zeros(1 << 16, dtype=bool)
        self._high = np.zeros(1 << 16, dtype=bool)
        self._low[self._keys & 0xFFFF] = True
        self._high[self._keys >> 16] = True

    def possible_in(self, data: bytes) -> list[bytes]:
        """The forms whose four bytes occur."""
        seen: set[int] = set()
        values = np.frombuffer(data, dtype=np.uint8)
        for start in range(0, len(values), _BLOCK):
            block = values[start : start + _BLOCK + 3].astype(np.uint16)
            if len(block) < 4:
                break
            pairs = block[:-1] | block[1:] << 8
            places = np.flatnonzero(self._low[pairs[:-2]] & self._high[pairs[2:]])
            words = pairs[places].astype(np.uint32) | pairs[places + 2].astype(np.uint32) << 16
            seen.update(np.intersect1d(words, self._keys).tolist())
        return [form for key in seen for form in self._by_key[key]]


def unpacked(data: bytes) -> Iterator[bytes]:
    """The bytes themselves, then what each compressed stream in them holds, and so on."""
    yield from _unpacked(data, 0)


def memory_of(pid: int) -> Iterator[bytes]:
    """The readable memory of a process, region by region, without the text and constants of programs and libraries.

    The process may run on meanwhile: a region that it gives back is left out.
    """
    with open(f"/proc/{pid}/maps") as maps, open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
        for line in maps.read().splitlines():
            where, rights, _, _, inode, *path = line.split()
            if not rights.startswith("r") or (rights[1] != "w" and inode != "0"):
                continue
            if path and path[0] in ("[vvar]", "[vsyscall]", "[vvar_vclock]"):
                continue
            first, last = (int(end, 16) for end in where.split("-"))
            yield _read(memory.fileno(), first, last)


def _read(fd: int, first: int, last: int) -> bytes:
    parts: list[bytes] = []
    while first < last:
        try:
            part = os.pread(fd, min(last - first, 16 << 20), first)
        except OSError:
            break
        if not part:
            break
        parts.append(part)
        first += len(part)
    return b"".join(parts)


def _unpacked(data: bytes, depth: int) -> Iterator[bytes]:
    yield data
    if depth == _MAX_DEPTH:
        return
    for match in _STREAM.finditer(data):
        inside = _content(data, match.start())
        if inside:
            yield from _unpacked(inside, depth + 1)


def _content(data: bytes, start: int) -> bytes:
    """The content of the stream at `start`, as far as it can be read; empty if there is none."""
    view = memoryview(data)[start : start + _MAX_PACKED_BYTES]
    try:
        if data[start] == 0x28:
            return zstandard.ZstdDecompressor().decompressobj().decompress(view)[:MAX_UNPACKED_BYTES]
        return zlib.decompressobj(wbits=47).decompress(view, MAX_UNPACKED_BYTES)
    except (zstandard.ZstdError, zlib.error, MemoryError):
        return b""


def _in_base64(data: bytes) -> Iterable[bytes]:
    """The letters that stand for `data` wherever it begins in a longer text, in both alphabets."""
    for before in range(3):
        whole = base64.b64encode(b"\0" * before + data + b"\0\0\0")
        first = -(-before * 8 // 6)
        last = (before + len(data)) * 8 // 6
        letters = whole[first:last]
        yield letters
        yield letters.translate(bytes.maketrans(b"+/", b"-_"))
