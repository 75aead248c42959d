"""Bundles that are attacks themselves: folders that a submit is to take, and packed ones as a worker gets them."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import msgspec

from evopolicy_common import bundles
from evopolicy_common.bundles import BundleFile

SECRET = b"the hidden seeds"


class BundleAttack(msgspec.Struct, frozen=True, kw_only=True):
    """A folder `system/` with something in it that is no file of the policy's."""

    name: str
    spoil: Callable[[Path, Path], None]
    """Given `system/`, and a file outside that holds the secret."""
    verdict: str
    words: str
    """In the verdict's message."""
    copied: bool = False
    """Whether a plain copy of the folder holds the secret."""


def _link(system: Path, secret: Path) -> None:
    (system / "data").symlink_to(secret)


def _folder_link(system: Path, secret: Path) -> None:
    (system / "data").symlink_to(secret.parent)


def _policy_link(system: Path, secret: Path) -> None:
    (system / "policy.py").unlink()
    (system / "policy.py").symlink_to(secret)


def _hard_link(system: Path, secret: Path) -> None:
    os.link(secret, system / "data")


def _pipe(system: Path, secret: Path) -> None:
    os.mkfifo(system / "data")


def _device(system: Path, secret: Path) -> None:
    try:
        os.mknod(system / "data", 0o600 | stat.S_IFCHR, os.makedev(1, 5))
    except PermissionError:
        # Whoever may make no device cannot submit one either; a socket is refused by the same rule.
        os.mknod(system / "data", 0o600 | stat.S_IFSOCK)


def _thousands(system: Path, secret: Path) -> None:
    for k in range(bundles.MAX_FILES):
        (system / f"{k}").touch()


def _deep(system: Path, secret: Path) -> None:
    (system / "/".join("d" * 40)).mkdir(parents=True)


def _huge(system: Path, secret: Path) -> None:
    with (system / "data").open("wb") as file:
        file.truncate(1 << 40)


BUNDLES = (
    BundleAttack(
        name="a bundle with a symbolic link to a file outside",
        spoil=_link,
        verdict="import_error",
        words="data is a symbolic link",
        copied=True,
    ),
    BundleAttack(
        name="a bundle with a symbolic link to a folder outside",
        spoil=_folder_link,
        verdict="import_error",
        words="data is a symbolic link",
        copied=True,
    ),
    BundleAttack(
        name="a symbolic link in place of policy.py",
        spoil=_policy_link,
        verdict="missing_policy",
        words="symbolic link",
        copied=True,
    ),
    BundleAttack(
        name="a bundle with a hard link to a file outside",
        spoil=_hard_link,
        verdict="import_error",
        words="data",
        copied=True,
    ),
    BundleAttack(
        name="a bundle with a named pipe, which nobody writes to",
        spoil=_pipe,
        verdict="import_error",
        words="named pipe",
    ),
    BundleAttack(
        name="a bundle with a device file", spoil=_device, verdict="import_error", words="data is a"
    ),
    BundleAttack(
        name="a bundle of thousands of files", spoil=_thousands, verdict="import_error", words="2000"
    ),
    BundleAttack(
        name="a bundle of folders nested 40 deep", spoil=_deep, verdict="import_error", words="deep"
    ),
    BundleAttack(
        name="a bundle with a file of a terabyte of nothing",
        spoil=_huge,
        verdict="import_error",
        words="1,099,511,627,776",
    ),
)
PATHS = ("../evil", "a/../../evil", "/tmp/evopolicy-evil", "..")


def plain_copy_reads(system: Path, secret: Path, target: Path) -> bool:
    """Whether the secret is in a copy that is made of the folder without looking."""
    shutil.copytree(system, target)
    return any(SECRET in path.read_bytes() for path in target.rglob("*") if path.is_file())


def packed(path: str) -> bundles.Bundle:
    """A bundle that no snapshot gives: with a file of that path."""
    return bundles.pack([BundleFile("policy.py", False, b""), BundleFile(path, False, b"evil")])
