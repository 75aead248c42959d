"""Files in a folder that a hostile program has filled."""

from __future__ import annotations

import os
import socket
import stat
import struct
from pathlib import Path

import pytest

from evopolicy_common.processes.left_files import MAX_DEPTH, keep_to_owner, left_files
from evopolicy_common.processes.scratch import give_back_rights, remove_tree


def names(root: Path) -> list[str]:
    return [path.relative_to(root).as_posix() for path, _ in left_files(root)]


def test_files_come_by_name_with_their_sizes_and_a_folders_own_first(tmp_path: Path) -> None:
    for name in ("b/x", "a/y", "a/b/z", "c", "A"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"12")
    assert names(tmp_path) == ["A", "c", "a/y", "a/b/z", "b/x"]
    assert {size for _, size in left_files(tmp_path)} == {2}
    assert [path.name for path, _ in left_files(tmp_path, enter=lambda name: name != "a")] == ["A", "c", "x"]


def test_links_pipes_and_what_is_not_there_lead_nowhere(tmp_path: Path) -> None:
    (tmp_path / "up").symlink_to(tmp_path)
    (tmp_path / "passwd").symlink_to("/etc/passwd")
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    assert names(tmp_path) == ["file"]
    assert names(tmp_path / "nothing") == []


def nested(root: Path, *, files: bool) -> int:
    """Two thousand folders, each in the one before, perhaps each with a file; the innermost one, open."""
    root.mkdir()
    here = os.open(root, os.O_RDONLY)
    for _ in range(2000):
        if files:
            os.close(os.open("file", os.O_WRONLY | os.O_CREAT, dir_fd=here))
        os.mkdir("d", dir_fd=here)
        inner = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inner
    return here


def test_folders_that_nest_without_end_are_left_and_can_be_removed(tmp_path: Path) -> None:
    root = tmp_path / "root"
    os.close(nested(root, files=True))
    assert len(names(root)) == MAX_DEPTH + 1
    remove_tree(root)
    assert not root.exists()


def test_rights_that_were_taken_are_given_back(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for mode, after in ((0o000, 0o700), (0o055, 0o755), (0o755, 0o755)):
        folder.chmod(mode)
        give_back_rights(folder)
        assert folder.stat().st_mode & 0o777 == after
    give_back_rights(tmp_path / "nothing")


def test_what_would_serve_other_users_is_taken_from_a_folder(tmp_path: Path) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    (root / "open" / "inner").mkdir(parents=True)
    outside.touch()
    modes = {"program": 0o6755, "open": 0o3777, "open/inner/notes": 0o666, "shut": 0o000, "policy.py": 0o644}
    for name in modes.keys() - {"open", "shut"}:
        (root / name).write_text(name)
    os.link(root / "program", root / "same")
    (root / "shut" / "deep").mkdir(parents=True)
    (root / "shut" / "deep" / "program").touch(mode=0o755)
    (root / "shut" / "deep" / "program").chmod(0o4755)
    os.mkfifo(root / "pipe")
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(root / "socket"))
    (root / "link").symlink_to(outside)
    (root / b"\xff\x1b[2J\n".decode("utf-8", "surrogateescape")).touch(mode=0o666)
    for name, mode in modes.items():
        (root / name).chmod(mode)
    outside.chmod(0o666)
    assert keep_to_owner(root) == 0
    found = {path.relative_to(root).as_posix(): path.lstat().st_mode for path in root.rglob("*")}
    assert not {"pipe", "socket"} & found.keys()
    loose = stat.S_ISUID | stat.S_ISGID | stat.S_IWOTH
    assert [name for name, mode in found.items() if mode & loose and not stat.S_ISLNK(mode)] == []
    expected = dict(zip(modes, (0o755, 0o1775, 0o664, 0o700, 0o644), strict=True))
    assert {name: stat.S_IMODE(found[name]) for name in expected} == expected
    assert stat.S_IMODE(outside.stat().st_mode) == 0o666
    assert keep_to_owner(tmp_path / "nothing") == 0
    assert keep_to_owner(root / "link") == 0


def test_access_lists_and_capabilities_are_taken_from_files(tmp_path: Path) -> None:
    entries = (struct.pack("<HHI", who, 7, 0xFFFFFFFF) for who in (1, 4, 32))
    everyone = struct.pack("<I", 2) + b"".join(entries)
    (tmp_path / "program").touch()
    try:
        os.setxattr(tmp_path, "system.posix_acl_default", everyone)
    except OSError:
        pytest.skip("this file system has no access control lists")
    (tmp_path / "inner").mkdir()
    if os.geteuid() == 0:
        os.setxattr(
            tmp_path / "program", "security.capability", struct.pack("<IIIII", 2 << 24 | 1, 4, 0, 0, 0)
        )
    assert keep_to_owner(tmp_path) == 0
    for path in (tmp_path, tmp_path / "inner", tmp_path / "program"):
        assert not {"system.posix_acl_default", "security.capability"} & {*os.listxattr(path)}


@pytest.mark.root  # only root may give files to other users
def test_files_of_other_owners_become_the_folders_owners(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "theirs").touch()
    for path in (tmp_path / "folder", tmp_path / "folder" / "theirs"):
        os.chown(path, 65534, 65534)
    assert keep_to_owner(tmp_path) == 0
    assert {path.stat().st_uid for path in tmp_path.rglob("*")} == {0}


def test_modes_are_taken_from_folders_that_nest_without_end(tmp_path: Path) -> None:
    root = tmp_path / "root"
    here = nested(root, files=False)
    os.fchmod(here, 0o777)
    os.close(os.open("last", os.O_WRONLY | os.O_CREAT, 0o4755, dir_fd=here))
    assert keep_to_owner(root) == 0
    assert stat.S_IMODE(os.fstat(here).st_mode) == 0o775
    assert stat.S_IMODE(os.stat("last", dir_fd=here).st_mode) == 0o755
    os.close(here)
    remove_tree(root)
