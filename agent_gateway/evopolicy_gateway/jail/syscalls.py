"""System calls that lead around a jail's namespaces, as a seccomp filter for bubblewrap: for the jail's first process too.

Rules that this module owns:
- Sockets are of families that network namespaces divide. A virtual machine's AF_VSOCK leads out of all of them, and so
  does AF_ALG; of netlink there is what routes and lists sockets. A ring (io_uring) would make sockets without `socket`.
- Keyrings belong to a login, not to a namespace: none can be read or written.
- Nobody asks the kernel for its log, for other processes' performance, or to run programs in it.
"""

from __future__ import annotations

import errno
import os
import socket
import struct

_ARCHITECTURES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
"""Audit's number of the architecture, and its column in the table."""
_SOCKET = (41, 198)
_REFUSED = {
    # As by a kernel without them, which programs know how to live with.
    errno.ENOSYS: {
        "io_uring_setup": (425, 425),
        "add_key": (248, 217),
        "request_key": (249, 218),
        "keyctl": (250, 219),
    },
    errno.EPERM: {
        "bpf": (321, 280),
        "perf_event_open": (298, 241),
        "userfaultfd": (323, 282),
        "fanotify_init": (300, 262),
        "syslog": (103, 116),
    },
}
_FAMILIES = (socket.AF_UNIX, socket.AF_INET, socket.AF_INET6)
_NETLINK = (0, 4)  # NETLINK_ROUTE, NETLINK_SOCK_DIAG
_X32 = 0x40000000
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_NUMBER, _ARCHITECTURE, _FIRST_ARGUMENT, _THIRD_ARGUMENT = 0, 4, 16, 32
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000
_OTHERWISE_ALLOWED = (_RETURN, 0, 0, _ALLOW)


def filter_program() -> bytes | None:
    """The filter, 8 bytes an instruction; None on a processor that there is no table for."""
    found = _ARCHITECTURES.get(os.uname().machine)
    if found is None:
        return None
    audit, column = found
    program = [
        (_LOAD, 0, 0, _ARCHITECTURE),
        (_EQUAL, 1, 0, audit),
        _refuse(errno.ENOSYS),
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, _X32),
        _refuse(errno.ENOSYS),
    ]
    for number, calls in _REFUSED.items():
        for call in calls.values():
            program += [(_EQUAL, 0, 1, call[column]), _refuse(number)]
    program += [(_EQUAL, 1, 0, _SOCKET[column]), _OTHERWISE_ALLOWED, (_LOAD, 0, 0, _FIRST_ARGUMENT)]
    for family in _FAMILIES:
        program += [(_EQUAL, 0, 1, int(family)), _OTHERWISE_ALLOWED]
    program += [
        (_EQUAL, 1, 0, int(socket.AF_NETLINK)),
        _refuse(errno.EAFNOSUPPORT),
        (_LOAD, 0, 0, _THIRD_ARGUMENT),
    ]
    for protocol in _NETLINK:
        program += [(_EQUAL, 0, 1, protocol), _OTHERWISE_ALLOWED]
    program.append(_refuse(errno.EPROTONOSUPPORT))
    return b"".join(struct.pack("<HBBI", *instruction) for instruction in program)


def _refuse(number: int) -> tuple[int, int, int, int]:
    return (_RETURN, 0, 0, _ERRNO | number)
