"""Remedies for this machine's distribution: install commands, and the kernel setting that forbids user namespaces."""

from __future__ import annotations

import contextlib
import os
import platform
from pathlib import Path

_INSTALL = {
    "debian": "sudo apt-get install",
    "fedora": "sudo dnf install",
    "arch": "sudo pacman -S",
    "suse": "sudo zypper install",
    "alpine": "sudo apk add",
    "nixos": "nix-env -iA",
}
"""Install commands by family, as `ID` and `ID_LIKE` of os-release name it."""
_KIN = {"ubuntu": "debian", "rhel": "fedora", "centos": "fedora", "opensuse": "suse", "manjaro": "arch"}
_PACKAGES = {
    "bubblewrap": {"nixos": "nixos.bubblewrap"},
    "egl": {
        "debian": "libegl1 libegl-mesa0 libgl1-mesa-dri",
        "fedora": "mesa-libEGL mesa-dri-drivers",
        "arch": "mesa",
        "suse": "Mesa-libEGL1 Mesa-dri",
        "alpine": "mesa-egl mesa-dri-gallium",
        "nixos": "nixos.mesa",
    },
    "chromium": {"nixos": "nixos.chromium"},
}
"""Package names by family, where they differ from the key."""
_SETTINGS = (
    ("user/max_user_namespaces", "0", "sudo sysctl -w user.max_user_namespaces=15000"),
    ("kernel/unprivileged_userns_clone", "0", "sudo sysctl -w kernel.unprivileged_userns_clone=1"),
    (
        "kernel/apparmor_restrict_unprivileged_userns",
        "1",
        "sudo sysctl -w kernel.apparmor_restrict_unprivileged_userns=0, or an AppArmor profile for bwrap with"
        " `userns,`",
    ),
)
"""Files below `/proc/sys`, the value that forbids user namespaces, and the remedy until the next reboot."""
_CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv", "/run/systemd/container")
_CONTAINER_OPTIONS = "--security-opt seccomp=unconfined --security-opt systempaths=unconfined"


def install(what: str) -> str:
    """The command that installs `bubblewrap`, `egl` or `chromium` here; two examples on an unknown distribution."""
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        release = {}
    commands = {family: f"{call} {_PACKAGES[what].get(family, what)}" for family, call in _INSTALL.items()}
    for name in (release.get("ID", ""), *release.get("ID_LIKE", "").split()):
        family = name.partition("-")[0]
        if command := commands.get(_KIN.get(family, family)):
            return command
    return f"{commands['debian']} (Debian, Ubuntu), {commands['fedora']} (Fedora)"


def permit_namespaces(settings: Path = Path("/proc/sys"), *, container: bool | None = None) -> str:
    """How to permit user namespaces: the settings that forbid them now, or else all settings that could. A container
    cannot change them (None: whether this is one is found out)."""
    remedies = []
    for name, forbids, remedy in _SETTINGS:
        with contextlib.suppress(OSError):
            remedies += [remedy] if (settings / name).read_text().strip() == forbids else []
    if container is None:
        container = "container" in os.environ or any(Path(mark).exists() for mark in _CONTAINER_MARKS)
    if container:
        on_host = f", and on its host: {'; '.join(remedies)}" if remedies else ""
        return f"this is a container: start it with {_CONTAINER_OPTIONS}{on_host}"
    if remedies:
        return "; ".join(remedies)
    names = ", ".join(name.replace("/", ".") for name, _, _ in _SETTINGS)
    return f"none of {names} forbids them here: in a container, start it with {_CONTAINER_OPTIONS}"
