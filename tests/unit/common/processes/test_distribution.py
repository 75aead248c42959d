"""What messages name for a distribution: its own package manager, and the setting that forbids namespaces."""

from __future__ import annotations

from pathlib import Path

import pytest

from evopolicy_common.processes.distribution import install, permit_namespaces


@pytest.mark.parametrize(
    ("release", "bubblewrap", "egl"),
    [
        ('ID=debian\nVERSION_ID="12"\n', "sudo apt-get install bubblewrap", "libegl1"),
        ('ID=linuxmint\nID_LIKE="ubuntu debian"\n', "sudo apt-get install bubblewrap", "libegl1"),
        ('ID="rocky"\nID_LIKE="rhel centos fedora"\n', "sudo dnf install bubblewrap", "mesa-libEGL"),
        ("ID=arch\n", "sudo pacman -S bubblewrap", "mesa"),
        ('ID="opensuse-leap"\nID_LIKE="suse opensuse"\n', "sudo zypper install bubblewrap", "Mesa-libEGL1"),
        ("ID=nixos\n", "nix-env -iA nixos.bubblewrap", "nixos.mesa"),
    ],
)
def test_the_package_is_named_for_the_distribution(
    release: str, bubblewrap: str, egl: str, tmp_path: Path
) -> None:
    (tmp_path / "os-release").write_text(release)
    assert install("bubblewrap", tmp_path / "os-release") == bubblewrap
    assert egl in install("egl", tmp_path / "os-release")


def test_an_unknown_distribution_gets_two_examples(tmp_path: Path) -> None:
    for place in (tmp_path / "none", tmp_path / "other"):
        assert install("bubblewrap", place) == (
            "sudo apt-get install bubblewrap (Debian, Ubuntu), sudo dnf install bubblewrap (Fedora)"
        )
        (tmp_path / "other").write_text("ID=plan9\n")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("user/max_user_namespaces", "0"),
        ("kernel/unprivileged_userns_clone", "0"),
        ("kernel/apparmor_restrict_unprivileged_userns", "1"),
    ],
)
def test_the_setting_that_forbids_namespaces_is_named_alone(name: str, value: str, tmp_path: Path) -> None:
    for other in ("user/max_user_namespaces", "kernel/unprivileged_userns_clone"):
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).write_text("1\n")
    (tmp_path / name).write_text(f"{value}\n")
    steps = permit_namespaces(tmp_path)
    assert f"sysctl -w {name.replace('/', '.')}=" in steps
    assert steps.count("sysctl -w") == 1


def test_where_no_setting_forbids_namespaces_a_container_is_named(tmp_path: Path) -> None:
    assert "--security-opt seccomp=unconfined" in permit_namespaces(tmp_path)
