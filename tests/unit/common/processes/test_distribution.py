"""What messages name for a distribution: its own package manager, and the setting that forbids namespaces."""

from __future__ import annotations

from pathlib import Path

import pytest

from evopolicy_common.processes.distribution import permit_namespaces


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
