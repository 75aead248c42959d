"""What messages name for a distribution: its own package manager, and the setting that forbids namespaces."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from evopolicy_common.processes.distribution import install, permit_namespaces


@pytest.mark.parametrize(
    ("name", "like", "bubblewrap", "egl"),
    [
        ("debian", "", "sudo apt-get install bubblewrap", "libegl1"),
        ("linuxmint", "ubuntu debian", "sudo apt-get install bubblewrap", "libegl1"),
        ("rocky", "rhel centos fedora", "sudo dnf install bubblewrap", "mesa-libEGL"),
        ("arch", "", "sudo pacman -S bubblewrap", "mesa"),
        ("opensuse-leap", "suse opensuse", "sudo zypper install bubblewrap", "Mesa-libEGL1"),
        ("nixos", "", "nix-env -iA nixos.bubblewrap", "nixos.mesa"),
        (
            *("plan9", ""),
            "sudo apt-get install bubblewrap (Debian, Ubuntu), sudo dnf install bubblewrap (Fedora)",
            "libegl1",
        ),
    ],
)
def test_the_package_is_named_for_the_distribution(
    name: str, like: str, bubblewrap: str, egl: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "freedesktop_os_release", lambda: {"ID": name, "ID_LIKE": like})
    assert install("bubblewrap") == bubblewrap
    assert egl in install("egl")


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
    steps = permit_namespaces(tmp_path, container=False)
    assert f"sysctl -w {name.replace('/', '.')}=" in steps
    assert steps.count("sysctl -w") == 1
    inside = permit_namespaces(tmp_path, container=True)
    assert "start it with --security-opt" in inside
    assert inside.endswith(f"on its host: {steps}")


def test_where_no_setting_forbids_namespaces_a_container_is_named(tmp_path: Path) -> None:
    assert "--security-opt seccomp=unconfined" in permit_namespaces(tmp_path)
