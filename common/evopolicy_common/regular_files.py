"""Reads files that others wrote or named.

Rule that this module owns: such a file is a regular one of a bearable size. To open a pipe would wait for its writer
forever, and a device may have no end.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from evopolicy_common.errors import ConfigError

MAX_BYTES = 64 << 20
"""Limit of records, sources and logs, bytes."""


def open_regular(path: Path | str, dir_fd: int | None = None, *, links: bool = False) -> BinaryIO:
    """Opens a file. Raises OSError for anything but a regular file, and without `links` for a link, which may lead
    anywhere. Links among the folders on the way are the caller's."""
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW)
    try:
        fd = os.open(path, flags, dir_fd=dir_fd)
    except OSError as error:
        if error.errno == errno.ELOOP and not links:
            raise OSError(errno.ELOOP, "a link; put the file itself in its place", str(path)) from error
        raise
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return os.fdopen(fd, "rb")


def read_regular(
    path: Path | str, most: int = MAX_BYTES, *, dir_fd: int | None = None, links: bool = False
) -> bytes:
    """The bytes of a file. Raises OSError as `open_regular`, and for one of more than `most` bytes."""
    with open_regular(path, dir_fd, links=links) as file:
        # The file may have holes, and may grow while it is read.
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1) if size <= most else b""
        if len(data) > size:
            data += file.read(most + 1 - len(data))
    if max(size, len(data)) > most:
        raise OSError(errno.EFBIG, f"larger than {most:,} bytes, the limit", str(path))
    return data


def read_given(path: Path, name: str, most: int = MAX_BYTES) -> bytes:
    """The bytes of a file that the user names, also by a link. Raises ConfigError, which calls the file `name`."""
    try:
        return read_regular(path, most, links=True)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise ConfigError(
            f"{name} cannot be read: {why}; name a regular file that this user may read"
        ) from error
