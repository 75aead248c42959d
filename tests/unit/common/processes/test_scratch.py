"""Thrown-away folders: theirs while the owner lives, gone with it or at the next start."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from evopolicy_common.processes.scratch import clear_stale, remove_tree, scratch_folder

OWNER = """
import sys, tempfile, time
from evopolicy_common.processes.scratch import scratch_folder
tempfile.tempdir = sys.argv[1]
with scratch_folder("local") as root:
    (root / "state").mkdir()
    print(root, flush=True)
    time.sleep(1000)
"""


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_a_folder_goes_with_its_owner(tmp_path: Path) -> None:
    with scratch_folder("local") as root:
        assert root.parent == tmp_path
        assert root.stat().st_mode & 0o777 == 0o700
    assert not list(tmp_path.iterdir())


def test_a_killed_owners_files_go_at_the_next_start(tmp_path: Path) -> None:
    owner = subprocess.Popen([sys.executable, "-c", OWNER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    left = Path(owner.stdout.readline().strip())
    try:
        with scratch_folder("local"):
            assert left.exists()
    finally:
        owner.kill()
        owner.communicate()
    assert clear_stale("worker") == 0
    assert (left / "state").exists()
    with scratch_folder("local"):
        assert not left.exists()


def test_what_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "evopolicy-local-without-an-owner").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "owner").touch()
    (tmp_path / "evopolicy-local-link").symlink_to(tmp_path / "elsewhere")
    assert clear_stale("local") == 0
    assert len(list(tmp_path.iterdir())) == 3


def test_folders_nested_deeper_than_python_recurses_are_removed(tmp_path: Path) -> None:
    folder, outside = tmp_path / "folder", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (outside / "kept").write_text("kept")
    (folder / "file").write_text("x")
    at = os.open(folder, os.O_RDONLY)
    for k in range(1500):
        os.mkdir("d", dir_fd=at)
        if k % 500 == 0:
            os.symlink(outside, "link", dir_fd=at)
            os.mkdir("shut", 0, dir_fd=at)
        inner = os.open("d", os.O_RDONLY, dir_fd=at)
        os.close(at)
        at = inner
    os.close(at)
    remove_tree(folder)
    assert not folder.exists()
    assert (outside / "kept").read_text() == "kept"


def test_folders_without_rights_are_removed_and_a_link_is_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    inner = folder / "a" / "b"
    inner.mkdir(parents=True)
    (inner / "file").write_text("x")
    for shut in (inner, inner.parent, folder):
        shut.chmod(0)
    link = tmp_path / "link"
    link.symlink_to(tmp_path)
    remove_tree(folder)
    remove_tree(link)
    remove_tree(tmp_path / "missing")
    assert not folder.exists()
    assert link.is_symlink()


def test_an_ownerless_folder_goes_once_it_is_old(tmp_path: Path) -> None:
    young, old = (tmp_path / f"evopolicy-local-{name}" for name in ("young", "old"))
    for folder in (young, old):
        (folder / "in").mkdir(parents=True)
    os.utime(old, (0, 0))
    assert clear_stale("local") == 1
    assert young.exists()
    assert not old.exists()
