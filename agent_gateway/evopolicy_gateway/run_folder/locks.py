"""One command at a time: a lock file that names its holder and is released by the holder's death, however it dies."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.summary import utc_text

_MAX_HOLDER_BYTES = 200
_PAUSE_S = 0.2


@contextlib.contextmanager
def alone(lock: Path, what: Path) -> Iterator[None]:
    """Holds `lock`, a file created for it and removed at the end, for the use of `what`. Not re-entrant.

    Raises ConfigError that names the holder when the lock is taken.
    """
    lock.parent.mkdir(parents=True, exist_ok=True)
    fd = _taken(lock, what)
    try:
        os.ftruncate(fd, 0)
        holder = f"process {os.getpid()} on {socket.gethostname()} since {utc_text(time.time())}"
        os.pwrite(fd, holder.encode()[:_MAX_HOLDER_BYTES], 0)
        yield
    finally:
        with contextlib.suppress(OSError):
            lock.unlink()
        os.close(fd)


def check_free(lock: Path, what: Path) -> None:
    """Raises ConfigError that names the holder when the lock is taken."""
    try:
        fd = os.open(lock, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return
    try:
        _lock(fd, what)
    finally:
        os.close(fd)


async def until_free(lock: Path, what: Path) -> None:
    while True:
        try:
            return check_free(lock, what)
        except ConfigError:
            await asyncio.sleep(_PAUSE_S)


def _taken(lock: Path, what: Path) -> int:
    while True:
        fd = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            _lock(fd, what)
            # The previous holder may have removed the file between the two calls: a lock on that file excludes no
            # other process.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(fd), lock.stat()):
                    return fd
        except BaseException:
            os.close(fd)
            raise
        os.close(fd)


def _lock(fd: int, what: Path) -> None:
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(fd, _MAX_HOLDER_BYTES, 0).decode("utf-8", "replace") or "another process"
        raise ConfigError(
            f"{what} is in use by {holder}; wait for it, end it, or choose another --exp-id or --runs"
        ) from None
