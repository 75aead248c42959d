"""Identifies the kernel of this process, so that hidden episodes and agents run on different ones.

Namespaces and containers share their kernel's counters, so the unit is the kernel, not the host name.
"""

from __future__ import annotations

import platform
import secrets
import socket
import subprocess
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

NO_BOOT_ID = f"the kernel does not show its boot id: mount /proc so that {_BOOT_ID} can be read"
"""Why a worker plays no hidden episodes, and why an agent counts as being on every kernel."""


def new_worker_name() -> str:
    """The host's name with a random suffix."""
    return f"{socket.gethostname().split('.')[0][:40] or 'worker'}-{secrets.token_hex(3)}"


def boot_id() -> str:
    """The running kernel's id, new at every boot and equal in all its containers; empty if it is not available."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        pass
    if platform.system() != "Darwin":
        return ""
    done = subprocess.run(
        ["sysctl", "-n", "kern.bootsessionuuid"], capture_output=True, text=True, check=False
    )
    return done.stdout.strip().lower() if done.returncode == 0 else ""
