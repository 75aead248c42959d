"""Snapshots of `system/` for a submit, and the verdicts of folders that cannot be a bundle."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.policies.bundles import MAX_BYTES, load
from evopolicy_gateway.submits.snapshots import take_snapshot


def system(tmp_path: Path) -> Path:
    folder = tmp_path / "system"
    folder.mkdir()
    (folder / "policy.py").write_text("class Policy: ...\n")
    return folder


def test_a_snapshot_is_stored_under_its_digest(tmp_path: Path) -> None:
    blobs = BlobStore(tmp_path / "blobs")
    taken = take_snapshot(system(tmp_path), blobs)
    assert taken.error is None
    assert taken.digest is not None
    assert [file.path for file in load(blobs.read_blob(taken.digest), taken.digest).files] == ["policy.py"]


SPOILT: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "no policy": (lambda folder: (folder / "policy.py").unlink(), "missing_policy", "policy.py"),
    "a link as policy": (
        lambda folder: (folder / "policy.py").unlink() or (folder / "policy.py").symlink_to("/etc/passwd"),
        *("missing_policy", "symbolic link"),
    ),
    "a folder as policy": (
        lambda folder: (folder / "policy.py").unlink() or (folder / "policy.py").mkdir(),
        *("missing_policy", "policy.py"),
    ),
    "no system": (lambda folder: folder.rename(folder.with_name("else")), "missing_policy", "system"),
    "a link as system": (
        lambda folder: folder.symlink_to(folder.rename(folder.with_name("else"))),
        *("missing_policy", "system"),
    ),
    "a link beside": (
        lambda folder: (folder / "data").symlink_to("/etc"),
        *("import_error", "data is a symbolic link"),
    ),
    "a huge file": (
        lambda folder: [(folder / "weights.bin").touch(), os.truncate(folder / "weights.bin", 2 << 30)],
        *("import_error", f"{MAX_BYTES:,}"),
    ),
    "a pipe": (lambda folder: os.mkfifo(folder / "pipe"), "import_error", "named pipe"),
}


@pytest.mark.parametrize(("spoil", "category", "named"), SPOILT.values(), ids=SPOILT)
def test_a_folder_that_cannot_be_a_bundle_has_a_verdict(
    tmp_path: Path, spoil: Callable[[Path], object], category: str, named: str
) -> None:
    folder = system(tmp_path)
    spoil(folder)
    taken = take_snapshot(folder, BlobStore(tmp_path / "blobs"))
    assert taken.digest is None
    assert taken.error is not None
    assert taken.error.category == category
    assert named in taken.error.message
    assert str(tmp_path) not in taken.error.message
