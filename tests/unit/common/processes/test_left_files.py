"""Files in a folder that a hostile program has filled."""

from __future__ import annotations

import os
from pathlib import Path

from evopolicy_common.processes.left_files import MAX_DEPTH, left_files
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


def test_folders_that_nest_without_end_are_left_and_can_be_removed(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    here = os.open(root, os.O_RDONLY)
    for _ in range(2000):
        os.close(os.open("file", os.O_WRONLY | os.O_CREAT, dir_fd=here))
        os.mkdir("d", dir_fd=here)
        inner = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inner
    os.close(here)
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
