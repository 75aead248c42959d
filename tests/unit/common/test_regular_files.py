"""Files that a command is given."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.blobs import announcing, write_atomically
from evopolicy_common.regular_files import read_given


def test_a_given_file_is_regular_bounded_and_may_be_behind_a_link(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "long").touch()
    os.truncate(tmp_path / "long", 11)
    (tmp_path / "right").write_bytes(b"text")
    (tmp_path / "link").symlink_to("right")
    for name, why in {
        "pipe": "not a regular file",
        "zero": "not a regular file",
        "": "not a regular file",
        "long": "larger than 10 bytes",
        "none": "No such file",
        "nul\0": "null (byte|character)",
    }.items():
        with pytest.raises(ConfigError, match=f"^the list cannot be read: .*{why}.*; name a regular file"):
            read_given(tmp_path / name, "the list", 10)
    assert read_given(tmp_path / "link", "the list", 10) == b"text"


def test_what_is_written_never_takes_the_place_of_a_pipe_or_folder(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(ConfigError, match=f"{name} is not a regular file; name another"):
            write_atomically(tmp_path / name, b"text")
    assert sorted(os.listdir(tmp_path)) == ["folder", "pipe"]


def test_only_a_file_that_was_written_is_removed_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    with announcing(path):
        pass
    assert path.read_text() == "mine"
    with announcing(path) as announce:
        announce(b"ready")
        assert path.read_bytes() == b"ready"
    assert not path.exists()
