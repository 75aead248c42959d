"""A seccomp filter for bubblewrap against system calls that bypass a jail's namespaces; it covers the jail's first
process too.

Rules that this module owns:
- Sockets are of families that network namespaces isolate. A virtual machine's AF_VSOCK bypasses all namespaces, and so
  does AF_ALG; of netlink, only routes and socket listings are permitted. A ring (io_uring) would create sockets without
  `socket`.
- Keyrings belong to a login, not to a namespace: none can be read or written.
- No file gets a set-id bit, capabilities or an access control list: the program outlives the jail, and would run with
  the operator's rights for any user who can execute it. The sticky bit is harmless.
- Where affinity limits an agent's cores, no program may choose its own.
- No program may read the kernel's log, measure other processes' performance, or run programs in the kernel.
"""

from __future__ import annotations

import errno
import os
import socket
import stat

from evopolicy_common.errors import ConfigError
from evopolicy_common.seccomp import (
    ALLOWED,
    ATTRIBUTES,
    AUDIT_ARCH,
    JUMP_ANY_BIT,
    JUMP_EQUAL,
    LOAD,
    MODES,
    REFUSED,
    SET_AFFINITY,
    SOCKET,
    Instruction,
    argument,
    one_of,
    program,
    refuse,
)

GIVE_UP = (
    "or give the jail up by name with --jail none of `evopolicy run` or `local`, which run.json then says"
)
_REFUSED = {
    # ENOSYS as from a kernel without these calls, which programs can handle.
    errno.ENOSYS: ("io_uring_setup", "add_key", "request_key", "keyctl"),
    errno.EPERM: ("bpf", "perf_event_open", "userfaultfd", "fanotify_init", "syslog"),
}
_FAMILIES = (socket.AF_UNIX, socket.AF_INET, socket.AF_INET6)
_NETLINK = (0, 4)  # NETLINK_ROUTE, NETLINK_SOCK_DIAG
_SET_ID = stat.S_ISUID | stat.S_ISGID
_MODE_AT = {"chmod": 1, "fchmod": 1, "creat": 1, "mknod": 1, "open": 2}
"""Argument with the mode, by call; in calls with a folder's descriptor it is one later."""
_MAKES_A_FILE = os.O_CREAT | (os.O_TMPFILE & ~os.O_DIRECTORY)
"""Flags of `open` with which its mode counts; without them it may be anything."""


def filter_program(*, fixed_cores: bool = False) -> bytes:
    """The filter, 8 bytes an instruction. `fixed_cores`: affinity cannot be changed. Raises ConfigError on a
    processor without a table of calls."""
    machine = os.uname().machine
    if machine not in AUDIT_ARCH:
        known = " and ".join(sorted(AUDIT_ARCH))
        raise ConfigError(
            f"the agent's jail filters system calls on {known} processors, not on {machine}: play the run on one of"
            f" those, {GIVE_UP}"
        )
    body: list[Instruction] = []
    for number, calls in _REFUSED.items():
        for call in calls:
            body += [(JUMP_EQUAL, 0, 1, REFUSED[machine][call]), refuse(number)]
    if fixed_cores:
        body += [(JUMP_EQUAL, 0, 1, SET_AFFINITY[machine]), refuse(errno.EPERM)]
    # As on a file system without them, which programs that copy files expect.
    for call_number in ATTRIBUTES[machine]:
        body += [(JUMP_EQUAL, 0, 1, call_number), refuse(errno.ENOTSUP)]
    for call, call_number in MODES[machine].items():
        block = _without_set_id(call)
        body += [(JUMP_EQUAL, 0, len(block), call_number), *block]
    netlink = one_of(2, _NETLINK, refuse(errno.EPROTONOSUPPORT))
    other_family = [(JUMP_EQUAL, 1, 0, int(socket.AF_NETLINK)), refuse(errno.EAFNOSUPPORT), *netlink]
    body += [(JUMP_EQUAL, 1, 0, SOCKET[machine]), ALLOWED, *one_of(0, map(int, _FAMILIES), *other_family)]
    return program(machine, refuse(errno.ENOSYS), body)


def _without_set_id(call: str) -> list[Instruction]:
    if call == "openat2":  # its mode is in memory, which a filter cannot read; programs fall back to `openat`
        return [refuse(errno.ENOSYS)]
    at = _MODE_AT.get(call) or _MODE_AT[call.partition("at")[0]] + 1
    block: list[Instruction] = []
    if call.startswith("open"):
        block = [(LOAD, 0, 0, argument(at - 1)), (JUMP_ANY_BIT, 1, 0, _MAKES_A_FILE), ALLOWED]
    return [*block, (LOAD, 0, 0, argument(at)), (JUMP_ANY_BIT, 0, 1, _SET_ID), refuse(errno.EPERM), ALLOWED]
