"""Checks of the machine before a command starts: writable folders, valid path names, a port to bind.

Help and completion import this module, so what only a check needs is imported there.
"""

from __future__ import annotations

import errno
import importlib.util
import os
from pathlib import Path

from evopolicy_common.errors import ConfigError, EvopolicyError, MachineError
from evopolicy_common.installation import add_extra

LOOPBACK = "127.0.0.1"
LEAST_BYTES = 1 << 20
LEAST_SCRATCH_BYTES = 16 << 20
"""For a temporary folder, bytes: a temporary cluster keeps its state there, and sandboxes their files."""
LEAST_INODES = 64
_LOOPBACK_S = 10.0

_REMEDIES = {
    errno.EROFS: "the file system is read-only",
    errno.ENOSPC: "no space or no inodes are left (df -h, df -i): make room",
    errno.EDQUOT: "the quota is used up: make room",
    errno.EACCES: "this user has no permission there",
    errno.EPERM: "this user has no permission there",
    errno.EMFILE: "too many files are open (ulimit -n)",
    errno.ENFILE: "too many files are open on this machine",
    errno.ENOTDIR: "a part of the path is no folder",
    errno.EISDIR: "this is a folder, and a file is wanted",
    errno.ENAMETOOLONG: "a name in the path is too long",
    errno.ELOOP: "its links lead in a circle",
    errno.EIO: "the disk fails",
    errno.ESTALE: "the network file system has lost it: mount it again",
    errno.EFBIG: "a limit on the size of files (ulimit -f)",
    errno.EADDRNOTAVAIL: "this machine does not have that address",
    errno.EADDRINUSE: "something else listens there",
}
"""Faults of the machine that a user can fix, with the remedy."""
_MAY_PASS = frozenset(
    {errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO}
)
"""Faults that may have passed when the program is restarted."""


def explained(error: OSError) -> str | None:
    """The machine's fault with path and remedy, in one line; None for any other error, which may be a bug."""
    number = error.errno or 0
    if number == errno.ENOENT:
        try:
            os.getcwd()
        except FileNotFoundError:
            return "the folder in which this command was started is gone: change to another"
    if number not in _REMEDIES:
        return None
    where = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else "a file"
    return f"{where}: {os.strerror(number)}: {_REMEDIES[number]}"


def foreseen(error: Exception) -> str | None:
    """One line that explains one of our errors or a fault of the machine; None for a bug."""
    if isinstance(error, OSError):
        return explained(error)
    return str(error) if isinstance(error, EvopolicyError) else None


def refused(error: OSError, message: str) -> ConfigError:
    """An error with `message` for an unusable place: MachineError if it may become usable, else ConfigError."""
    return (MachineError if error.errno in _MAY_PASS else ConfigError)(message)


def check_text(path: Path, choose: str) -> None:
    """Raises ConfigError for a path that is not UTF-8: messages, URLs and records that contain it are text."""
    if (shown := os.fsencode(path).decode("utf-8", "backslashreplace")) != str(path):
        raise ConfigError(f"{shown}: this path is not UTF-8; choose another with {choose}")


def check_writable(
    folder: Path, choose: str, *, least_bytes: int = LEAST_BYTES, may_be_full: bool = False
) -> None:
    """Raises ConfigError unless files can be created in `folder`, which need not exist yet; MachineError when the disk
    refuses.

    `choose`: the option or variable that names another folder. `may_be_full`: for callers that wait for space or free
    it.
    """
    import tempfile

    there = folder = Path(os.path.abspath(folder))
    check_text(folder, choose)
    try:
        while not os.path.lexists(there):
            there = there.parent
        with tempfile.TemporaryFile(dir=there) as probe:
            probe.write(bytes(4096))
            probe.flush()
        free = os.statvfs(there)
    except OSError as error:
        if may_be_full and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return
        why = _REMEDIES.get(error.errno or 0, error.strerror or str(error))
        text = (
            f"cannot write to {folder}: {why}; if this cannot be changed, choose another folder with {choose}"
        )
        raise refused(error, text) from error
    n_bytes, least_inodes = free.f_bavail * free.f_frsize, LEAST_INODES if free.f_files else 0
    if not may_be_full and (n_bytes < least_bytes or free.f_favail < least_inodes):
        raise MachineError(
            f"cannot work in {folder}: {n_bytes >> 10:,} KiB and {free.f_favail:,} inodes are free,"
            f" {least_bytes >> 10:,} KiB and {least_inodes} are needed; make room, or choose another folder with"
            f" {choose}"
        )


def check_scratch() -> None:
    """Raises MachineError when the system's temporary folder is full, read-only or missing."""
    import tempfile

    try:
        folder = Path(tempfile.gettempdir())
    except FileNotFoundError as error:
        raise MachineError(
            f"no temporary folder can be written: {error.strerror}; make room, or name one with TMPDIR"
        ) from error
    check_writable(folder, "TMPDIR", least_bytes=LEAST_SCRATCH_BYTES)


def check_loopback() -> None:
    """Raises ConfigError when nothing can listen on the loopback address."""
    import socket

    try:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
            sock.bind((LOOPBACK, 0))
            sock.listen()
            # An interface that is down still has its address, but is unreachable.
            socket.create_connection(sock.getsockname(), timeout=_LOOPBACK_S).close()
    except OSError as error:
        raise ConfigError(no_loopback(error)) from error


def no_loopback(error: OSError) -> str:
    """An error text for a loopback address that cannot be used, with the remedy."""
    return (
        f"cannot listen on {LOOPBACK}, where the agent's service is: {error.strerror or error}; bring IPv4 loopback up"
        " with `ip link set lo up` (in a container: give it a network)"
    )


EXTRAS = {
    "cryptography": "coordinator",
    "jinja2": "coordinator",
    "matplotlib": "coordinator",
    "prometheus_client": "coordinator",
    "scipy": "coordinator",
    "starlette": "gateway",
    "uvicorn": "gateway",
    "h11": "gateway",
    "gymnasium": "worker",
    "mujoco": "worker",
    "av": "worker",
}
"""Modules that the base package lacks, with the extra that installs them."""
LOCAL = "local"
"""The extra of commands that start a cluster on this machine."""


def check_installed(extra: str) -> None:
    """Raises ConfigError, with the install command, when a module of an extra (or of `LOCAL`) is missing."""
    parts = ("coordinator", "gateway") if extra == LOCAL else (extra,)
    for module, its in EXTRAS.items():
        if its in parts and importlib.util.find_spec(module) is None:
            raise ConfigError(missing(extra, module))


def missing(extra: str, module: str) -> str:
    """The error text for a missing module of an extra, with the remedy."""
    if extra == LOCAL:
        return f"nothing can be played on this machine alone (no module {module!r}): {add_extra(LOCAL)}"
    return (
        f"the {extra} part of evopolicy is not installed here (no module {module!r}):"
        f" {add_extra(extra)}; for a cluster on this machine, the extra is {LOCAL}"
    )
