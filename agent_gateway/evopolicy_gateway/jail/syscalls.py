"""A seccomp filter for bubblewrap against system calls that bypass a jail's namespaces; it covers the jail's first
process too.

Rules that this module owns:
- Sockets are of families that network namespaces isolate. A virtual machine's AF_VSOCK bypasses all namespaces, and so
  does AF_ALG; of netlink, only routes and socket listings are permitted. A ring (io_uring) would create sockets without
  `socket`.
- Keyrings belong to a login, not to a namespace: none can be read or written.
- No program may read the kernel's log, measure other processes' performance, or run programs in the kernel.
"""

from __future__ import annotations

import errno
import os
import socket

from evopolicy_common.seccomp import ALLOWED, AUDIT_ARCH, JUMP_EQUAL, Instruction, one_of, program, refuse
from evopolicy_common.seccomp.numbers import REFUSED, SOCKET

_REFUSED = {
    # ENOSYS as from a kernel without these calls, which programs can handle.
    errno.ENOSYS: ("io_uring_setup", "add_key", "request_key", "keyctl"),
    errno.EPERM: ("bpf", "perf_event_open", "userfaultfd", "fanotify_init", "syslog"),
}
_FAMILIES = (socket.AF_UNIX, socket.AF_INET, socket.AF_INET6)
_NETLINK = (0, 4)  # NETLINK_ROUTE, NETLINK_SOCK_DIAG


def filter_program() -> bytes | None:
    """The filter, 8 bytes an instruction; None on an architecture without a table of calls."""
    machine = os.uname().machine
    if machine not in AUDIT_ARCH:
        return None
    body: list[Instruction] = []
    for number, calls in _REFUSED.items():
        for call in calls:
            body += [(JUMP_EQUAL, 0, 1, REFUSED[machine][call]), refuse(number)]
    netlink = one_of(2, _NETLINK, refuse(errno.EPROTONOSUPPORT))
    other_family = [(JUMP_EQUAL, 1, 0, int(socket.AF_NETLINK)), refuse(errno.EAFNOSUPPORT), *netlink]
    body += [(JUMP_EQUAL, 1, 0, SOCKET[machine]), ALLOWED, *one_of(0, map(int, _FAMILIES), *other_family)]
    return program(machine, refuse(errno.ENOSYS), body)
