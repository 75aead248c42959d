"""The user of an installation: an ordinary one, also where the tests run as root."""

from __future__ import annotations

import os
import site
import subprocess
import sys
from pathlib import Path

NOBODY = 65534


def ordinary() -> tuple[str, list[str]]:
    """A Python of this version, and the words that make its user an ordinary one: as root, nobody.

    Nobody needs a Python that it may read.
    """
    own = os.path.realpath(sys.executable)
    if os.geteuid() != 0:
        return own, []
    become = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    numbered = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for python in (own, f"/usr/bin/{numbered}", f"/usr/local/bin/{numbered}"):
        # A second time from within: the first one may still be started with root's rights.
        listed = f"import os, sys; os.listdir({site.getsitepackages()[0]!r})"
        reads = [*become, python, "-c", f"{listed}; os.execv(sys.executable, ['python', '-c', ''])"]
        if Path(python).exists() and subprocess.run(reads, capture_output=True, check=False).returncode == 0:
            return python, become
    return own, []


def own_all(folder: Path, prefix: list[str]) -> None:
    """Gives a folder and everything in it to the user whom `prefix` becomes, and lets everybody read it."""
    folder.chmod(0o755)
    if prefix:
        subprocess.run(["chown", "-R", f"{NOBODY}:{NOBODY}", str(folder)], check=True)
