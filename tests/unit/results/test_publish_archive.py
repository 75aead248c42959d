"""Files of published results come from strangers: whatever the writer would not have made is refused, with the
reason.

Attacks, each with its defence:
- zip bombs, links, absolute paths, duplicate names, overlaps, millions of files, huge files: the reader has
  its own archive parser, and refuses every archive that the writer could not have written before it reads
  content.
"""

from __future__ import annotations

import contextlib
import io
import stat
import struct
import tempfile
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import ProtocolError
from evopolicy_results.publish.archive import Archive, ArchiveWriter


def plain(name: str, mode: int = 0o100644, extra: bytes = b"") -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.create_system = 3
    info.external_attr = mode << 16
    info.extra = extra
    return info


def zipped(
    *infos: zipfile.ZipInfo, data: bytes = b"{}", comment: bytes = b"", compression: int = zipfile.ZIP_STORED
) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.comment = comment
        for info in infos:
            archive.writestr(info, data, compression)
    return buffer.getvalue()


def named(*names: str) -> bytes:
    return zipped(*map(plain, names))


BOMB = zipped(plain("runs/0000/run.json"), data=b"0" * (8 << 20), compression=zipfile.ZIP_DEFLATED)
LINK = zipped(plain("a", stat.S_IFLNK | 0o777), data=b"/etc/passwd")


def claims(n: int) -> bytes:
    """An end of an archive that tells of `n` files."""
    data = bytearray(named("a"))
    struct.pack_into("<HH", data, len(data) - 14, n, n)
    return bytes(data)


MILLION = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFF0, 0, 0)
"""As many files as can be told of, with a list to match, and more behind it."""


def overlapping() -> bytes:
    data = bytearray(named("a", "b"))
    second = data.index(b"PK\1\2", data.index(b"PK\1\2") + 1)
    struct.pack_into("<I", data, second + 42, 0)
    return bytes(data)


HOSTILE: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "too short"),
    "text": (b"hello world, this is no archive at all", "no whole file"),
    "zip bomb": (BOMB, "not packed as"),
    "link": (LINK, "not packed as"),
    "folder": (zipped(plain("a/", 0o40755), data=b""), "not the name"),
    "absolute path": (named("/etc/passwd"), "not the name"),
    "parent path": (named("runs/../../x"), "not the name"),
    "hidden name": (named(".ssh/config"), "not the name"),
    "backslash": (named("a\\b"), "not the name"),
    "name of no UTF-8": (named("abc").replace(b"abc", b"\xff\xfe\xfd"), "not the name"),
    "letters of another alphabet": (named("результат"), "not the name"),
    "long name": (named("a" * 500), "not where it should be|not the name"),
    "duplicate": (named("a", "b").replace(b"b{}", b"a{}").replace(b"bPK", b"aPK"), "twice|headers differ"),
    "comment": (zipped(plain("a"), comment=b"hello"), "no whole file"),
    "extra field": (zipped(plain("a", extra=struct.pack("<HH", 0x7075, 0))), "not packed as|not where"),
    "more files than there are": (claims(60_000), "cut off"),
    "too many files": (claims(65_400), "65,000 are allowed"),
    "a million files": (MILLION, "65,000 are allowed"),
    "two headers": (named("abc").replace(b"abc", b"xyz", 1), "headers differ"),
    "overlap": (overlapping(), "not packed as"),
    "bytes before": (b"MZ" + named("a"), "not where it should be"),
    "bytes between": (named("a")[:31] + b"", "no whole file|too short"),
    "cut": (named("a")[:-5], "no whole file"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_file_that_the_writer_would_not_make_is_refused(kind: str, tmp_path: Path) -> None:
    data, reason = HOSTILE[kind]
    path = tmp_path / "hostile.evp"
    path.write_bytes(data)
    with pytest.raises(ProtocolError, match=reason):
        Archive(path)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.evp"
    with path.open("wb") as file:
        file.truncate(5 << 30)
    with pytest.raises(ProtocolError, match="no results of more than"):
        Archive(path)


def test_written_files_are_read_back_and_are_the_same_each_time(tmp_path: Path) -> None:
    files = {"manifest.json": b"{}", "runs/0000/actions/train-000": b"\0\1\2", "runs/0000/salt": b""}
    for name in ("one", "two"):
        writer = ArchiveWriter(tmp_path / name)
        for path, data in files.items():
            writer.add(path, data)
        writer.close()
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    with Archive(tmp_path / "one") as archive:
        assert archive.names == files.keys()
        assert {name: archive.read_file(name, 100) for name in archive.names} == files
        with pytest.raises(ProtocolError, match="2 are allowed"):
            archive.read_file("runs/0000/actions/train-000", 2)
        with pytest.raises(ProtocolError, match="is missing"):
            archive.read_file("runs/0001/run.json", 2)


def test_changed_bytes_are_noticed_when_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "changed"
    path.write_bytes(named("abc").replace(b"abc{}", b"abc[]"))
    with Archive(path) as archive, pytest.raises(ProtocolError, match="damaged"):
        archive.read_file("abc", 10)


@given(
    st.lists(st.tuples(st.integers(0, 10_000), st.binary(max_size=4)), min_size=1, max_size=4),
    st.integers(0, 400),
)
def test_any_damage_is_read_as_it_was_or_refused(changes: list[tuple[int, bytes]], cut: int) -> None:
    whole = named("manifest.json", "runs/0000/run.json")
    data = bytearray(whole)
    for at, new in changes:
        data[at % len(data) : at % len(data) + len(new)] = new
    with tempfile.NamedTemporaryFile() as file:
        file.write(data[: len(data) - cut % 30 if cut > 300 else None])
        file.flush()
        with contextlib.suppress(ProtocolError), Archive(Path(file.name)) as archive:
            for name in archive.names:
                with contextlib.suppress(ProtocolError):
                    assert archive.read_file(name, 100) == b"{}"


def test_the_writer_makes_no_name_that_the_reader_refuses(tmp_path: Path) -> None:
    writer = ArchiveWriter(tmp_path / "out")
    with pytest.raises(ProtocolError, match="not the name"):
        writer.add("../x", b"")
    writer.close()
