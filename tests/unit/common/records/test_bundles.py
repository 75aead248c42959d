"""Snapshots of `system/` and their way back, against folders that an agent may have prepared."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import BundleError
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import BundleFile


def make(folder: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return folder


def test_equal_folders_alone_have_equal_digests_whatever_their_times(tmp_path: Path) -> None:
    files = {"policy.py": b"class Policy: ...", "lib/gait.py": b"x = 1", "data.bin": bytes(range(256))}
    one = bundles.snapshot(make(tmp_path / "one", files))
    two = bundles.snapshot(make(tmp_path / "two", dict(reversed(files.items()))))
    assert one == two
    three = bundles.snapshot(make(tmp_path / "three", files | {"lib/gait.py": b"x = 2"}))
    assert three.digest != one.digest


def test_what_tools_leave_behind_is_left_out(tmp_path: Path) -> None:
    folder = make(
        tmp_path / "s", {"policy.py": b"a", "__pycache__/policy.cpython-311.pyc": b"x", ".git/HEAD": b"y"}
    )
    assert [file.path for file in bundles.snapshot(folder).files] == ["policy.py"]


def test_unpacked_bundle_snapshots_to_the_same_digest(tmp_path: Path) -> None:
    bundle = bundles.snapshot(make(tmp_path / "s", {"policy.py": b"a", "a/b/c.txt": b"", "run.sh": b"#!"}))
    bundles.unpack(bundles.load(bundle.packed, bundle.digest), tmp_path / "t")
    assert bundles.snapshot(tmp_path / "t").digest == bundle.digest


@pytest.mark.parametrize("kind", ["symlink", "folder symlink", "hard link", "fifo", "socket"])
def test_special_files_are_refused_by_name(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = tmp_path / "secret"
    make(outside, {"key": b"hidden"})
    folder = make(tmp_path / "s", {"policy.py": b"a"})
    monkeypatch.chdir(folder)
    with socket.socket(socket.AF_UNIX) as sock:
        {
            "symlink": lambda: os.symlink(outside / "key", "bad"),
            "folder symlink": lambda: os.symlink(outside, "bad"),
            "hard link": lambda: os.link(outside / "key", "bad"),
            "fifo": lambda: os.mkfifo("bad"),
            "socket": lambda: sock.bind("bad"),
        }[kind]()
    with pytest.raises(BundleError, match="bad"):
        bundles.snapshot(folder)


def test_a_link_in_place_of_system_itself_is_refused(tmp_path: Path) -> None:
    make(tmp_path / "other", {"policy.py": b"a"})
    (tmp_path / "system").symlink_to(tmp_path / "other")
    with pytest.raises(BundleError, match="system"):
        bundles.snapshot(tmp_path / "system")


def test_a_two_gigabyte_file_is_refused_without_being_read(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", {"policy.py": b"a"})
    with (folder / "huge.bin").open("wb") as file:
        file.truncate(2 << 30)
    with pytest.raises(BundleError, match=r"huge\.bin has 2,147,483,648 bytes"):
        bundles.snapshot(folder)


def test_thousands_of_files_are_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", {f"f{i}": b"" for i in range(bundles.MAX_FILES + 1)})
    with pytest.raises(BundleError, match="more than"):
        bundles.snapshot(folder)


def test_thousands_of_empty_folders_and_of_left_out_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundles, "MAX_ENTRIES", 20)
    many = make(tmp_path / "many", {f"f{i}.pyc": b"" for i in range(21)})
    nested = make(tmp_path / "nested", {"policy.py": b"a"})
    for i in range(7):
        (nested / f"d{i}" / "e" / "f").mkdir(parents=True)
    for folder in (many, nested):
        with pytest.raises(BundleError, match="more than 20"):
            bundles.snapshot(folder)
    (nested / "d0" / "e" / "f").rmdir()
    (nested / "d1" / "e" / "f").rmdir()
    assert len(bundles.snapshot(nested).files) == 1


def test_deep_nesting_is_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", {"/".join(["d"] * (bundles.MAX_DEPTH + 2)) + "/f": b""})
    with pytest.raises(BundleError, match="nest"):
        bundles.snapshot(folder)


def test_a_name_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "s", {"policy.py": b"a"})
    with open(os.path.join(os.fsencode(folder), b"\xff\xfe"), "wb"):
        pass
    with pytest.raises(BundleError, match="UTF-8"):
        bundles.snapshot(folder)


@pytest.mark.parametrize(
    "path", ["../evil", "/etc/passwd", "a/../../b", "a//b", ".", "", "a/./b", "a\\b", "a\0b"]
)
def test_a_hostile_bundle_cannot_write_outside_its_folder(tmp_path: Path, path: str) -> None:
    bundle = bundles.pack([BundleFile(path, False, b"x")])
    with pytest.raises(BundleError):
        bundles.load(bundle.packed, bundle.digest)
    with pytest.raises(BundleError):
        bundles.unpack(bundle, tmp_path / "t")
    assert list(tmp_path.iterdir()) == []


def test_a_bundle_over_the_limit_and_another_one_are_refused() -> None:
    bundle = bundles.pack([BundleFile("zeros", False, bytes(bundles.MAX_BYTES + 1))])
    for digest, why in ((bundle.digest, "limit"), ("0" * 64, "is not")):
        with pytest.raises(BundleError, match=why):
            bundles.load(bundle.packed, digest)


@given(st.binary(max_size=200).filter(lambda data: data != b"\x90"))
def test_garbage_is_never_a_bundle(data: bytes) -> None:
    # 0x90 is the empty list: a bundle of an empty folder.
    with pytest.raises(BundleError):
        bundles.load(data, "0" * 64)
    with pytest.raises(BundleError):
        bundles.load(data, digest_of(data))
