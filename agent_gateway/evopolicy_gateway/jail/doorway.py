"""Inside the jail, before the agent's program: listens on loopback ports, hands the sockets out, becomes the program.

`python -I -S doorway.py FD PORT,PORT,… PROGRAM…`. FD is a unix socket to the agent's keeper, `-` where the network is
open. A socket belongs to the network namespace that it was made in, so the keeper answers there without the agent having
any way out itself. A filter keeps the program to the kinds of sockets that network namespaces divide: a virtual
machine's AF_VSOCK, for one, leads out of all of them.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import struct
import sys

LOOPBACK = "127.0.0.1"
BACKLOG = 128

_ARCHITECTURES = {"x86_64": (0xC000003E, 41), "aarch64": (0xC00000B7, 198)}
"""Audit's number of the architecture, and its `socket`."""
_IO_URING_SETUP = 425
_X32 = 0x40000000
_FAMILIES = (socket.AF_UNIX, socket.AF_INET, socket.AF_INET6, socket.AF_NETLINK)
_ENOSYS, _EAFNOSUPPORT = 38, 97
_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 22, 2
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000


def main(arguments: list[str]) -> None:
    control, ports, program = arguments[0], arguments[1], arguments[2:]
    if control != "-":
        hand_out(int(control), ports)
        keep_to_divided_sockets()
    # Ignored around bubblewrap, so that a program is asked to end before its jail is torn down.
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGPIPE):
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(program[0], program)
    except OSError as error:
        print(f"cannot start {program[0]}: {error.strerror}", file=sys.stderr)
        raise SystemExit(127) from None


def hand_out(control: int, ports: str) -> None:
    """Listens on the ports and gives the sockets away."""
    listening = []
    for port in ports.split(","):
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((LOOPBACK, int(port)))
        sock.listen(BACKLOG)
        listening.append(sock)
    with socket.socket(fileno=control) as keeper:
        socket.send_fds(keeper, [b"."], [sock.fileno() for sock in listening])
    for sock in listening:
        sock.close()


def keep_to_divided_sockets() -> None:
    """Filters `socket` by family. OSError when the kernel does not take the filter."""
    found = _ARCHITECTURES.get(os.uname().machine)
    if found is None:
        return
    audit, number = found
    n = len(_FAMILIES)
    program = [
        (_LOAD, 0, 0, 4),
        (_EQUAL, 0, n + 6, audit),
        (_LOAD, 0, 0, 0),
        (_AT_LEAST, n + 4, 0, _X32),
        # What makes sockets without calling `socket`.
        (_EQUAL, n + 3, 0, _IO_URING_SETUP),
        (_EQUAL, 0, n + 3, number),
        (_LOAD, 0, 0, 16),
        *((_EQUAL, n + 1 - index, 0, int(family)) for index, family in enumerate(_FAMILIES)),
        (_RETURN, 0, 0, _ERRNO | _EAFNOSUPPORT),
        (_RETURN, 0, 0, _ERRNO | _ENOSYS),
        (_RETURN, 0, 0, _ALLOW),
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in program))
    # struct sock_fprog: a count, padding, a pointer.
    filter_ = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    address = ctypes.c_void_p(ctypes.addressof(filter_))
    if libc.prctl(_PR_SET_SECCOMP, ctypes.c_ulong(_SECCOMP_MODE_FILTER), address, 0, 0):
        raise OSError(ctypes.get_errno(), "the filter of sockets was refused")


if __name__ == "__main__":
    main(sys.argv[1:])
