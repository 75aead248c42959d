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


def remove(folder: Path) -> None:
    (folder / "policy.py").unlink()


def link_policy(folder: Path) -> None:
    (folder / "policy.py").unlink()
    (folder / "policy.py").symlink_to("/etc/passwd")


def policy_is_a_folder(folder: Path) -> None:
    (folder / "policy.py").unlink()
    (folder / "policy.py").mkdir()


def link_beside(folder: Path) -> None:
    (folder / "data").symlink_to("/etc")


def huge(folder: Path) -> None:
    with (folder / "weights.bin").open("wb") as file:
        file.truncate(2 << 30)


def pipe(folder: Path) -> None:
    os.mkfifo(folder / "pipe")


def no_system(folder: Path) -> None:
    folder.rename(folder.with_name("elsewhere"))


def system_is_a_link(folder: Path) -> None:
    folder.rename(folder.with_name("elsewhere"))
    folder.symlink_to(folder.with_name("elsewhere"))


@pytest.mark.parametrize(
    ("spoil", "category", "named"),
    [
        (remove, "missing_policy", "policy.py"),
        (link_policy, "missing_policy", "symbolic link"),
        (policy_is_a_folder, "missing_policy", "policy.py"),
        (no_system, "missing_policy", "system"),
        (system_is_a_link, "missing_policy", "system"),
        (link_beside, "import_error", "data is a symbolic link"),
        (huge, "import_error", f"{MAX_BYTES:,}"),
        (pipe, "import_error", "named pipe"),
    ],
)
def test_a_folder_that_cannot_be_a_bundle_has_a_verdict(
    tmp_path: Path, spoil: Callable[[Path], None], category: str, named: str
) -> None:
    folder = system(tmp_path)
    spoil(folder)
    taken = take_snapshot(folder, BlobStore(tmp_path / "blobs"))
    assert taken.digest is None
    assert taken.error is not None
    assert taken.error.category == category
    assert named in taken.error.message
    assert str(tmp_path) not in taken.error.message
