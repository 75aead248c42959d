"""The file of published results: a zip archive in its simplest form, written reproducibly and read as hostile input.

Rules that this module owns:
- Files are stored without compression, so unpacking never increases the size. Names are plain: lower-case letters,
  digits, `.`, `-`, `_`, folders by `/`. No links, no comments, no extra fields, no zip64, no duplicates, no gaps.
- Names, sizes and checksums determine all other bytes of the archive. The reader refuses any other bytes before it
  reads content. It holds the names and one file at a time in memory.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

from evopolicy_common.errors import ProtocolError
from evopolicy_common.regular_files import open_regular

MAX_BYTES = (1 << 32) - (1 << 20)
MAX_FILES = 65_000
_MAX_NAME = 120
_NAME = re.compile(r"[a-z0-9_][a-z0-9._-]*(/[a-z0-9_][a-z0-9._-]*){0,4}")
_END = struct.Struct("<4sHHHHIIH")
_ENTRY = struct.Struct("<4sHHHHHHIIIHHHHHII")
_LOCAL = struct.Struct("<4sHHHHHIIIHH")
_FILE_MODE = 0o100644


class ArchiveWriter:
    """Writes files in the order given; the same files give the same bytes."""

    def __init__(self, path: Path) -> None:
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=False)
        self.close = self._zip.close

    def add(self, name: str, data: bytes) -> None:
        """Adds a file. ProtocolError for a name that the reader would refuse."""
        _check_name(name)
        info = zipfile.ZipInfo(name)  # dated 1980-01-01
        info.create_system = 3
        info.external_attr = _FILE_MODE << 16
        self._zip.writestr(info, data)


def _headers(name: bytes, crc: int, size: int, offset: int) -> tuple[bytes, bytes]:
    """The bytes before a file's content at `offset`, and those in its list, as `ArchiveWriter` makes them."""
    common = (20, 0, 0, 0, 1 << 5 | 1, crc, size, size, len(name), 0)
    entry = _ENTRY.pack(b"PK\1\2", 3 << 8 | 20, *common, 0, 0, 0, _FILE_MODE << 16, offset)
    return _LOCAL.pack(b"PK\3\4", *common) + name, entry + name


class Archive:
    """An archive whose headers were checked as a whole."""

    def __init__(self, path: Path) -> None:
        """ProtocolError naming the first fault; OSError when the file cannot be read."""
        self._file: BinaryIO = open_regular(path, links=True)
        try:
            self._places = _places(self._file)
        except BaseException:
            self._file.close()
            raise

    @property
    def names(self) -> frozenset[str]:
        """Of all files."""
        return frozenset(self._places)

    def read_file(self, name: str, most: int) -> bytes:
        """A file's bytes. ProtocolError when there is none of that name, it is damaged, or longer than `most`."""
        place = self._places.get(name)
        if place is None:
            raise ProtocolError(f"{name} is missing")
        start, size, crc = place
        if size > most:
            raise ProtocolError(f"{name} has {size:,} bytes, {most:,} are allowed")
        self._file.seek(start)
        data = self._file.read(size)
        if len(data) != size or zlib.crc32(data) != crc:
            raise ProtocolError(f"{name} is damaged")
        return data

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _places(file: BinaryIO) -> dict[str, tuple[int, int, int]]:
    """Name to start, size and CRC of each file's content."""
    total = file.seek(0, 2)
    if total > MAX_BYTES:
        raise ProtocolError(f"{total:,} bytes; no results of more than {MAX_BYTES:,} are read")
    if total < _END.size:
        raise ProtocolError("not published results: too short")
    file.seek(total - _END.size)
    mark, *parts, n, size, start, comment = _END.unpack(file.read(_END.size))
    if mark != b"PK\5\6" or comment:
        raise ProtocolError("not published results: no whole file of `evopolicy publish`")
    if parts != [0, 0, n] or n > MAX_FILES:
        raise ProtocolError(f"{n} files, {MAX_FILES:,} are allowed, in one part")
    if start + size != total - _END.size or size > n * (_ENTRY.size + _MAX_NAME):
        raise ProtocolError("its list of files is not where it should be")
    file.seek(start)
    listed = file.read(size)
    places: dict[str, tuple[int, int, int]] = {}
    at, offset = 0, 0
    for _ in range(n):
        if at + _ENTRY.size > len(listed):
            raise ProtocolError("its list of files is cut off")
        crc, _, length, n_name = _ENTRY.unpack_from(listed, at)[7:11]
        raw = listed[at + _ENTRY.size : at + _ENTRY.size + n_name]
        name = raw.decode("ascii", "backslashreplace")
        _check_name(name)
        if name in places:
            raise ProtocolError(f"{name} occurs twice")
        header, entry = _headers(raw, crc, length, offset)
        if listed[at : at + len(entry)] != entry:
            raise ProtocolError(
                f"{name} is not packed as `evopolicy publish` packs it: compressed, a link, with extras, or out of"
                " order"
            )
        file.seek(offset)
        if file.read(len(header)) != header:
            raise ProtocolError(f"{name}: its two headers differ")
        places[name] = (offset + len(header), length, crc)
        at += len(entry)
        offset += len(header) + length
    if at != len(listed) or offset != start:
        raise ProtocolError("some bytes belong to no file")
    return places


def _check_name(name: str) -> None:
    if len(name) > _MAX_NAME or not _NAME.fullmatch(name):
        raise ProtocolError(f"{name[:_MAX_NAME]!a} is not the name of a file of published results")
