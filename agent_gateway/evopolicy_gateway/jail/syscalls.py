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

from evopolicy_common.seccomp import ALLOWED, AUDIT_ARCH, JUMP_EQUAL, Instruction, one_of, program, refuse
from evopolicy_common.seccomp.numbers import REFUSED, SOCKET

_REFUSED = {
    # As by a kernel without them, which programs know how to live with.
    errno.ENOSYS: ("io_uring_setup", "add_key", "request_key", "keyctl"),
    errno.EPERM: ("bpf", "perf_event_open", "userfaultfd", "fanotify_init", "syslog"),
}
_FAMILIES = (socket.AF_UNIX, socket.AF_INET, socket.AF_INET6)
_NETLINK = (0, 4)  # NETLINK_ROUTE, NETLINK_SOCK_DIAG


def filter_program() -> bytes | None:
    """The filter, 8 bytes an instruction; None on a processor that there is no table for."""
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
