"""Thrown-away folders: theirs while the owner lives, gone with it or at the next start."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from evopolicy_common.scratch import clear_stale, scratch_folder

OWNER = """
import sys, tempfile, time
from evopolicy_common.scratch import scratch_folder
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


def test_what_a_killed_owner_left_goes_at_the_next_start_of_its_kind_and_not_before(tmp_path: Path) -> None:
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
