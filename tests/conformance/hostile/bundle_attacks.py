"""Bundles that are attacks themselves: folders that a submit is to take, and packed ones as a worker gets them."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import msgspec

from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import BundleFile

SECRET = b"the hidden seeds"


class BundleAttack(msgspec.Struct, frozen=True):
    """A folder `system/` with something in it that is no file of the policy's."""

    name: str
    words: str
    """In the verdict's message."""
    spoil: Callable[[Path, Path], object]
    """Given `system/`, and a file outside that holds the secret."""
    harm: Callable[[Path], bool] | None = None
    """Whether somebody who copies and reads such a folder without looking is harmed; None where to see it is not
    safe."""
    verdict: str = "import_error"


def _policy_link(system: Path, secret: Path) -> None:
    (system / "policy.py").unlink()
    (system / "policy.py").symlink_to(secret)


def _device(system: Path, secret: Path) -> None:
    try:
        os.mknod(system / "data", 0o600 | stat.S_IFCHR, os.makedev(1, 5))
    except PermissionError:
        # Whoever may make no device cannot submit one either; a socket is refused by the same rule.
        os.mknod(system / "data", 0o600 | stat.S_IFSOCK)


def _thousands(system: Path, secret: Path) -> None:
    for k in range(bundles.MAX_FILES):
        (system / f"{k}").touch()


def _huge(system: Path, secret: Path) -> None:
    with (system / "data").open("wb") as file:
        file.truncate(1 << 40)


def _copied(system: Path) -> Path:
    return Path(shutil.copytree(system, system.with_name("copy")))


def _tells_the_secret(system: Path) -> bool:
    return any(SECRET in path.read_bytes() for path in _copied(system).rglob("*") if path.is_file())


def _copies_thousands(system: Path) -> bool:
    return len(list(_copied(system).iterdir())) > bundles.MAX_FILES


def _copies_every_depth(system: Path) -> bool:
    return max(len(path.parts) for path in _copied(system).rglob("*")) > len(system.parts) + bundles.MAX_DEPTH


def _waits_for_ever(system: Path) -> bool:
    try:
        subprocess.run(["cat", system / "data"], timeout=0.5, check=False)
    except subprocess.TimeoutExpired:
        return True
    return False


BUNDLES = (
    BundleAttack(
        "a bundle with a symbolic link to a file outside",
        "data is a symbolic link",
        lambda system, secret: (system / "data").symlink_to(secret),
        _tells_the_secret,
    ),
    BundleAttack(
        "a bundle with a symbolic link to a folder outside",
        "data is a symbolic link",
        lambda system, secret: (system / "data").symlink_to(secret.parent),
        _tells_the_secret,
    ),
    BundleAttack(
        "a symbolic link in place of policy.py",
        "symbolic link",
        _policy_link,
        _tells_the_secret,
        verdict="missing_policy",
    ),
    BundleAttack(
        "a bundle with a hard link to a file outside",
        "data",
        lambda system, secret: os.link(secret, system / "data"),
        _tells_the_secret,
    ),
    BundleAttack(
        "a bundle with a named pipe without a writer",
        "named pipe",
        lambda system, secret: os.mkfifo(system / "data"),
        _waits_for_ever,
    ),
    BundleAttack("a bundle with a device file", "data is a", _device),
    BundleAttack("a bundle of thousands of files", "2000", _thousands, _copies_thousands),
    BundleAttack(
        "a bundle of folders nested 40 deep",
        "deep",
        lambda system, secret: (system / "/".join("d" * 40)).mkdir(parents=True),
        _copies_every_depth,
    ),
    BundleAttack("a bundle with a sparse file of a terabyte", "1,099,511,627,776", _huge),
)
PATHS = ("../evil", "a/../../evil", "/tmp/evopolicy-evil", "..")


def packed(path: str) -> bundles.Bundle:
    """A bundle that no snapshot gives: with a file of that path."""
    return bundles.pack([BundleFile("policy.py", False, b""), BundleFile(path, False, b"evil")])
