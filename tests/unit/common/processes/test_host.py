"""The kernel that a process runs on has a name that its containers share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from program_runs import run_program

from evopolicy_common.processes import proc


def test_boot_id_is_the_kernels_own() -> None:
    assert proc.boot_id() == Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def test_boot_id_is_the_same_in_namespaces_of_their_own() -> None:
    if shutil.which("bwrap") is None:
        pytest.skip("bubblewrap is missing: bash deploy/setup-host.sh")
    inside = ["bwrap", "--unshare-all", "--ro-bind", "/", "/", "--proc", "/proc"]
    read = run_program(*inside, "cat", "/proc/sys/kernel/random/boot_id")
    assert read.stdout.strip() == proc.boot_id()


def test_kernel_without_an_id_has_an_empty_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(proc, "_BOOT_ID", tmp_path / "none")
    assert proc.boot_id() == ""
